"""The small text files that lie beside scans: times and poses."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.geometry import from_quaternion
from lifelong_slam.scan import MOST_STAMP, NANOSECONDS
from lifelong_slam.trajectory import parse_seconds

_FAR_FROM_ROTATION = 0.01


def read_times(path: Path) -> NDArray[np.int64]:
    """Read (N,) stamps in ns: a line a scan, seconds or ``YYYY-mm-dd HH:MM:SS.fffffffff`` UTC.

    Raises:
        SourceError: the file is missing, or a line is neither.
    """
    return np.array([_stamp(path, number, line) for number, line in _lines(path)], dtype=np.int64)


def read_poses(path: Path) -> tuple[NDArray[np.int64] | None, NDArray[np.float64]]:
    """Read KITTI rows (12 numbers) or TUM rows (8 numbers).

    Returns:
        (N,) stamps in ns, None for KITTI rows, and (N, 4, 4) poses.

    Raises:
        SourceError: the file is missing, empty, or rows aren't of one of the two kinds.
    """
    rows = [(number, line.replace(",", " ").split()) for number, line in _lines(path)]
    columns = len(rows[0][1]) if rows else 0
    if columns not in (8, 12):
        raise SourceError(
            f"{path} holds no poses: each row needs 12 numbers (KITTI 3x4) or 8 (TUM), "
            f"its first has {columns}"
        )
    values = np.array([_numbers(path, number, row, columns) for number, row in rows])
    if columns == 12:
        return None, _from_kitti(path, values)
    try:
        poses = from_quaternion(values[:, 1:4], values[:, 4:])
    except ValueError as error:
        raise SourceError(f"{path} holds a quaternion of length zero") from error
    return np.array([_stamp(path, number, row[0]) for number, row in rows], np.int64), poses


def _stamp(path: Path, number: int, text: str) -> int:
    try:
        return _date(text) if ":" in text else parse_seconds(text)
    except ValueError:
        raise SourceError(
            f"{path}, line {number}: '{text[:40]}' is not a time in seconds"
        ) from None


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return line numbers and lines without empty ones and comments."""
    if not path.is_file():
        raise SourceError(f"no such file: {path}")
    try:
        lines = [line.strip() for line in path.read_text().splitlines()]
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not a text file") from error
    return [(n, line) for n, line in enumerate(lines, 1) if line and not line.startswith("#")]


def _numbers(path: Path, number: int, row: list[str], columns: int) -> list[float]:
    try:
        values = [float(value) for value in row]
    except ValueError:
        values = []
    if len(values) != columns or not np.isfinite(values).all():
        raise SourceError(f"{path}, line {number}: expected {columns} finite numbers")
    return values


def _from_kitti(path: Path, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Build (N, 4, 4) poses of (N, 12) rows; few printed digits are rounded to a true rotation."""
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :] = values.reshape(-1, 3, 4)
    U, _, Vt = np.linalg.svd(poses[:, :3, :3])
    nearest = U @ Vt
    off = np.abs(nearest - poses[:, :3, :3]).max(axis=(1, 2)) > _FAR_FROM_ROTATION
    off |= np.linalg.det(nearest) < 0
    if off.any():
        raise SourceError(
            f"{path}: pose {int(np.argmax(off)) + 1} is not a rotation and a position"
        )
    poses[:, :3, :3] = nearest
    return poses


def _date(text: str) -> int:
    whole, _, fraction = text.partition(".")
    moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    stamp = int(moment.timestamp()) * NANOSECONDS + int((fraction + "0" * 9)[:9])
    if abs(stamp) > MOST_STAMP:
        raise ValueError(f"{text} is no time of a recording")
    return stamp
