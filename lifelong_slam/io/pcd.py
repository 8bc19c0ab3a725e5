"""Point clouds as binary PCD."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.io.clouds import write_cloud

_HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""


def write_pcd(path: Path, points: NDArray[np.float32]) -> None:
    """Write (N, 3) points in metres as binary PCD with float32 x y z.

    Raises:
        ValueError: points are not (N, 3).
    """
    write_cloud(path, _HEADER, points)
