"""From a map of points to an occupancy grid for something that drives on the ground."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lifelong_slam.errors import MapError
from lifelong_slam.io.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

Array = NDArray[np.float64]
Cells = NDArray[np.intp]
Mask = NDArray[np.bool_]

_STEP = 0.3  # metres above the ground from which on a point is an obstacle
_CLEARANCE = 2.0  # metres above the ground up to which it is one
_GROUND_CELL = 1.0  # metres
_LOWEST = 0.05  # of the points in a ground cell may be stray ones below the ground
_SLOPE = 0.5  # of the steepest ground; what rises faster was seen without the ground below it
_SLOPE_REACH = 6  # ground cells around one that have a say in this
_SIGHT = 30.0  # metres that rays go
_VIEW_DISTANCE = 2.0  # metres between the places that rays start from
_MOST_CELLS = 400_000_000


def occupancy_grid(points: NDArray[np.float32], sensors: Array, resolution: float) -> OccupancyGrid:
    """Tell which cells are occupied, which are free, and which nobody knows of.

    A cell is occupied if it has a point between 0.3 m and 2 m above the ground, whose height is
    estimated place by place. Rays from where the sensor was free what they cross on their way to an
    occupied cell, or to ground that was seen.

    Args:
        points: (M, 3) static points, metres, z up.
        sensors: (K, 3) positions of the sensor, in the same frame.
        resolution: metres, edge of a cell.

    Raises:
        MapError: there are no points, or too many cells.
    """
    if not len(points):
        raise MapError("there are no static points to make an occupancy grid of")
    width, length = np.ptp(points[:, :2], axis=0) / min(resolution, _GROUND_CELL)
    if width * length > _MOST_CELLS:
        raise MapError(
            f"{width:.0f} x {length:.0f} cells are too many: choose a coarser resolution"
        )
    height = points[:, 2] - _ground_below(points)
    ground = points[np.abs(height) <= _STEP, :2]
    obstacles = points[(height > _STEP) & (height < _CLEARANCE), :2]
    ground_cells, obstacle_cells, views = (
        np.floor(part.astype(np.float64) / resolution).astype(np.intp)
        for part in (ground, obstacles, _spread(sensors[:, :2]))
    )
    all_cells = np.vstack([ground_cells, obstacle_cells, views])
    low = all_cells.min(axis=0)
    shape = tuple((all_cells.max(axis=0) - low + 1)[::-1].tolist())
    occupied = _mask(obstacle_cells - low, shape)
    free = _crossed(occupied, _mask(ground_cells - low, shape), views - low, resolution)
    cells = np.full(shape, UNKNOWN, np.int8)
    cells[free] = FREE
    cells[occupied] = OCCUPIED
    x, y = (low * resolution).round(9).tolist()
    return OccupancyGrid(cells, resolution, (x, y))


def _ground_below(points: NDArray[np.float32]) -> Array:
    """Return the height of the ground at each of (M, 3) points.

    It is interpolated between the means of the lowest points in each ground cell. Cells that rise
    above those around them faster than ground does are left out; there the nearest ground goes on.
    """
    corner = points[:, :2].min(axis=0)
    places = (points[:, :2] - corner).astype(np.float64) / _GROUND_CELL
    columns = places.astype(np.intp)
    shape = tuple((columns.max(axis=0) + 1).tolist())
    cell = np.ravel_multi_index((columns[:, 0], columns[:, 1]), shape)
    ground = _lowest(cell, points[:, 2], shape)
    reach = np.arange(-_SLOPE_REACH, _SLOPE_REACH + 1) * _GROUND_CELL
    rise = _SLOPE * np.hypot(*np.meshgrid(reach, reach))
    highest = ndimage.grey_erosion(ground, structure=-rise, mode="constant", cval=np.inf)
    doubtful = np.isinf(ground) | (ground > highest)
    nearest = ndimage.distance_transform_edt(doubtful, return_distances=False, return_indices=True)
    filled = ground[tuple(nearest)]
    return np.asarray(ndimage.map_coordinates(filled, places.T - 0.5, order=1, mode="nearest"))


def _lowest(cell: Cells, heights: NDArray[np.float32], shape: tuple[int, ...]) -> Array:
    """Return the mean of the lowest of (M,) heights in each cell, infinite where there are none."""
    order = np.lexsort((heights, cell))
    known, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
    low = np.full(shape, np.inf)
    low.flat[known] = heights[order[starts + (_LOWEST * counts).astype(np.intp)]]
    chosen = heights <= low.flat[cell] + _STEP
    total = np.bincount(cell[chosen], heights[chosen], minlength=low.size)
    count = np.bincount(cell[chosen], minlength=low.size)
    low.flat[known] = total[known] / count[known]
    return low


def _spread(places: Array) -> Array:
    """Return some of (K, 2) places, one for each square of `_VIEW_DISTANCE`."""
    _, first = np.unique(np.floor(places / _VIEW_DISTANCE), axis=0, return_index=True)
    return places[first]


def _mask(cells: Cells, shape: tuple[int, ...]) -> Mask:
    """Return a (H, W) mask of (N, 2) cells, x and y."""
    mask = np.zeros(shape, np.bool_)
    mask[cells[:, 1], cells[:, 0]] = True
    return mask


def _crossed(occupied: Mask, ground: Mask, views: Cells, resolution: float) -> Mask:
    """Return the cells that rays from (K, 2) cells cross on their way to what was seen.

    Nothing passes a gap of a single cell: far walls have some where no point fell.
    """
    reach = int(_SIGHT / resolution)
    closed = ndimage.binary_closing(np.pad(occupied, reach), np.ones((3, 3)))
    ground = np.pad(ground, reach)
    free: Mask = np.zeros(closed.shape, np.bool_)
    steps = np.arange(reach)
    angles = np.linspace(0, 2 * np.pi, int(2 * np.pi * reach), endpoint=False)[:, None]
    width = closed.shape[1]
    rays = np.rint(steps * np.sin(angles)).astype(np.intp) * width
    rays += np.rint(steps * np.cos(angles)).astype(np.intp)
    for x, y in views.tolist():
        ray = rays + (y + reach) * width + x + reach
        blocked = closed.ravel()[ray]
        hit, end = blocked.any(axis=1), blocked.argmax(axis=1)
        seen = np.where(ground.ravel()[ray], steps + 1, 0).max(axis=1)
        free.ravel()[ray[steps < np.where(hit, end, seen)[:, None]]] = True
    inner = slice(reach, -reach)
    return free[inner, inner]
