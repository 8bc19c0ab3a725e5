"""The map: what keyframes saw, voxelised, without what moved.

A moving object leaves points where later, or earlier, a ray passes freely. So each voxel that only few
keyframes hit is looked up in the range images of keyframes around it; one that was looked through more
often than it was hit is not static (the idea of Removert: Kim and Kim, IROS 2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from kiss_icp.voxelization import voxel_down_sample
from numpy.typing import NDArray

from lifelong_slam.geometry import invert, transform
from lifelong_slam.mapping.keyframe import Keyframe

Array = NDArray[np.float64]

_PIXEL = np.radians(1.0)  # of the range images; wide enough to hold a return of every sensor
_COLUMNS = 360
_ROWS = 180
_MARGIN = 0.5  # metres behind a point that a ray must reach to have looked through it
_MARGIN_PER_METRE = 0.02
_SIGHT = 30.0  # metres; further away pixels are wider than what moves
_STRIDE = 2  # every second keyframe looks; a moving thing is passed by more than one
_TILE = 10.0  # metres
_FEW_HITS = 6  # keyframes; what more of them hit stood still
_MIN_LOOKS_THROUGH = 2
_CHUNK = 50  # keyframes that are merged at a time; bounds memory
_KEY_BITS = 21  # a voxel's coordinate; 2^20 voxels of 0.2 m are 210 km


def thin(points: Array, voxel_size: float) -> NDArray[np.float32]:
    """Keep one of the (N, 3) points a voxel."""
    return np.asarray(voxel_down_sample(points, voxel_size), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class StaticMap:
    """Builds the map of a run.

    Attributes:
        voxel_size: metres; one point a voxel, the mean of what was measured in it.
        max_range: metres from the sensor up to which points enter the map.
    """

    voxel_size: float = 0.2
    max_range: float = 80.0

    def build(self, keyframes: Sequence[Keyframe], poses: Sequence[Array]) -> NDArray[np.float32]:
        """Return (M, 3) float32 static points in the map frame.

        Args:
            keyframes: all of them, in any order.
            poses: (4, 4) T_map_keyframe of each.
        """
        if not keyframes:
            return np.zeros((0, 3), dtype=np.float32)
        points, hits = self._voxelise(keyframes, poses)
        suspects = np.flatnonzero(hits <= _FEW_HITS)
        through = _looks_through(points[suspects], keyframes, poses)
        moved = suspects[(through >= _MIN_LOOKS_THROUGH) & (through > hits[suspects])]
        return np.delete(points, moved, axis=0).astype(np.float32)

    def _voxelise(
        self, keyframes: Sequence[Keyframe], poses: Sequence[Array]
    ) -> tuple[Array, NDArray[np.int64]]:
        """Return the mean point of each voxel (M, 3) and how many keyframes hit it (M,)."""
        keys: NDArray[np.int64] = np.zeros(0, np.int64)
        sums: Array = np.zeros((0, 4))
        for start in range(0, len(keyframes), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            chunk_keys, chunk_sums = self._chunk(keyframes[chunk], poses[chunk])
            keys, inverse = np.unique(np.concatenate([keys, chunk_keys]), return_inverse=True)
            both = np.concatenate([sums, chunk_sums])
            sums = np.stack([np.bincount(inverse, both[:, i]) for i in range(4)], axis=1)
        return sums[:, :3] / sums[:, 3:], sums[:, 3].astype(np.int64)

    def _chunk(
        self, keyframes: Sequence[Keyframe], poses: Sequence[Array]
    ) -> tuple[NDArray[np.int64], Array]:
        """Return voxel keys and [x y z 1] rows, one for each voxel that a keyframe hit."""
        keys, rows = [], []
        for keyframe, pose in zip(keyframes, poses, strict=True):
            near = np.linalg.norm(keyframe.points, axis=1) < self.max_range
            moved = transform(pose, keyframe.points[near].astype(np.float64))
            keys.append(_keys(moved, self.voxel_size))
            rows.append(np.concatenate([moved, np.ones((len(moved), 1))], axis=1))
        return np.concatenate(keys), np.concatenate(rows)


def _keys(points: Array, voxel_size: float) -> NDArray[np.int64]:
    """Return one integer for each point's voxel."""
    cells = np.floor(points / voxel_size).astype(np.int64) + (1 << (_KEY_BITS - 1))
    return (cells[:, 0] << 2 * _KEY_BITS) | (cells[:, 1] << _KEY_BITS) | cells[:, 2]


def _looks_through(
    points: Array, keyframes: Sequence[Keyframe], poses: Sequence[Array]
) -> NDArray[np.int64]:
    """Count for each of (M, 3) map points how many keyframes looked through it."""
    counts = np.zeros(len(points), dtype=np.int64)
    tiles = _Tiles(points)
    for keyframe, pose in zip(keyframes[::_STRIDE], poses[::_STRIDE], strict=True):
        near = tiles.around(pose[:2, 3])
        pixels, ranges = _project(transform(invert(pose), points[near]))
        behind = _range_image(keyframe.points)[pixels]
        through = behind > ranges * (1 + _MARGIN_PER_METRE) + _MARGIN
        counts[near] += through & np.isfinite(behind) & (ranges < _SIGHT)
    return counts


class _Tiles:
    """(M, 3) points sorted into square tiles, to find those around a place."""

    def __init__(self, points: Array) -> None:
        cells = np.floor(points[:, :2] / _TILE)
        self._corners, tile = np.unique(cells, axis=0, return_inverse=True)
        self._order = np.argsort(tile, kind="stable")
        self._ends = np.cumsum(np.bincount(tile, minlength=len(self._corners)))

    def around(self, centre: Array) -> NDArray[np.int64]:
        """Return the indices of points in tiles within sight of an (x, y)."""
        offset = (self._corners + 0.5) * _TILE - centre
        near = np.flatnonzero(np.linalg.norm(offset, axis=1) < _SIGHT + _TILE)
        slices = [self._order[(self._ends[i - 1] if i else 0) : self._ends[i]] for i in near]
        return np.concatenate([np.zeros(0, dtype=np.int64), *slices])


def _range_image(points: NDArray[np.float32]) -> Array:
    """Return the nearest range in each pixel (rows * columns,), infinite where nothing returned."""
    image = np.full(_ROWS * _COLUMNS, np.inf)
    pixels, ranges = _project(points)
    np.minimum.at(image, pixels, ranges)
    return image


def _project(points: NDArray[np.floating]) -> tuple[NDArray[np.int64], Array]:
    """Return the pixel index and the range of each (N, 3) point in the sensor's frame."""
    ranges = np.linalg.norm(points, axis=1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arcsin(points[:, 2] / np.maximum(ranges, 1e-9))
    column = ((azimuth + np.pi) / _PIXEL).astype(np.int64) % _COLUMNS
    row = np.clip(((elevation + np.pi / 2) / _PIXEL).astype(np.int64), 0, _ROWS - 1)
    return row * _COLUMNS + column, ranges
