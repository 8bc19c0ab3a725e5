"""Occupancy grids as YAML and PGM, the way ROS's map_server reads them (wiki.ros.org/map_server)."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.files import atomic_write

OCCUPIED, FREE, UNKNOWN = 100, 0, -1  # of nav_msgs/OccupancyGrid
_GREY = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}  # map_saver's
# Between the thresholds a cell is unknown: 205 stands for an occupancy of (255 - 205) / 255 = 0.1961.
_YAML = """image: {image}
mode: trinary
resolution: {resolution}
origin: [{x}, {y}, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """A place from above, in square cells.

    Attributes:
        cells: (H, W) int8, `OCCUPIED`, `FREE` or `UNKNOWN`; row 0 has the lowest y.
        resolution: metres, edge of a cell.
        origin: (x, y) in metres of the outer corner of the first cell.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float]


def write_grid(path: Path, grid: OccupancyGrid) -> None:
    """Write a YAML file, and beside it the image that it names, with the same name and ``.pgm``."""
    image = path.with_suffix(".pgm")
    grey = np.zeros(grid.cells.shape, np.uint8)
    for state, value in _GREY.items():
        grey[grid.cells == state] = value
    height, width = grey.shape
    with atomic_write(image) as file:
        file.write(f"P5\n{width} {height}\n255\n".encode())
        file.write(grey[::-1].tobytes())  # an image begins at the top
    x, y = map(float, grid.origin)
    text = _YAML.format(image=json.dumps(image.name), resolution=grid.resolution, x=x, y=y)
    with atomic_write(path) as file:
        file.write(text.encode())
