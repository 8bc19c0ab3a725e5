"""The map that odometry registers to: what was seen along the last stretch of path."""

from collections.abc import Callable

import numpy as np
from kiss_icp.mapping import VoxelHashMap
from numpy.typing import NDArray

from lifelong_slam.memory import Heap

Array = NDArray[np.float64]

STRETCH = 150.0  # metres; the map holds the points of one to two stretches


class RecentMap:
    """KISS-ICP's voxel map, which also forgets what was seen long ago.

    A map that forgets by distance alone keeps every lap of a block, each displaced by a little more drift:
    searches take longer with each lap, and matches smear. So there are two maps that begin a
    stretch of path apart; the older one serves, and gives way to the younger.
    """

    def __init__(self, new_map: Callable[[], VoxelHashMap]) -> None:
        """Start empty.

        Args:
            new_map: makes an empty voxel map.
        """
        self._new_map = new_map
        # One each, so that a map that goes leaves all of its heap to the one that begins.
        self._heaps = [Heap(), Heap()]
        self._travelled = 0.0
        self._position: Array | None = None
        self.current = new_map()
        self._younger = new_map()

    def update(self, points: Array, T_odom_sensor: Array) -> None:
        """Enter (N, 3) points of a scan with its (4, 4) pose."""
        position = T_odom_sensor[:3, 3].copy()
        if self._position is not None:
            self._travelled += float(np.linalg.norm(position - self._position))
        self._position = position
        if self._travelled >= STRETCH:
            self._travelled = 0.0
            self.current, self._younger = self._younger, self._new_map()
            self._heaps.reverse()
        for voxel_map, heap in zip((self.current, self._younger), self._heaps, strict=True):
            heap.call(voxel_map.update, points, T_odom_sensor)
