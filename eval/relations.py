"""True relative poses between instants of a run (Kuemmerle et al. 2009)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Relations:
    """N relations between two instants each.

    Attributes:
        stamps: (N, 2) seconds.
        T_first_second: (N, 4, 4) true poses of the second instant in the frame of the first, metres.
    """

    stamps: Array
    T_first_second: Array
