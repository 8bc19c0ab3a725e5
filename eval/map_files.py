"""Reads maps of points: PLY, PCD, LAS and LAZ."""

import logging
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

from eval.errors import FileError, readable
from eval.nearest import Points
from eval.text_table import LARGEST
from formats.las import check_las
from formats.pcd import read_pcd
from formats.ply import read_ply

_log = logging.getLogger(__name__)


def read_map(path: Path) -> Points:
    """Read the (N, 3) points of a map, in metres; N may be 0.

    Points with NaN or infinite coordinates, or some beyond `LARGEST`, are dropped and counted in the log.

    Args:
        path: a PLY or PCD file, in text or binary, compressed or not, or a LAS or LAZ file.

    Returns:
        float32 where the file has it. Files of double precision and LAS, whose coordinates may be far
        from the origin, give float64, so that they lose nothing.

    Raises:
        FileError: the file is missing, damaged or of another format.
    """
    if not path.is_file():
        raise FileError(f"no such map file: {path}")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise FileError(f"{path} is no map file: its name must end with {', '.join(_READERS)}")
    points = reader(path)
    measured = (points >= -LARGEST) & (points <= LARGEST)
    finite: NDArray[np.bool_] = np.asarray(measured.all(axis=1))
    if finite.all():
        return points
    _log.warning(
        "%s: %d of %d points dropped, which have NaN or infinite coordinates, or above 1e20 m",
        path, np.count_nonzero(~finite), len(finite),
    )  # fmt: skip
    return points[finite]


def _read_ply(path: Path) -> Points:
    with readable(path, "PLY file of points"):
        return _columns(read_ply(path))


def _read_pcd(path: Path) -> Points:
    with readable(path, "PCD file of points"):
        return _columns(read_pcd(path, "xyz"))


def _read_las(path: Path) -> Points:
    with readable(path, "LAS file"):
        check_las(path)
        with laspy.open(path) as file:
            promised, cloud = file.header.point_count, file.read()
    if len(cloud.points) != promised:
        raise FileError(f"{path} has {len(cloud.points)} points of the {promised} in its header")
    return np.asarray(cloud.xyz, dtype=np.float64)


def _columns(records: NDArray[np.void]) -> Points:
    """Return the (N, 3) points of (N,) records, in single precision only if that is theirs."""
    points = np.column_stack([records[axis] for axis in "xyz"])
    if points.dtype == np.float32:
        return points.astype(np.float32, copy=False)
    return points.astype(np.float64, copy=False)


_READERS: dict[str, Callable[[Path], Points]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
}
