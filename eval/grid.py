"""Occupancy grids as ROS's map_server writes them: an image and a YAML file."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Grid:
    """An occupancy grid.

    Attributes:
        occupied: (H, W) cells that an obstacle is in; row 0 has the smallest y.
        known: (H, W) cells that were seen at all.
        resolution: metres a cell.
        origin: (3,) x, y in metres and yaw in radians of the lower left corner of cell (0, 0) in the map.
    """

    occupied: NDArray[np.bool_]
    known: NDArray[np.bool_]
    resolution: float
    origin: NDArray[np.float64]
