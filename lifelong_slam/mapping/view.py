"""What one keyframe tells of space: where its rays ended, and what they passed on the way."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from lifelong_slam.memory import kept

SIGHT = 30.0  # metres; further away pixels are wider than what moves

_PIXEL = np.float32(np.radians(1.0))  # wide enough to hold a return of every sensor
_COLUMNS = 360
_ROWS = 180
_MARGIN = 0.5  # metres behind a point that a ray must reach to have passed it
_MARGIN_PER_METRE = 0.02
_CLEARANCE = 0.25  # metres around a point in which nothing returns once it is gone;
_CLEARANCE_PER_METRE = 0.01  # more than lies between thinned points, and between rings
_MAX_CLEARANCE = _CLEARANCE + _CLEARANCE_PER_METRE * SIGHT

Points = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class View:
    """The range image of a keyframe, and its points in sight.

    Attributes:
        T_odom_sensor: (4, 4) of the keyframe.
        nearest: (rows * columns,) float32 nearest range in each pixel, 0 where nothing returned around it.
        returns: K-D tree of its points in sight.
    """

    T_odom_sensor: NDArray[np.float64]
    nearest: NDArray[np.float32]
    returns: cKDTree

    @classmethod
    def of(cls, points: Points, T_odom_sensor: NDArray[np.float64]) -> "View":
        """Make the view of a keyframe with (N, 3) points in its own frame."""
        pixels, ranges = _project(points)
        image = np.full(_ROWS * _COLUMNS, np.inf, dtype=np.float32)
        np.minimum.at(image, pixels, ranges)
        # Points that are thinned out leave gaps between them, at short range wider than a pixel.
        around = minimum_filter(image.reshape(_ROWS, _COLUMNS), 3, mode=("nearest", "wrap"))
        nearest = np.where(np.isfinite(image), image, around.ravel())
        nearest[np.isinf(nearest)] = 0.0
        near = kept(points[ranges < SIGHT + _MAX_CLEARANCE].astype(np.float64))
        returns = cKDTree(near, balanced_tree=False, compact_nodes=False)
        return cls(T_odom_sensor, kept(nearest), returns)

    def looks_through(self, points: Points) -> NDArray[np.bool_]:
        """Tell for each of (N, 3) points in its frame, and in sight, whether a ray passed it.

        One did if the nearest return in the point's direction lies well behind it and none is close to
        it: rays pass beside what is thinner than a pixel, while others still return from it.
        """
        pixels, ranges = _project(points)
        passed = np.flatnonzero(self.nearest[pixels] > ranges * (1 + _MARGIN_PER_METRE) + _MARGIN)
        distance, _ = self.returns.query(points[passed], distance_upper_bound=_MAX_CLEARANCE)
        through = np.zeros(len(points), np.bool_)
        through[passed] = distance > _CLEARANCE + _CLEARANCE_PER_METRE * ranges[passed]
        return through


def in_sight(
    points: Points, T_sensor_points: NDArray[np.float64]
) -> tuple[NDArray[np.intp], Points]:
    """Select those of (N, 3) points that are near enough to a sensor to be looked through.

    Returns:
        Their indices (M,), and (M, 3) themselves in the sensor's frame.
    """
    R = T_sensor_points[:3, :3].astype(np.float32)
    sensor = -T_sensor_points[:3, 3] @ T_sensor_points[:3, :3]
    offsets = points - sensor.astype(np.float32)
    near = np.flatnonzero(np.einsum("ni,ni->n", offsets, offsets) < SIGHT**2)
    return near, np.einsum("ij,nj->ni", R, offsets.take(near, axis=0))


def _project(points: Points) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the pixel index and the range of each (N, 3) point in the sensor's frame."""
    x, y, z = points.T
    flat = x * x + y * y
    azimuth = np.arctan2(y, x)
    elevation = np.arctan2(z, np.sqrt(flat))
    column = ((azimuth + np.float32(np.pi)) / _PIXEL).astype(np.intp) % _COLUMNS
    row = ((elevation + np.float32(np.pi / 2)) / _PIXEL).astype(np.intp)
    return np.minimum(row, _ROWS - 1) * _COLUMNS + column, np.sqrt(flat + z * z)
