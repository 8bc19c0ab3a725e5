"""The last step of a registration: from KISS-ICP's point matches to surfaces.

Point-to-point ICP pays for its simplicity where the vertical field of view is narrow: matches slide
along the rings on the ground, and pitch and height drift. A few iterations of voxelised GICP (Koide
et al., ICRA 2021) against a Gaussian voxel map of the recent surroundings remove that, and their Hessian
is the information that the registration really has, which the pose graph needs.
"""

from dataclasses import dataclass

import numpy as np
import small_gicp
from numpy.typing import NDArray

from lifelong_slam.geometry import invert, log, rotation_angle
from lifelong_slam.memory import Heap
from lifelong_slam.registration import Cloud, covariance_of

Array = NDArray[np.float64]

_HORIZON = 60  # insertions for which an unseen voxel is kept
_CLEAR_CYCLE = 10
_ITERATIONS = 10
_INSERT_ROTATION = 0.1  # rad; a narrow sensor sees new surfaces after a turn of 6 degrees
_MIN_INLIERS = 50  # points on known surfaces without which there is nothing to refine with
_FORGETTING = 0.05  # weight of the newest scan in how far refinements usually move a pose
_FAR = 2.0  # times the usual, beyond which a refinement was drawn away by something that moves
_LEARNING = 20  # scans before it is known what is usual


@dataclass(frozen=True, slots=True)
class Refined:
    """A cloud's pose in the map of surfaces.

    Attributes:
        T_odom_sensor: (4, 4).
        covariance: (6, 6) in the cloud's frame, rotation (rad) then translation (m).
        known: share of the cloud's points that lie on surfaces of the map.
    """

    T_odom_sensor: Array
    covariance: Array
    known: float


class SurfaceRefinement:
    """Keeps a Gaussian voxel map of the recent surroundings and aligns scans to it."""

    def __init__(self, voxel_size: float) -> None:
        """Set up an empty map with cells of `voxel_size` metres."""
        self._voxel_size = voxel_size
        self._map = small_gicp.GaussianVoxelMap(voxel_size)
        self._heap = Heap()
        self._map.set_lru(horizon=_HORIZON, clear_cycle=_CLEAR_CYCLE)
        self._last_insertion: Array | None = None
        self._usual_move = 0.0  # mean square, m^2
        self._count = 0
        self.refused = 0

    def refine(self, cloud: Cloud, guess: Array) -> Refined | None:
        """Refine a cloud's (4, 4) pose in the map.

        Voxelised GICP has no robust kernel, KISS-ICP has: a refinement that moves the pose much further
        than usual was drawn by a moving thing. Then the guess is returned, with a covariance that says
        so. None where next to nothing of the cloud lies on known surfaces. The map must not be empty.
        """
        result = small_gicp.align(
            self._map,
            cloud.points,
            guess,
            max_correspondence_distance=self._voxel_size,
            max_iterations=_ITERATIONS,
            num_threads=1,
        )
        T = np.asarray(result.T_target_source)
        if result.num_inliers < _MIN_INLIERS or not np.isfinite(T).all():
            return None
        covariance = covariance_of(np.asarray(result.H), result.error, result.num_inliers)
        known = result.num_inliers / len(cloud)
        if self._is_far(float(np.linalg.norm(T[:3, 3] - guess[:3, 3]))):
            self.refused += 1
            dispute = log(invert(guess) @ T)
            return Refined(guess, covariance + np.outer(dispute, dispute), known)
        return Refined(T, covariance, known)

    def _is_far(self, move: float) -> bool:
        """Tell whether a refinement moves a pose by more than is usual, and learn what is (m)."""
        self._count += 1
        limit = float(_FAR * np.sqrt(self._usual_move)) if self._count > _LEARNING else np.inf
        learnt = min(move, 2 * limit)  # so that one outlier doesn't open the door for the next
        weight = max(_FORGETTING, 1 / self._count)
        self._usual_move += weight * (learnt**2 - self._usual_move)
        return move > limit

    def insert(self, cloud: Cloud, T_odom_sensor: Array) -> None:
        """Enter a registered cloud where the sensor has moved enough to see something new."""
        if self._last_insertion is not None:
            motion = invert(self._last_insertion) @ T_odom_sensor
            near = np.linalg.norm(motion[:3, 3]) < self._voxel_size
            if near and rotation_angle(motion) < _INSERT_ROTATION:
                return
        self._heap.call(self._map.insert, cloud.points, T_odom_sensor)
        self._last_insertion = T_odom_sensor
