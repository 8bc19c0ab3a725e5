"""One cloud from one PCD, PLY or BIN file."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.pcd import read_pcd
from formats.ply import read_ply
from lifelong_slam.errors import SourceError
from lifelong_slam.sources.bin_layout import KITTI_COLUMNS
from lifelong_slam.sources.point_times import is_time_field
from lifelong_slam.sources.pointcloud2 import Cloud

_READERS = {".pcd": read_pcd, ".ply": read_ply}
SUFFIXES = (*_READERS, ".bin")


def read_cloud(path: Path, columns: int = KITTI_COLUMNS) -> Cloud:
    """Read a PCD or PLY of any fields and encoding, or a BIN of so many float32 columns, x y z first.

    Raises:
        SourceError: the file is damaged, cut short, or has no x y z.
    """
    if path.suffix.lower() == ".bin":
        return Cloud(read_bin(path, columns), {})
    try:
        records = _READERS[path.suffix.lower()](path)
    except Exception as error:  # damaged files break their parsers in any way
        raise SourceError(f"{path} is damaged: {' '.join(str(error).split())}") from error
    names = records.dtype.names or ()
    if missing := [name for name in "xyz" if name not in names]:
        raise SourceError(f"{path} has no {', '.join(missing)}; its fields: {', '.join(names)}")
    points = np.column_stack([records[name].astype(np.float64) for name in "xyz"])
    times = {n: records[n] for n in names if is_time_field(n) and records[n].ndim == 1}
    return Cloud(points, times)


def read_bin(path: Path, columns: int = KITTI_COLUMNS) -> NDArray[np.float64]:
    """Read the (N, 3) points of a BIN: rows of float32, x y z first; KITTI's have intensity as well.

    Raises:
        SourceError: the size isn't that of whole points.
    """
    if (size := path.stat().st_size) % (4 * columns):
        raise SourceError(
            f"{path} is damaged: {size} bytes aren't whole points of {columns} float32 columns"
        )
    return np.fromfile(path, dtype="<f4").reshape(-1, columns)[:, :3].astype(np.float64)
