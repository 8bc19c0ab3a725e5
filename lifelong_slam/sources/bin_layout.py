"""How many float32 columns a folder's BIN files have: four in KITTI, five in nuScenes, and others.

The files don't say. Two things tell. Sizes must be those of whole points, which is weak: the number of
points may divide as well. And in the right number of columns each column holds one quantity (x, y, z,
intensity, ring), while in a wrong one each holds a mixture of all. So the *mutual information* between a
value's column and its size is highest for the right number; it is near zero for numbers that share no
factor with it.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.sources.pointcloud2 import share_of_lengths

_log = logging.getLogger(__name__)

KITTI_COLUMNS = 4
_FEWEST, _MOST = 3, 10
_FILES = 10  # to decide from
_VALUES = 25_200  # of each file: whole points of any number of columns
_BINS = 16
_NOTHING = 0.05  # nats; mixtures have 0.04 at most, real points at least 0.17
# What a multiple of the right number adds is little, as it splits columns that hold the same.
_AS_GOOD = 0.8


def find_columns(files: Sequence[Path], where: str) -> int:
    """Return the number of columns of a folder's BIN files; other than KITTI's four is logged.

    Raises:
        SourceError: several numbers are possible, not four, and the values tell none of them; or the
            values aren't float32.
    """
    sizes = np.array([path.stat().st_size for path in files])
    whole = {k: float(np.mean(sizes % (4 * k) == 0)) for k in range(_FEWEST, _MOST + 1)}
    possible = [k for k, share in whole.items() if share > 0.5]  # some files may be damaged
    if not possible or not sizes.any():
        return KITTI_COLUMNS
    values = [np.fromfile(path, "<f4", _VALUES) for path in files[:: -(-len(files) // _FILES)]]
    columns = _most_telling(values, possible, where)
    points = [file[: len(file) // columns * columns].reshape(-1, columns)[:, :3] for file in values]
    if share_of_lengths(np.concatenate(points).ravel()) < 0.9:
        raise SourceError(
            f"{where}: its BIN files hold no float32 coordinates; of other kinds, convert them first"
        )
    if columns != KITTI_COLUMNS:
        _log.warning(
            "%s: read as float32 in %d columns, as fits sizes and values; if that is wrong, give "
            "scenario.columns",
            *(where, columns),
        )
    return columns


def _most_telling(
    values: Sequence[NDArray[np.float32]], possible: Sequence[int], where: str
) -> int:
    if len(possible) == 1:
        return possible[0]
    information = {k: _information(values, k) for k in possible}
    best = max(information.values())
    if best < _NOTHING and KITTI_COLUMNS in possible:
        return KITTI_COLUMNS
    if best < _NOTHING:
        raise SourceError(
            f"{where}: its BIN files may have {', '.join(map(str, possible))} columns of float32: "
            "say how many with scenario.columns"
        )
    return next(k for k in possible if information[k] >= _AS_GOOD * best)


def _information(files: Sequence[NDArray[np.float32]], columns: int) -> float:
    """Return the mutual information of column and value in nats, corrected for few values.

    Correction: G. Miller, "Note on the bias of information estimates" (1955).
    """
    values = np.nan_to_num(np.concatenate(files))
    column = np.concatenate([np.arange(len(file)) % columns for file in files])
    inner = np.quantile(values, np.linspace(0, 1, _BINS + 1)[1:-1])
    bins = np.searchsorted(np.unique(inner), values, side="right")
    joint = np.bincount(column * _BINS + bins, minlength=columns * _BINS).reshape(columns, -1)
    share = joint / len(values)
    independent = share.sum(axis=1, keepdims=True) * share.sum(axis=0)
    seen = joint > 0
    information = np.sum(share[seen] * np.log(share[seen] / independent[seen]))
    return float(information - (columns - 1) * (len(inner) - 1) / (2 * len(values)))
