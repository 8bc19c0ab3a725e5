"""Point clouds as binary PLY."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.files import atomic_write

_HEADER = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
end_header
"""


def write_ply(path: Path, points: NDArray[np.float32]) -> None:
    """Write (N, 3) points in metres as binary PLY with float32 x y z.

    Raises:
        ValueError: points are not (N, 3).
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (N, 3), not {points.shape}")
    with atomic_write(path) as file:
        file.write(_HEADER.format(count=len(points)).encode())
        if len(points):
            file.write(np.ascontiguousarray(points, dtype="<f4").data)
