"""A trajectory: stamped poses, and the TUM text format that carries them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.files import atomic_write
from lifelong_slam.geometry import from_quaternion, interpolate, to_quaternion
from lifelong_slam.scan import MOST_STAMP, NANOSECONDS


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Stamped poses in order of time.

    Attributes:
        stamps: (N,) int64 nanoseconds, strictly increasing.
        poses: (N, 4, 4) float64, T_map_body.
    """

    stamps: NDArray[np.int64]
    poses: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check shapes and order.

        Raises:
            ValueError: shapes disagree, or the stamps don't increase.
        """
        if self.stamps.ndim != 1 or self.poses.shape != (len(self.stamps), 4, 4):
            raise ValueError(f"{self.stamps.shape} stamps do not fit {self.poses.shape} poses")
        if np.any(np.diff(self.stamps) <= 0):
            raise ValueError("stamps must increase strictly")

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def positions(self) -> NDArray[np.float64]:
        """(N, 3) positions in metres."""
        return self.poses[:, :3, 3]

    @property
    def length(self) -> float:
        """Length of the path in metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def at(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Interpolate (M, 4, 4) poses at (M,) stamps along geodesics.

        Raises:
            ValueError: a stamp lies outside the trajectory, or the trajectory has no two poses.
        """
        if len(self) < 2:
            raise ValueError("interpolation needs at least two poses")
        if len(stamps) and (stamps.min() < self.stamps[0] or stamps.max() > self.stamps[-1]):
            raise ValueError("stamps lie outside the trajectory")
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, len(self) - 1)
        gap = (self.stamps[after] - self.stamps[after - 1]).astype(np.float64)
        fraction = (stamps - self.stamps[after - 1]) / gap
        return interpolate(self.poses[after - 1], self.poses[after], fraction)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write ``stamp[s] x y z qx qy qz qw`` rows, to the nanosecond and in full precision."""
    quaternions = to_quaternion(trajectory.poses)
    with atomic_write(path) as file:
        for stamp, position, quaternion in zip(
            trajectory.stamps.tolist(), trajectory.positions, quaternions, strict=True
        ):
            values = " ".join(repr(float(v)) for v in (*position, *quaternion))
            file.write(f"{format_seconds(stamp)} {values}\n".encode())


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory; `#` starts a comment.

    Raises:
        SourceError: the file is missing, has no rows, or a row is not 8 numbers.
    """
    if not path.is_file():
        raise SourceError(f"no such trajectory file: {path}")
    try:
        lines = path.read_text().splitlines()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not a TUM trajectory: it is not text") from error
    rows = [line.split() for line in lines if line.strip()]
    rows = [row for row in rows if not row[0].startswith("#")]
    if not rows or any(len(row) != 8 for row in rows):
        raise SourceError(f"{path} is not a TUM trajectory: each row needs 8 numbers")
    try:
        values = np.array([[float(v) for v in row[1:]] for row in rows])
        stamps = np.array([parse_seconds(row[0]) for row in rows], dtype=np.int64)
        return Trajectory(stamps, from_quaternion(values[:, :3], values[:, 3:]))
    except ValueError as error:
        raise SourceError(f"{path} is not a TUM trajectory: {error}") from error


def format_seconds(stamp: int) -> str:
    """Turn nanoseconds into decimal seconds with nine digits, without a float's loss of digits."""
    seconds, nanoseconds = divmod(abs(stamp), NANOSECONDS)
    return f"{'-' if stamp < 0 else ''}{seconds}.{nanoseconds:09d}"


def parse_seconds(text: str) -> int:
    """Turn decimal seconds into nanoseconds without a float's loss of digits.

    Raises:
        ValueError: it is no number, or beyond what int64 nanoseconds hold (292 years either way).
    """
    if "e" in text.lower():
        seconds = float(text)
        if not abs(seconds) * NANOSECONDS < MOST_STAMP:
            raise ValueError(f"{text} is no time in seconds")
        return round(seconds * NANOSECONDS)
    whole, _, fraction = text.partition(".")
    sign = -1 if whole.startswith("-") else 1
    stamp = int(whole or "0") * NANOSECONDS + sign * int((fraction + "000000000")[:9])
    if abs(stamp) > MOST_STAMP:
        raise ValueError(f"{text} s are more than 292 years")
    return stamp
