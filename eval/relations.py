"""True relative poses between instants of a run (Kuemmerle et al. 2009)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eval.text_table import read_table

Array = NDArray[np.float64]

_COLUMNS = 8


@dataclass(frozen=True, slots=True)
class Relations:
    """N relations between two instants each.

    Attributes:
        stamps: (N, 2) seconds.
        T_first_second: (N, 4, 4) true poses of the second instant in the frame of the first, metres.
    """

    stamps: Array
    T_first_second: Array


def read_relations(path: Path) -> Relations:
    """Read ``stamp1 stamp2 x y z roll pitch yaw`` a line, in seconds, metres and radians.

    The angles are those of rotations about the fixed axes x, y and z, one after the other.

    Raises:
        FileError: the file is missing, empty or malformed, or holds NaN.
    """
    rows = read_table(path, "file of relations", _COLUMNS)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("xyz", rows[:, 5:]).as_matrix()
    T[:, :3, 3] = rows[:, 2:5]
    return Relations(rows[:, :2], T)
