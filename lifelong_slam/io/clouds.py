"""Point clouds as a header of text and then float32 x y z, as PLY and PCD have them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.files import atomic_write


def write_cloud(path: Path, header: str, points: NDArray[np.float32]) -> None:
    """Write a header with `{count}` for the number of points, and (N, 3) points in metres.

    Raises:
        ValueError: points are not (N, 3).
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (N, 3), not {points.shape}")
    with atomic_write(path) as file:
        file.write(header.format(count=len(points)).encode())
        if len(points):
            file.write(np.ascontiguousarray(points, dtype="<f4").data)
