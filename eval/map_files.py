"""Reads maps of points: PLY, PCD, LAS and LAZ."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import laspy
import numpy as np
from lazrs import LazrsError
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError

from eval.errors import FileError
from eval.nearest import Points

_log = logging.getLogger(__name__)

_NOTHING = np.zeros((0, 3), np.float32)
_COARSE = 0.01  # m between neighbouring values of a coordinate; maps are judged by centimetres


def read_map(path: Path) -> Points:
    """Read the (N, 3) points of a map, in metres; N may be 0.

    Points with NaN or infinite coordinates are dropped, and their number is logged. So is it where the file
    can't hold centimetres: where single precision is too coarse so far from the origin, as with UTM
    coordinates, or the scale of a LAS file is.

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
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    if not finite.all():
        _log.warning(
            "%s: %d of %d points dropped, which have NaN or infinite coordinates",
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
    try:
        vertices = PlyData.read(path)["vertex"]
        return _columns([vertices[axis] for axis in "xyz"])
    except (PlyParseError, KeyError, ValueError) as error:
        raise FileError(f"{path} is not a whole PLY file of points: {error}") from error


def _read_pcd(path: Path) -> Points:
    with path.open("rb") as file:
        header = _pcd_header(file)
        try:
            count, kind = int(header["POINTS"][0]), header["DATA"][0]
            points = _read_pcd_text(file, header) if kind == "ascii" else _read_pcd_binary(path)
        except (KeyError, IndexError, ValueError) as error:
            raise FileError(f"{path} is not a whole PCD file of points") from error
    if len(points) != count:
        raise FileError(f"{path} is not a whole PCD file: {len(points)} points of {count}")
    return points


def _pcd_header(file: BinaryIO) -> dict[str, list[str]]:
    """Read up to the first point; return the values of each keyword."""
    header: dict[str, list[str]] = {}
    for line in file:
        keyword, *values = line.decode(errors="replace").split() or [""]
        header[keyword] = values
        if keyword == "DATA":
            break
    return header


def _read_pcd_text(file: BinaryIO, header: dict[str, list[str]]) -> Points:
    """Read the lines after the header."""
    counts = [int(count) for count in header.get("COUNT", len(header["FIELDS"]) * ["1"])]
    fields = [header["FIELDS"].index(axis) for axis in "xyz"]
    columns = [sum(counts[:field]) for field in fields]
    if int(header["POINTS"][0]) == 0:
        return _NOTHING
    single = all(header["SIZE"][field] == "4" for field in fields)
    rows = np.loadtxt(file, np.float32 if single else np.float64, usecols=columns, ndmin=2)
    return _columns(list(rows.T))


def _read_pcd_binary(path: Path) -> Points:
    import open3d as o3d  # takes a second: not where there is no such file

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(path, format="pcd", remove_nan_points=False)
    # Open3D takes a file without points for a broken one, and says so only in words.
    return _columns(list(cloud.point["positions"].numpy().T)) if cloud.point else _NOTHING


def _read_las(path: Path) -> Points:
    try:
        with laspy.open(path) as file:
            promised, cloud = file.header.point_count, file.read()
            step = max(file.header.scales)
    except (laspy.errors.LaspyException, LazrsError, ValueError) as error:
        raise FileError(f"{path} is not a whole LAS file: {error}") from error
    if len(cloud.points) != promised:
        raise FileError(f"{path} has {len(cloud.points)} points of the {promised} in its header")
    if step > _COARSE:
        _log.warning(
            "%s: by its scale, coordinates are %.2g m apart, which shows as errors", path, step
        )
    return np.asarray(cloud.xyz, dtype=np.float64)


def _columns(axes: list[Points]) -> Points:
    """Return (N, 3) points of three (N,) arrays, in single precision only if that is theirs."""
    points = np.column_stack(axes)
    if points.dtype == np.float32:
        return points.astype(np.float32, copy=False)
    return points.astype(np.float64, copy=False)


_READERS: dict[str, Callable[[Path], Points]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
}
