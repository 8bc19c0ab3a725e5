"""Truth beside a campaign's bag, which SLAM never reads: labels and surface points.

Files of a campaign's folder:
- `truth.tum`: T_world_base at 100 Hz (`lifelong_slam.trajectory.read_tum`).
- `labels_<sensor>.u8`: one byte a point in the order of the bag, all sweeps in a row.
- `labels_<sensor>.npz`: `stamps` (S,) int64 header stamps in nanoseconds and `starts` (S + 1,)
  int64, so that sweep i has the bytes `starts[i]` to `starts[i + 1]`.
- `surface.ply`: points, with normals, on the true static surface where the rig can see it; world
  frame, metres.
- `world.ply`: the whole static surface as triangles, for distances that no sampling blurs.
- `movable.npz`: with sessions only; what changes between them (`lifelong_slam.simulation.movables`).
"""

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError


class LabelWriter:
    """Writes the labels of one sensor, sweep by sweep; use as a context manager."""

    def __init__(self, folder: Path, sensor: str) -> None:
        self._path = folder / f"labels_{sensor}"
        self._file: BinaryIO = self._path.with_suffix(".u8").open("wb")
        self._stamps: list[int] = []
        self._starts = [0]

    def add(self, stamp: int, labels: NDArray[np.uint8]) -> None:
        """Append the labels (N,) of the sweep whose header has `stamp`."""
        self._file.write(labels.tobytes())
        self._stamps.append(stamp)
        self._starts.append(self._starts[-1] + len(labels))

    def __enter__(self) -> "LabelWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()
        if kind is None:
            np.savez(
                self._path.with_suffix(".npz"),
                stamps=np.array(self._stamps, dtype=np.int64),
                starts=np.array(self._starts, dtype=np.int64),
            )


@dataclass(frozen=True, slots=True)
class Labels:
    """True labels of every point of one sensor.

    Attributes:
        stamps: (S,) header stamps in nanoseconds.
        starts: (S + 1,) index of each sweep's first label.
        values: labels of all points, see `lifelong_slam.simulation.returns.Label`.
    """

    stamps: NDArray[np.int64]
    starts: NDArray[np.int64]
    values: NDArray[np.uint8]

    def of_sweep(self, index: int) -> NDArray[np.uint8]:
        """Return the labels (N,) of a sweep's points in the bag's order."""
        return self.values[self.starts[index] : self.starts[index + 1]]


def read_labels(folder: Path, sensor: str) -> Labels:
    """Read the labels of one sensor; they stay on disk until used.

    Raises:
        SourceError: the folder has no labels of that sensor.
    """
    index, data = folder / f"labels_{sensor}.npz", folder / f"labels_{sensor}.u8"
    if not index.is_file() or not data.is_file():
        raise SourceError(f"{folder} has no labels of sensor '{sensor}'")
    with np.load(index, allow_pickle=False) as arrays:
        stamps, starts = arrays["stamps"], arrays["starts"]
    if not starts[-1]:
        return Labels(stamps, starts, np.zeros(0, dtype=np.uint8))
    return Labels(stamps, starts, np.memmap(data, dtype=np.uint8, mode="r"))


def write_points_ply(path: Path, points: NDArray[np.float32]) -> None:
    """Write (N, 6) points and normals as binary PLY."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"element vertex {len(points)}\n{properties}"
    _write_ply(path, header, points.astype("<f4").tobytes())


def write_mesh_ply(path: Path, triangles: NDArray[np.float64]) -> None:
    """Write (M, 3, 3) triangles as binary PLY."""
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = np.arange(3 * len(triangles)).reshape(-1, 3)
    header = (
        f"element vertex {3 * len(triangles)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    )
    _write_ply(path, header, triangles.astype("<f4").tobytes() + faces.tobytes())


def _write_ply(path: Path, elements: str, data: bytes) -> None:
    header = f"ply\nformat binary_little_endian 1.0\n{elements}end_header\n"
    path.write_bytes(header.encode() + data)
