"""Occupancy grids as ROS's map_server writes and reads them: an image and a YAML file."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from eval.errors import FileError, readable
from eval.files import read_yaml_text

Array = NDArray[np.float64]

# Kind, width, height and largest value of a PGM image; comments may stand between them.
_HEADER = re.compile(rb"(P[25])" + 3 * rb"(?:\s|#[^\n]*\n)+(\d{1,9})" + rb"\s")


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

    def occupied_points(self) -> Array:
        """Return the (N, 2) centres of the occupied cells in the map, metres."""
        rows, columns = np.nonzero(self.occupied)
        x, y = (columns + 0.5) * self.resolution, (rows + 0.5) * self.resolution
        left, bottom, yaw = self.origin
        cos, sin = np.cos(yaw), np.sin(yaw)
        return np.column_stack([left + cos * x - sin * y, bottom + sin * x + cos * y])


class _Description(BaseModel):
    """What map_server wants in a YAML file (wiki.ros.org/map_server, section 1.1)."""

    image: str
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: Literal["trinary", "scale", "raw"] = "trinary"


def read_grid(path: Path) -> Grid:
    """Read an occupancy grid: a YAML file and the PGM image that it names.

    Occupancy is ``(255 - grey) / 255``, with `negate` ``grey / 255``. A cell is occupied above
    `occupied_thresh`. It is known if it is that or free, below `free_thresh`; in mode `scale` all cells
    are known. In mode `raw` the grey value is the occupancy in percent, and unknown above 100.

    Args:
        path: of the YAML file.

    Raises:
        FileError: a file is missing or malformed, or a setting has no sense.
    """
    description = _describe(path)
    occupied, known = _cells(_read_image(path.parent / description.image), description)
    # An image begins at the top, a grid at the lowest y.
    return Grid(occupied[::-1], known[::-1], description.resolution, np.array(description.origin))


def _describe(path: Path) -> _Description:
    if not path.is_file():
        raise FileError(f"no such grid file: {path}")
    text = read_yaml_text(path)
    with readable(path, "YAML file"):
        settings: Any = yaml.safe_load(text)
    try:
        description = _Description.model_validate(settings)
    except ValidationError as error:
        where = ".".join(map(str, error.errors()[0]["loc"])) or "it"
        message = error.errors()[0]["msg"]
        raise FileError(f"{path} doesn't describe a grid: {where}: {message}") from error
    numbers = (description.resolution, *description.origin)
    if not np.isfinite(numbers).all() or description.resolution <= 0:
        raise FileError(f"{path}: the resolution must be above 0 m, and the origin finite")
    return description


def _read_image(path: Path) -> NDArray[np.uint8]:
    """Return the (H, W) grey values of a PGM image, binary (P5) or text (P2), row 0 at the top."""
    if not path.is_file():
        raise FileError(f"no such grid image: {path}")
    data = path.read_bytes()
    header = _HEADER.match(data)
    if header is None or header[4] != b"255":
        raise FileError(f"{path} is not a PGM image with grey values from 0 to 255")
    width, height = int(header[2]), int(header[3])
    try:
        if header[1] == b"P5":
            grey = np.frombuffer(data, np.uint8, width * height, header.end())
        else:
            grey = np.array(data[header.end() :].split()).astype(np.uint8)
        return grey.reshape(height, width)
    except (ValueError, OverflowError) as error:
        raise FileError(f"{path} doesn't hold {width} x {height} grey values") from error


def _cells(
    grey: NDArray[np.uint8], description: _Description
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which cells are occupied, and which are known at all."""
    shade = 255 - grey if description.negate else grey
    if description.mode == "raw":
        known = shade <= 100
        return known & (shade > 100 * description.occupied_thresh), known
    occupancy = (255 - shade.astype(np.float64)) / 255
    occupied = occupancy > description.occupied_thresh
    if description.mode == "scale":
        return occupied, np.ones_like(occupied)
    return occupied, occupied | (occupancy < description.free_thresh)
