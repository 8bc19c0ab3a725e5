"""A list of scan files with stamps, read one by one: what folder-like sources share."""

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.scan import NANOSECONDS, Scan
from lifelong_slam.sources.assembly import assemble
from lifelong_slam.sources.pointcloud2 import Cloud

_log = logging.getLogger(__name__)

NOMINAL_RATE = 10  # scans a second where no times are given
_EPOCH_DIGITS = (10, 13, 16, 19)  # of seconds, ms, us and ns since 1970
_EPOCH = ("0946684800", "4102444800")  # seconds: years 2000 to 2100


def nominal_stamps(count: int, where: str) -> NDArray[np.int64]:
    """Return (count,) stamps at the nominal rate from zero, and say so in the log."""
    _log.warning("%s: no times given: stamps are nominal, %d scans a second", where, NOMINAL_RATE)
    return np.arange(count, dtype=np.int64) * (NANOSECONDS // NOMINAL_RATE)


def stamps_in_names(files: Sequence[Path]) -> NDArray[np.int64] | None:
    """Return (N,) stamps in ns from names like nuScenes': the time since 1970 as the last number.

    It may count seconds (with a point or an underscore before decimals), ms, us or ns. None where not
    every name has one, or they aren't in order of time.
    """
    stamps = [_stamp_in_name(file.name) for file in files]
    if any(stamp is None for stamp in stamps):
        return None
    found = np.array(stamps, dtype=np.int64)
    return found if (np.diff(found) > 0).all() else None


def _stamp_in_name(name: str) -> int | None:
    numbers = re.findall(r"(?<!\d)\d{10}[._]\d{1,9}(?!\d)|\d+", name)
    whole, *decimals = re.split(r"[._]", numbers[-1]) if numbers else ("",)
    digits = whole + "".join(decimals)
    if len(whole) not in _EPOCH_DIGITS or not _EPOCH[0] <= digits[:10] < _EPOCH[1]:
        return None
    return int(digits[:19].ljust(19, "0"))


def read_scans(
    files: Sequence[Path],
    stamps: NDArray[np.int64],
    read: Callable[[Path], Cloud],
    where: str,
    damaged: list[str],
    scale: float = 1.0,
) -> Iterator[Scan]:
    """Yield the scans of the files; damaged ones are logged, listed in `damaged` and left out.

    `scale` is the length in metres of one unit of the files' coordinates.

    Raises:
        SourceError: not one file could be read.
    """
    damaged.clear()
    yield from assemble(_readable(files, stamps, read, damaged), where, scale)
    if damaged:
        _log.warning("%s: %d of %d files left out as damaged", where, len(damaged), len(files))
    if len(damaged) == len(files):
        raise SourceError(
            f"{where}: not one of its {len(files)} scan files can be read; first: {damaged[0]}"
        )


def _readable(
    files: Sequence[Path],
    stamps: NDArray[np.int64],
    read: Callable[[Path], Cloud],
    damaged: list[str],
) -> Iterator[tuple[int, Cloud]]:
    for path, stamp in zip(files, stamps.tolist(), strict=True):
        try:
            cloud = read(path)
        except (SourceError, OSError) as error:
            damaged.append(str(error))
            _log.warning("scan left out: %s", error)
            continue
        yield stamp, cloud
