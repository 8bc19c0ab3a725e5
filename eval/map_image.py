"""A map seen from above, in two dimensions of cells."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eval.nearest import Points

_SAMPLE = 200_000


@dataclass(frozen=True, slots=True)
class MapImage:
    """Cells of a map.

    Attributes:
        count: (H, W) points in each cell, row 0 at the lowest y.
        height: (H, W) mean height of them in metres, NaN where there are none.
        extent: left, right, bottom and top edge in metres.
        cell: edge of a cell in metres.
    """

    count: NDArray[np.int64]
    height: NDArray[np.float64]
    extent: tuple[float, float, float, float]
    cell: float


def rasterise(points: Points, pixels: int = 1100, finest: float = 0.1) -> MapImage:
    """Count (N, 3) points and average their heights in square cells.

    The farthest thousandth on each side lies outside, so that stray points don't shrink the rest.

    Args:
        points: in metres.
        pixels: cells along the longer side, or fewer.
        finest: shortest edge of a cell in metres.
    """
    sample = points[:: max(1, len(points) // _SAMPLE), :2]
    low, high = np.percentile(sample, (0.1, 99.9), axis=0)
    cell = max(finest, float((high - low).max()) / pixels)
    width, height = (np.floor((high - low) / cell).astype(int) + 1).tolist()
    columns = np.floor((points[:, 0] - low[0]) / cell).astype(np.int32)
    rows = np.floor((points[:, 1] - low[1]) / cell).astype(np.int32)
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    flat = rows[inside].astype(np.int64) * width + columns[inside]
    count = np.bincount(flat, minlength=width * height)
    total = np.bincount(flat, weights=points[inside, 2], minlength=width * height)
    mean = np.full(width * height, np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    left, bottom = low.tolist()
    return MapImage(
        count.reshape(height, width),
        mean.reshape(height, width),
        (left, left + width * cell, bottom, bottom + height * cell),
        cell,
    )
