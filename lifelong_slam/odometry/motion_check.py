"""A second opinion on the front end's motion, asked for when its own can't be trusted.

Point-to-point ICP on a coarse voxel map has two ways to fail without a sign. At the start of a
recording that begins at speed it locks at zero motion: the rings that a LiDAR draws on the ground
move with the car, and nothing says that the car does. And a hand-held sensor turns between two scans
by more than ICP's basin of convergence. Both show as a motion that the constant-velocity model did
not predict, or could not. Then, and only then, several motions are tried by generalised ICP, whose
planes slide freely along the ground, and the one that puts most points onto known surfaces wins.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import exp, invert, rotation_angle, transform
from lifelong_slam.registration import Cloud, Registration, register

Array = NDArray[np.float64]

_RECENT_SCANS = 20  # what a suspicious motion is checked against
_YAW_GUESSES = (
    -0.3,
    -0.15,
    0.15,
    0.3,
)  # rad about the vertical; hand-held sensors reach 0.25 a scan
_START_DISTANCES = (1.5, 3.0)  # metres a scan; 3 m at 10 Hz is 108 km/h
_ALIAS_DISTANCES = (0.75, 1.5)  # metres; windows, columns and fence posts repeat at such steps
_DIRECTIONS = 8
_MAX_ROTATION = 0.035  # rad (2 degrees) beside the prediction that ICP's basin surely covers
_MAX_TRANSLATION = 0.3  # the same in voxels
_POOR = 0.9  # of the usual overlap, below which a fit is doubted
_FORGETTING = 0.1  # weight of the newest check in the usual overlap
# Below it not even the best guess is an answer: where nothing but the ground fits, one direction of three
# is supported.
_MIN_SUPPORT = 0.5
_UNKNOWN = (
    0.8  # of the usual share of points on known surfaces, below which a scan shows something new
)


class MotionCheck:
    """Remembers the recent scans and re-registers a suspicious one against them."""

    def __init__(self, voxel_size: float) -> None:
        """Set up.

        Args:
            voxel_size: of the front end's local map, metres; checks use half of it.
        """
        self._voxel_size = voxel_size
        self._recent: deque[tuple[Array, Array]] = deque(maxlen=_RECENT_SCANS)
        self._usual_support = 0.0
        self._usual_known = 0.0
        self._scans = 0
        self.checks = 0

    def remember(self, points: Array, T_odom_sensor: Array) -> None:
        """Keep a registered scan's (N, 3) points for later checks."""
        self._recent.append((points, T_odom_sensor))

    def is_suspicious(self, T_predicted: Array, T_estimated: Array) -> bool:
        """Tell whether an estimate lies outside the basin around its prediction."""
        deviation = invert(T_predicted) @ T_estimated
        return bool(
            rotation_angle(deviation) > _MAX_ROTATION
            or np.linalg.norm(deviation[:3, 3]) > _MAX_TRANSLATION * self._voxel_size
        )

    def shows_something_new(self, known: float) -> bool:
        """Tell whether less of a scan than usual lies on known surfaces, and learn what is usual.

        Args:
            known: share of its points that do.
        """
        new = known < _UNKNOWN * self._usual_known
        self._scans += 1
        weight = max(_FORGETTING, 1 / self._scans)
        self._usual_known += weight * (known - self._usual_known)
        return new

    def resolve(self, points: Array, T_last: Array, guesses: Sequence[Array]) -> Array | None:
        """Return the best pose for (N, 3) points, starting from guesses and turns of the last pose.

        A fit that is poorer than usual may be one row of windows off, so shifts are tried as well.
        None where nothing fits: the scan shows something else than the recent ones.
        """
        self.checks += 1
        target = np.vstack([transform(pose, cloud) for cloud, pose in self._recent])
        turns = [T_last @ exp(np.array([0, 0, yaw, 0, 0, 0])) for yaw in _YAW_GUESSES]
        best = self._register(target, points, [*guesses, T_last, *turns])
        if best.support < _POOR * self._usual_support:
            shifts = [best.T_target_source @ shift for shift in _shifts(_ALIAS_DISTANCES)]
            shifted = self._register(target, points, shifts)
            best = max(best, shifted, key=lambda registration: registration.support)
        self._usual_support += _FORGETTING * (best.support - self._usual_support)
        return _supported(best)

    def first_motion(self, first: Array, second: Array) -> Array | None:
        """Return T_first_second of two scans about which nothing is known.

        Tries standing still and motions in all horizontal directions; None if none fits.
        """
        self.checks += 1
        best = self._register(first, second, [np.eye(4), *_shifts(_START_DISTANCES)])
        return _supported(best)

    def _register(self, target: Array, source: Array, guesses: Sequence[Array]) -> Registration:
        voxel = self._voxel_size / 2
        return register(
            Cloud.prepare(target, voxel), Cloud.prepare(source, voxel), guesses, self._voxel_size
        )


def _supported(best: Registration) -> Array | None:
    return best.T_target_source if best.support >= _MIN_SUPPORT else None


def _shifts(distances: Sequence[float]) -> list[Array]:
    """Return (4, 4) horizontal motions of the given lengths in all directions."""
    angles = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    return [
        exp(np.array([0, 0, 0, distance * np.cos(angle), distance * np.sin(angle), 0]))
        for distance in distances
        for angle in angles
    ]
