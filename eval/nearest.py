"""Nearest-neighbour distances between clouds of any size, by K-D trees, on all cores."""

import numpy as np
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree

from eval.errors import EvidenceError

Array = NDArray[np.float64]
Points = NDArray[np.float32] | NDArray[np.float64]

_BLOCK = 1_000_000  # points that are looked up at once
_BITS = 10  # of a cell's number along an axis, for sorting
_LEAST_EXTENT = 1e-9  # metres, for clouds that are flat


def nearest_distances(points: Points, target: Points) -> Array:
    """Return the (N,) distances from each point to the nearest one of another cloud.

    Computed in double precision; beside the clouds it takes about 60 bytes a point of either.

    Args:
        points: (N, D) with D up to 3.
        target: (M, D), the cloud that distances are taken to, in the same frame and unit.

    Raises:
        EvidenceError: a cloud is empty or has NaN or infinite coordinates.
    """
    return _distances(_Sorted(points), _Sorted(target))


def mutual_distances(first: Points, second: Points) -> tuple[Array, Array]:
    """Return the distances from each point of the first cloud to the second, and the other way.

    Faster than `nearest_distances` twice.

    Args:
        first: (N, D) with D up to 3.
        second: (M, D), in the same frame and unit.

    Returns:
        (N,) and (M,) distances.

    Raises:
        EvidenceError: a cloud is empty or has NaN or infinite coordinates.
    """
    a, b = _Sorted(first), _Sorted(second)
    return _distances(a, b), _distances(b, a)


class _Sorted:
    """A cloud in which neighbours in space are neighbours in memory.

    That makes trees quick to build and to walk, in whatever order the points of a map come: each
    lookup finds most of its way in the processor's cache, from the one before.

    Attributes:
        order: (N,) indices of the sorted points in the cloud.
        points: (N, D) sorted.
    """

    def __init__(self, points: Points) -> None:
        if len(points) == 0:
            raise EvidenceError("there are no distances to or from a cloud without points")
        low = points.min(axis=0).astype(np.float64)
        extent = points.max(axis=0) - low
        if not np.isfinite(extent).all():
            raise EvidenceError("a cloud has NaN or infinite coordinates: drop these points first")
        cells = ((1 << _BITS) - 1) / np.maximum(extent, _LEAST_EXTENT)
        key = np.zeros(len(points), np.uint32)
        for column, start, scale in zip(points.T, low, cells, strict=True):
            key <<= _BITS
            key |= ((column - start) * scale).astype(np.uint32)
        self.order = np.argsort(key)
        self.points = points[self.order].astype(np.float64)


def _distances(queries: _Sorted, target: _Sorted) -> Array:
    tree = KDTree(target.points)
    distances = np.empty(len(queries.points))
    for start in range(0, len(distances), _BLOCK):
        block = slice(start, start + _BLOCK)
        distances[queries.order[block]] = tree.query(queries.points[block])[0]
    return distances
