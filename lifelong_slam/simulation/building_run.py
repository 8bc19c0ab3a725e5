"""A robot that drives through a building for hours: a pose graph without any scans.

The robot goes from room to room at 1 m/s, always by the shortest way, so that every place is passed again
and again. What a SLAM front end would measure on the way is drawn from the errors that our own pipeline
showed against the simulator's truth (see ODOMETRY_SIGMA).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from lifelong_slam.geometry import exp, invert
from lifelong_slam.result import Edge
from lifelong_slam.simulation.building import Array, Indices, draw_building
from lifelong_slam.simulation.seeds import generator

# Root mean square errors of the pipeline's own edges on two laps of `loop` with the full VLS-128, 345
# odometry edges and 48 closures: `python benchmarks/edge_noise.py`. Rotation (rad), then translation (m),
# in the target's frame; x is forward. Here they are independent from edge to edge; real ones partly cancel.
ODOMETRY_SIGMA = np.array([0.53e-3, 0.36e-3, 0.31e-3, 15.9e-3, 7.3e-3, 7.4e-3])
LOOP_SIGMA = np.array([0.45e-3, 0.18e-3, 0.31e-3, 10.8e-3, 5.3e-3, 4.4e-3])

SPEED = 1.0  # m/s
LOOP_SPACING = 8.0  # metres to drive between two closures, as the pipeline's loop closer
MIN_TRAVEL = 20.0  # metres to drive before a place counts as revisited, likewise
LOOP_REACH = 6.0  # metres between the two ends of a closure, at most
KEYFRAME_DISTANCE = 2.0  # metres
# rad: a sensor that sees all around needs no keyframe every 0.35 rad, as one of 120 degrees does.
KEYFRAME_ROTATION = 1.0
_STEP = 0.1  # metres between samples of the path
_ROUNDING = 0.3  # metres, standard deviation of the filter that rounds corners
_WANDER = 0.2  # metres, standard deviation of the deviation from the middle of the way
_WANDER_LENGTH = 3.0  # metres over which that deviation changes
_FLOOR_HEIGHT = 0.01  # metres, amplitude of the floor's waves
_FLOOR_LENGTH = 12.0  # metres from crest to crest
_OTHER_PLACE = 10.0  # metres from which on a place of the same kind is another one
# Where in the other place a wrong closure takes the robot to be: rad, metres.
_WRONG_SIGMA = np.array([1e-3, 1e-3, 0.2, 1.0, 0.5, 0.01])


@dataclass(frozen=True, slots=True)
class Step:
    """A new keyframe.

    Attributes:
        keyframe: its id; ids count from 0.
        seconds: since the start of the run.
        T_world_keyframe: (4, 4) true pose.
        odometry: measured motion from the keyframe before; None for the first.
    """

    keyframe: int
    seconds: float
    T_world_keyframe: Array
    odometry: Edge | None


class BuildingRun:
    """The keyframes of a run, with odometry and loop closures.

    Whatever is drawn for a keyframe depends on seed and keyframe alone: systems that keep different
    vertices get the same odometry, the same errors of their closures and the same wrong ones.
    """

    def __init__(self, hours: float, seed: int, wrong_share: float = 0.0) -> None:
        """Draw the whole run.

        Args:
            hours: to drive.
            seed: of building, route and noise.
            wrong_share: probability that a loop closure is wrong: that it takes the place for another
                one that looks alike, with the covariance of a true one.
        """
        self._seed = seed
        self._wrong_share = wrong_share
        building = draw_building(seed)
        length = 3600 * hours * SPEED
        corners = building.route(length, generator(seed, "route"))
        path, yaw = _drive(corners, generator(seed, "wander"))
        samples = _keyframes(path, yaw)
        samples = samples[samples * _STEP <= length]
        self.travelled: Array = samples.astype(float) * _STEP  # (N,) metres
        self.truth: Array = _on_floor(path[samples], yaw[samples])  # (N, 4, 4) T_world_keyframe
        self._inside = building.contains(path[samples])
        self._kinds = building.kinds[self._inside.argmax(axis=1)]
        noise = generator(seed, "odometry").standard_normal((len(samples), 6))
        motions = invert(self.truth[:-1]) @ self.truth[1:]
        self._motions: Array = motions @ exp(noise[1:] * ODOMETRY_SIGMA)

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.truth)

    def __iter__(self) -> Iterator[Step]:
        """Yield the keyframes in order."""
        covariance = np.diag(ODOMETRY_SIGMA**2)
        for i, T in enumerate(self.truth):
            motion = Edge(i - 1, i, self._motions[i - 1], covariance, "odometry") if i else None
            yield Step(i, float(self.travelled[i] / SPEED), T, motion)

    def cells_entered(self, size: float) -> Indices:
        """Return (N,) how many square cells, `size` metres wide, have been entered by each keyframe."""
        cells = np.floor(self.truth[:, :2, 3] / size)
        _, first = np.unique(cells, axis=0, return_index=True)
        return np.searchsorted(np.sort(first), np.arange(len(self)), side="right")

    def loops(self, step: Step, survivors: Indices) -> list[Edge]:
        """Return the loop closure, if any, that a keyframe gives rise to.

        An attempt is made once every LOOP_SPACING metres of travel. The closure goes to the survivor
        that is nearest in place and direction among those in sight.

        Args:
            step: the newest keyframe.
            survivors: (S,) ids of the keyframes that are still vertices.
        """
        keyframe = step.keyframe
        marks = self.travelled[max(keyframe - 1, 0) : keyframe + 1] // LOOP_SPACING
        if marks[0] == marks[-1]:
            return []
        rng = generator(self._seed, "loop", keyframe)
        noise = exp(rng.standard_normal(6) * LOOP_SIGMA)
        old = survivors[self.travelled[survivors] <= self.travelled[keyframe] - MIN_TRAVEL]
        distances = np.linalg.norm(self.truth[old, :2, 3] - self.truth[keyframe, :2, 3], axis=1)
        place = self._nearest(keyframe, old[distances <= LOOP_REACH])
        if place is None:
            return []
        relative = invert(self.truth[place]) @ self.truth[keyframe] @ noise
        if rng.random() < self._wrong_share:
            alike = old[(distances >= _OTHER_PLACE) & (self._kinds[old] == self._kinds[keyframe])]
            if len(alike) == 0:
                return []
            place = int(rng.choice(alike))
            relative = exp(rng.standard_normal(6) * _WRONG_SIGMA)
        return [Edge(place, keyframe, relative, np.diag(LOOP_SIGMA**2), "loop")]

    def _nearest(self, keyframe: int, candidates: Indices) -> int | None:
        """Return the best of the candidates in sight, by the measure of our LoopCloser."""
        seen = (self._inside[candidates] & self._inside[keyframe]).any(axis=1)
        candidates = candidates[seen]
        if len(candidates) == 0:
            return None
        offsets = self.truth[candidates, :2, 3] - self.truth[keyframe, :2, 3]
        facing = self.truth[candidates, :3, 0] @ self.truth[keyframe, :3, 0]
        turns = np.arccos(np.clip(facing, -1, 1))
        return int(candidates[np.argmin(np.linalg.norm(offsets, axis=1) / LOOP_REACH + turns)])


def _drive(corners: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return (N, 2) positions and (N,) directions every _STEP metres along the way through corners."""
    along = np.concatenate([[0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()])
    samples = np.arange(0, along[-1], _STEP)
    path = np.column_stack([np.interp(samples, along, corners[:, i]) for i in range(2)])
    path = gaussian_filter1d(path, _ROUNDING / _STEP, axis=0)
    heading = np.unwrap(np.arctan2(*np.gradient(path, axis=0).T[::-1]))
    yaw = gaussian_filter1d(heading, _ROUNDING / _STEP)
    wander = gaussian_filter1d(rng.standard_normal(len(path)), _WANDER_LENGTH / _STEP)
    wander *= _WANDER * np.sqrt(2 * np.sqrt(np.pi) * _WANDER_LENGTH / _STEP)  # undo its averaging
    left = np.column_stack([-np.sin(yaw), np.cos(yaw)])
    return path + wander[:, None] * left, yaw


def _keyframes(path: Array, yaw: Array) -> Indices:
    """Return the samples at which the robot has moved or turned enough since the last keyframe."""
    window = int(3 * KEYFRAME_DISTANCE / _STEP)
    chosen = [0]
    while True:
        last = chosen[-1]
        ahead = slice(last + 1, last + 1 + window)
        moved = np.linalg.norm(path[ahead] - path[last], axis=1) >= KEYFRAME_DISTANCE
        due = moved | (np.abs(yaw[ahead] - yaw[last]) >= KEYFRAME_ROTATION)
        if not due.any():
            return np.array(chosen)
        chosen.append(last + 1 + int(due.argmax()))


def _on_floor(positions: Array, yaw: Array) -> Array:
    """Return (N, 4, 4) poses that stand on a floor with shallow waves.

    Height and slope depend on the place alone: sin(kx) sin(ky) and its gradient.
    """
    k = 2 * np.pi / _FLOOR_LENGTH
    (sin_x, sin_y), (cos_x, cos_y) = np.sin(k * positions).T, np.cos(k * positions).T
    slope = _FLOOR_HEIGHT * k * np.array([cos_x * sin_y, sin_x * cos_y])
    level = np.zeros_like(yaw)
    tilt = Rotation.from_rotvec(np.column_stack([slope[1], -slope[0], level]))
    turn = Rotation.from_rotvec(np.column_stack([level, level, yaw]))
    T = np.tile(np.eye(4), (len(yaw), 1, 1))
    T[:, :3, :3] = (tilt * turn).as_matrix()
    T[:, :2, 3] = positions
    T[:, 2, 3] = _FLOOR_HEIGHT * sin_x * sin_y
    return T
