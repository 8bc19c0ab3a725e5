"""Point clouds as binary PLY."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.io.clouds import write_cloud

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
    write_cloud(path, _HEADER, points)
