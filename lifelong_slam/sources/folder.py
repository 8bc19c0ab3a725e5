"""Scans from a folder of numbered PCD, PLY or BIN files."""

import logging
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.scan import Scan
from lifelong_slam.sources.bin_layout import KITTI_COLUMNS, find_columns
from lifelong_slam.sources.cloud_files import SUFFIXES, read_cloud
from lifelong_slam.sources.natural_order import natural_order
from lifelong_slam.sources.references import ordered_trajectory
from lifelong_slam.sources.scan_files import nominal_stamps, read_scans, stamps_in_names
from lifelong_slam.sources.text_files import read_poses, read_times
from lifelong_slam.sources.units import check_scale
from lifelong_slam.trajectory import Trajectory

_log = logging.getLogger(__name__)


class FolderSource:
    """Scan files in natural order; the sensor's frame is the base."""

    def __init__(
        self,
        path: str,
        times: str | None = None,
        poses: str | None = None,
        columns: int | None = None,
        scale: float = 1.0,
    ) -> None:
        """Find the files, and read their times and reference poses.

        Args:
            path: a folder of .pcd, .ply or .bin files, or a folder around one such.
            times: a file of seconds, a line a scan; None takes TUM rows' stamps, one a scan, then
                those in the files' names, then 10 scans a second.
            poses: reference T_reference_sensor of each scan, KITTI 3x4 or TUM rows. TUM rows carry
                their stamps: any number of them where scans have their own.
            columns: how many float32 a point of a .bin file has, x y z first; None finds out.
            scale: metres in one unit of the coordinates.

        Raises:
            SourceError: a path is missing, no scans are there, counts don't match, or columns or
                scale make no sense.
        """
        self.path = Path(path)
        self.files = find_scan_files(self.path)
        self._scale = check_scale(scale)
        self._columns = self._find_columns(columns)
        self._damaged: list[str] = []
        own, rows = (None, None) if poses is None else read_poses(Path(poses))
        self.stamps = self._read_stamps(times, own, str(poses))
        if own is None and rows is not None:
            _check_count("poses", Path(poses or ""), len(rows), len(self.files))
            own = self.stamps
        self._reference = None
        if own is not None and rows is not None:
            self._reference = ordered_trajectory(own, rows, str(poses))

    def __len__(self) -> int:
        """Return the number of scan files."""
        return len(self.files)

    def __iter__(self) -> Iterator[Scan]:
        """Yield the scans; damaged files are logged, counted and left out.

        Raises:
            SourceError: not one file could be read.
        """
        read = partial(read_cloud, columns=self._columns)
        yield from read_scans(
            self.files, self.stamps, read, str(self.path), self._damaged, self._scale
        )

    @property
    def unreadable(self) -> int:
        """Number of damaged files met in the latest pass."""
        return len(self._damaged)

    def reference(self) -> Trajectory | None:
        """Return the poses given beside the scans, or None."""
        return self._reference

    @property
    def T_base_sensor(self) -> NDArray[np.float64]:
        """The (4, 4) identity: files don't say where the sensor sits."""
        return np.eye(4)

    def _find_columns(self, given: int | None) -> int:
        """Return the number of columns of BIN files; of no meaning for others."""
        if given is not None and given < 3:
            raise SourceError(f"columns must be at least 3, for x y z, not {given}")
        if given is not None or self.files[0].suffix.lower() != ".bin":
            return given or KITTI_COLUMNS
        return find_columns(self.files, str(self.path))

    def _read_stamps(
        self, times: str | None, own: NDArray[np.int64] | None, poses: str
    ) -> NDArray[np.int64]:
        """Return (N,) stamps in ns of the scans, `own` being those of the poses."""
        count = len(self.files)
        if times is not None:
            stamps = read_times(Path(times))
            _check_count("times", Path(times), len(stamps), count)
            return stamps
        named = stamps_in_names(self.files)
        if named is not None and (own is None or len(own) != count):
            _log.info("%s: no times given: stamps are those in the files' names", self.path)
            return named
        if own is not None:
            _check_count("TUM poses without times", Path(poses), len(own), count)
            _log.info("%s: no times given: stamps are those of the poses", self.path)
            return own
        return nominal_stamps(count, str(self.path))


def find_scan_files(path: Path) -> list[Path]:
    """Return a folder's scan files of the most frequent kind in natural order.

    Raises:
        SourceError: the path is no folder, or no scan files are there.
    """
    if not path.exists():
        raise SourceError(f"no such folder: {path}")
    if not path.is_dir():
        raise SourceError(f"{path} is a file: expected a folder of {', '.join(SUFFIXES)} files")
    files = _scan_files(path)
    if not files:
        inner = [folder for folder in sorted(path.iterdir()) if folder.is_dir()]
        inner = [folder for folder in inner if _scan_files(folder)]
        if len(inner) != 1:
            raise SourceError(f"{path} holds no scans: expected {', '.join(SUFFIXES)} files")
        _log.info("%s: scans taken from its folder %s", path, inner[0].name)
        files = _scan_files(inner[0])
    (suffix, count), *others = Counter(file.suffix.lower() for file in files).most_common()
    if others:
        _log.warning(
            "%s: %d %s files read, the %d others left", path, count, suffix, len(files) - count
        )
    return sorted((f for f in files if f.suffix.lower() == suffix), key=natural_order)


def _scan_files(folder: Path) -> list[Path]:
    return [f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and f.is_file()]


def _check_count(what: str, path: Path, have: int, scans: int) -> None:
    if have != scans:
        raise SourceError(
            f"{path} has {have} {what}, but there are {scans} scans: one each is needed"
        )
