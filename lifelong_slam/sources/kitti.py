"""Scans of the KITTI data set: the odometry benchmark's layout and that of the raw drives."""

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError, did_you_mean
from lifelong_slam.geometry import invert
from lifelong_slam.scan import Scan
from lifelong_slam.sources.cloud_files import read_bin
from lifelong_slam.sources.natural_order import natural_order
from lifelong_slam.sources.pointcloud2 import Cloud
from lifelong_slam.sources.references import ordered_trajectory
from lifelong_slam.sources.scan_files import nominal_stamps, read_scans
from lifelong_slam.sources.text_files import read_poses, read_times
from lifelong_slam.trajectory import Trajectory

_log = logging.getLogger(__name__)

_SCAN_FOLDERS = ("velodyne", "velodyne_points/data")
_DIGITS = 19  # from which on a number may exceed int64
_TIME_FILES = ("times.txt", "velodyne_points/timestamps.txt")


class KittiSource:
    """One sequence or drive; its scans have no point times.

    Attributes:
        folder: the sequence's or drive's own folder.
        files: its scan files, in order.
        stamps: (N,) int64 ns of each file.
    """

    def __init__(self, path: str, sequence: str | int | None = None) -> None:
        """Find a sequence's scans and read its stamps.

        Args:
            path: the benchmark's root (with `sequences/`), a folder of raw drives, or the folder
                of one sequence or drive.
            sequence: such as "00" or "2011_09_26_drive_0005_sync"; None takes the only one.

        Raises:
            SourceError: the path holds no such sequence, or its times don't fit its scans.
        """
        self.folder = _find_sequence(Path(path), None if sequence is None else str(sequence))
        scans = _scan_folder(self.folder)
        self.files = sorted(scans.glob("*.bin"), key=natural_order) if scans else []
        if not self.files:
            raise SourceError(f"{scans} holds no .bin scans")
        self._damaged: list[str] = []
        self._rows = _row_numbers(self.files)
        self.stamps = self._read_stamps()

    def __len__(self) -> int:
        """Return the number of scan files."""
        return len(self.files)

    def __iter__(self) -> Iterator[Scan]:
        """Yield the scans; damaged files are logged, counted and left out.

        Raises:
            SourceError: not one file could be read.
        """
        yield from read_scans(self.files, self.stamps, _read_cloud, str(self.folder), self._damaged)

    @property
    def unreadable(self) -> int:
        """Number of damaged files met in the latest pass."""
        return len(self._damaged)

    def reference(self) -> Trajectory | None:
        """Return T_reference_sensor of the benchmark's poses, carried from camera to LiDAR.

        None where the sequence has no poses, or no calibration to carry them by.

        Raises:
            SourceError: the poses or the calibration are malformed.
        """
        path = self.folder.parent.parent / "poses" / f"{self.folder.name}.txt"
        calibration = self.folder / "calib.txt"
        if not path.is_file():
            return None
        if not calibration.is_file():
            _log.warning("%s has no calib.txt: its camera poses can't serve as reference", path)
            return None
        _, T_world_camera = read_poses(path)
        T_camera_lidar = _read_lidar_calibration(calibration)
        T_reference_lidar = invert(T_camera_lidar) @ T_world_camera @ T_camera_lidar
        rows = _rows_within(self._rows, len(T_reference_lidar), path)
        return ordered_trajectory(self.stamps, T_reference_lidar[rows], str(path))

    @property
    def T_base_sensor(self) -> NDArray[np.float64]:
        """The (4, 4) identity: the LiDAR's frame is the base."""
        return np.eye(4)

    def _read_stamps(self) -> NDArray[np.int64]:
        for name in _TIME_FILES:
            path = self.folder / name
            if path.is_file():
                stamps = read_times(path)
                return np.asarray(stamps[_rows_within(self._rows, len(stamps), path)])
        return nominal_stamps(len(self.files), str(self.folder))


def _read_cloud(path: Path) -> Cloud:
    return Cloud(read_bin(path), {})


def _scan_folder(folder: Path) -> Path | None:
    return next((folder / name for name in _SCAN_FOLDERS if (folder / name).is_dir()), None)


def _find_sequence(path: Path, sequence: str | None) -> Path:
    """Return the folder of the sequence meant."""
    if not path.is_dir():
        raise SourceError(f"no such folder: {path}")
    if _scan_folder(path):
        if sequence is not None and not path.name.endswith(sequence):
            raise SourceError(f"{path} is one sequence itself, not a folder with '{sequence}'")
        return path
    root = path / "sequences" if (path / "sequences").is_dir() else path
    found = {folder.name: folder for folder in sorted(root.iterdir()) if _scan_folder(folder)}
    if not found:
        raise SourceError(
            f"{path} is not a KITTI folder: expected sequences/XX/velodyne, or a drive with "
            "velodyne_points/data"
        )
    if sequence is None and len(found) == 1:
        return next(iter(found.values()))
    if sequence is None:
        raise SourceError(f"{path} has {len(found)} sequences; name one: {', '.join(found)}")
    name = sequence if sequence in found else sequence.zfill(2)
    if name not in found:
        raise SourceError(
            f"{path} has no sequence '{sequence}'.{did_you_mean(sequence, found)} "
            f"It has: {', '.join(found)}"
        )
    return found[name]


def _row_numbers(files: list[Path]) -> NDArray[np.int64]:
    """Return each file's row in times and poses: KITTI numbers files by it, and a few are lost."""
    if all(file.stem.isdecimal() and len(file.stem) < _DIGITS for file in files):
        return np.array([int(file.stem) for file in files], dtype=np.int64)
    return np.arange(len(files), dtype=np.int64)


def _rows_within(rows: NDArray[np.int64], count: int, path: Path) -> NDArray[np.int64]:
    if rows.max() >= count:
        raise SourceError(f"{path} has {count} rows, but the scans go up to number {rows.max()}")
    return rows


def _read_lidar_calibration(path: Path) -> NDArray[np.float64]:
    """Return T_camera_lidar (4, 4) from the `Tr:` row of a calib.txt."""
    for line in path.read_text(errors="replace").splitlines():
        name, _, values = line.partition(":")
        if name.strip() in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam"):
            try:
                T = np.vstack(
                    [np.array(values.split(), dtype=np.float64).reshape(3, 4), [0, 0, 0, 1]]
                )
            except ValueError as error:
                raise SourceError(f"{path}: its Tr row needs 12 numbers") from error
            return np.asarray(T, dtype=np.float64)
    raise SourceError(f"{path} has no Tr row (the LiDAR's pose in the camera's frame)")
