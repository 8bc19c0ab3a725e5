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

_COARSE = 0.01  # m between neighbouring values of a coordinate; maps are judged by centimetres


def read_map(path: Path) -> Points:
    """Read the (N, 3) points of a map, in metres; N may be 0.

    Points with NaN or infinite coordinates, or some beyond `LARGEST`, are dropped, and their number is
    logged. So is it where the file can't hold centimetres: where single precision is too coarse so far from
    the origin, as with UTM coordinates, or the scale of a LAS file is.

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
    if not finite.all():
        _log.warning(
            "%s: %d of %d points dropped, which have NaN or infinite coordinates, or above 1e20 m",
            path, np.count_nonzero(~finite), len(finite),
        )  # fmt: skip
        points = points[finite]
    if (step := _single_precision_step(points)) > _COARSE:
        _log.warning(
            "%s: coordinates of single precision are %.2g m apart at %.0f m from the origin, which shows as"
            " errors: save the map in double precision, or relative to a point nearby",
            path, step, np.abs(points).max(),
        )  # fmt: skip
    return points


def _single_precision_step(points: Points) -> float:
    """Return the metres between neighbouring values of the largest coordinate as float32; 0 if finer.

    Points that came as doubles, but through a float32, are as coarse.
    """
    with np.errstate(over="ignore"):
        single = points.astype(np.float32, copy=False)
    if len(points) == 0 or not np.array_equal(single, points):
        return 0.0
    return float(np.spacing(np.abs(single).max()))


def _read_ply(path: Path) -> Points:
    with readable(path, "PLY file of points"):
        return _columns(read_ply(path))


def _read_pcd(path: Path) -> Points:
    with readable(path, "PCD file of points"):
        return _columns(read_pcd(path, "xyz"))


def _read_las(path: Path) -> Points:
    with readable(path, "LAS file"):
        check_las(path)
        with laspy.open(path, laz_backend=_LAZ) as file:
            promised, cloud = file.header.point_count, file.read()
            step = max(file.header.scales)
    if len(cloud.points) != promised:
        raise FileError(f"{path} has {len(cloud.points)} points of the {promised} in its header")
    if step > _COARSE:
        _log.warning(
            "%s: by its scale, coordinates are %.2g m apart, which shows as errors", path, step
        )
    return np.asarray(cloud.xyz, dtype=np.float64)


def _columns(records: NDArray[np.void]) -> Points:
    """Return the (N, 3) points of (N,) records, in single precision only if that is theirs."""
    points = np.column_stack([records[axis] for axis in "xyz"])
    if points.dtype == np.float32:
        return points.astype(np.float32, copy=False)
    return points.astype(np.float64, copy=False)


# The parallel one keeps threads that a forked process has lost, and waits for them for ever.
_LAZ = laspy.LazBackend.Lazrs

_READERS: dict[str, Callable[[Path], Points]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
}
