"""The path of a session: every scan by odometry, carried by the keyframes among them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import exp, invert, log
from lifelong_slam.memory import GrowingArray
from lifelong_slam.trajectory import Trajectory

Array = NDArray[np.float64]


class Track:
    """Remembers where every scan was by odometry, so that the graph can say where it was on the map.

    Keyframes may leave the graph; of a scan there is nothing to keep but its stamp and its pose.
    """

    def __init__(self) -> None:
        self._stamps = GrowingArray(np.zeros(0, np.int64))
        self._T_odom_sensor = GrowingArray(np.zeros((0, 4, 4)))
        self._keyframes: list[int] = []
        self._at: list[int] = []  # index of each keyframe's scan
        self._starts: list[bool] = []  # whether odometry leads nowhere from the keyframe before
        self.travelled = 0.0  # metres

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: int, T_odom_sensor: Array) -> None:
        """Take in a scan."""
        if len(self):
            step = T_odom_sensor[:3, 3] - self._T_odom_sensor.rows[-1, :3, 3]
            self.travelled += float(np.linalg.norm(step))
        self._T_odom_sensor.append(T_odom_sensor)
        self._stamps.append(stamp)

    def mark_keyframe(self, keyframe: int, starts: bool = False) -> None:
        """Note that the newest scan is a keyframe.

        Args:
            keyframe: its id.
            starts: odometry doesn't connect it with the keyframe before.
        """
        self._keyframes.append(keyframe)
        self._starts.append(starts)
        self._at.append(len(self._stamps) - 1)

    @property
    def keyframes(self) -> Sequence[int]:
        """Ids of all keyframes so far."""
        return self._keyframes

    def since_keyframe(self) -> Array:
        """Return (4, 4) T_keyframe_sensor, the motion from the newest keyframe to the newest scan."""
        odometry = self._T_odom_sensor.rows
        T: Array = invert(odometry[self._at[-1]]) @ odometry[-1]
        return T

    def scans_before_newest(self) -> tuple[int, NDArray[np.int64], Array] | None:
        """Return the scans from the keyframe before the newest up to that one.

        Returns:
            The keyframe's id, (N,) stamps, and (N, 4, 4) T_keyframe_scan; the newest itself is left
            out. None if there is only one keyframe.
        """
        if len(self._at) < 2:
            return None
        first, end = self._at[-2], self._at[-1]
        return self._keyframes[-2], *self._scans(first, end)

    def scans_after_newest(self) -> tuple[int, NDArray[np.int64], Array]:
        """Return the scans from the newest keyframe on, as above."""
        return self._keyframes[-1], *self._scans(self._at[-1], len(self))

    def _scans(self, first: int, end: int) -> tuple[NDArray[np.int64], Array]:
        """Return stamps and poses of some scans, in the frame of the first."""
        odometry = self._T_odom_sensor.rows
        return self._stamps.rows[first:end].copy(), invert(odometry[first]) @ odometry[first:end]

    def trajectory(self, T_map_keyframe: Array) -> Trajectory:
        """Return the pose of every scan on the map.

        The correction that the graph makes to odometry is known at the keyframes before and after a
        scan; in between it moves from one to the other in proportion to the time. Before a keyframe that
        odometry doesn't lead to, scans hang on the last one alone.

        Args:
            T_map_keyframe: (K, 4, 4) of all keyframes in their order.
        """
        stamps = self._stamps.rows.copy()
        odometry = self._T_odom_sensor.rows
        at = np.array(self._at)
        before = np.searchsorted(at, np.arange(len(stamps)), side="right") - 1
        after = np.minimum(before + 1, len(at) - 1)
        after = np.where(np.array(self._starts)[after], before, after)
        T, T_odom = T_map_keyframe, odometry[at]
        correction = invert(T[before] @ invert(T_odom[before]) @ T_odom[after]) @ T[after]
        span = np.maximum(stamps[at[after]] - stamps[at[before]], 1)
        fraction = (stamps - stamps[at[before]]) / span
        blend = exp(fraction[:, None] * log(correction))
        lever = invert(T_odom[after]) @ odometry
        return Trajectory(
            stamps, T[before] @ invert(T_odom[before]) @ T_odom[after] @ blend @ lever
        )
