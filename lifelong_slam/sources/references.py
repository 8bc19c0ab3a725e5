"""References: the poses that a recording brings along, as a trajectory."""

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.trajectory import Trajectory

_log = logging.getLogger(__name__)


def ordered_trajectory(
    stamps: Sequence[int] | NDArray[np.int64],
    poses: Sequence[NDArray[np.float64]] | NDArray[np.float64],
    where: str,
) -> Trajectory:
    """Sort (N,) stamps with their (N, 4, 4) poses and keep the first of equal stamps.

    Raises:
        SourceError: there are no poses.
    """
    if len(stamps) == 0:
        raise SourceError(f"{where} holds no poses to use as a reference")
    unique, first = np.unique(np.asarray(stamps, dtype=np.int64), return_index=True)
    if len(unique) < len(stamps):
        _log.warning(
            "%s: %d poses with a stamp seen before dropped", where, len(stamps) - len(unique)
        )
    return Trajectory(unique, np.asarray(poses, dtype=np.float64)[first])
