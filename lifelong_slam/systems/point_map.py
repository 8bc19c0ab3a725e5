"""A voxelised point map that grows with the place, not with time."""

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import transform

Array = NDArray[np.float64]

_BITS = 21
_HALF = 1 << (_BITS - 1)
_SMALLEST_MERGE = 500_000


class PointMap:
    """Keeps the first point that fell into each voxel.

    Points are gathered and merged once they are half as many as the map holds, so that the work
    for each point stays the same however large the map is.
    """

    def __init__(self, voxel_size: float) -> None:
        self._voxel_size = voxel_size
        self._keys = np.empty(0, np.int64)
        self._points: NDArray[np.float32] = np.empty((0, 3), np.float32)
        self._fresh: list[tuple[NDArray[np.int64], NDArray[np.float32]]] = []
        self._fresh_count = 0

    def add(self, points: Array, T_map_points: Array) -> None:
        """Add (N, 3) points seen from a pose."""
        moved = transform(T_map_points, points)
        keys, first = np.unique(self._keys_of(moved), return_index=True)
        self._fresh.append((keys, moved[first].astype(np.float32)))
        self._fresh_count += len(keys)
        if self._fresh_count > max(_SMALLEST_MERGE, len(self._keys) // 2):
            self._merge()

    def points(self) -> NDArray[np.float32]:
        """Return one point a voxel, sorted by voxel."""
        self._merge()
        return self._points

    def _merge(self) -> None:
        keys = np.concatenate([self._keys, *(fresh[0] for fresh in self._fresh)])
        points = np.concatenate([self._points, *(fresh[1] for fresh in self._fresh)])
        self._keys, first = np.unique(keys, return_index=True)
        self._points = points[first]
        self._fresh, self._fresh_count = [], 0

    def _keys_of(self, points: Array) -> NDArray[np.int64]:
        """Pack each point's voxel, counted from the map's origin, into one integer."""
        x, y, z = np.floor(points / self._voxel_size).astype(np.int64).T + _HALF
        keys: NDArray[np.int64] = (x << (2 * _BITS)) | (y << _BITS) | z
        return keys
