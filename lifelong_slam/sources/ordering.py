"""Scans that come late, put back where they belong."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from lifelong_slam.scan import NANOSECONDS, Scan

_REACH = 4  # scans, and usual intervals, by which a scan may come late
_LATEST = 10 * NANOSECONDS
_INTERVALS = 20  # how many of the latest stamps tell the usual interval
_ROOM = 0.6  # of the usual interval: least distance from neighbours


def in_order(scans: Iterable[Scan], note_late: Callable[[Scan], None]) -> Iterator[Scan]:
    """Yield scans sorted by their stamps, as far as a few scans' wait allows.

    A scan that comes behind later ones is put back where it is missing: where there is room for it
    between two others. After a clock was set back, stamps fall between or on those there are already.
    Such scans stay where they came, for cleaning to leave out.

    Args:
        scans: in the order they came.
        note_late: told of each scan that is put back.
    """
    passed: deque[int] = deque(maxlen=_INTERVALS)
    waiting: list[Scan] = []
    for scan in scans:
        place = _place(scan.stamp, waiting)
        if place < len(waiting) and _fits(scan.stamp, place, waiting, passed):
            note_late(scan)
            waiting.insert(place, scan)
        else:
            waiting.append(scan)
        if len(waiting) > _REACH:
            passed.append(waiting[0].stamp)
            yield waiting.pop(0)
    yield from waiting


def _place(stamp: int, waiting: list[Scan]) -> int:
    """Return the place behind the last scan that isn't later."""
    place = len(waiting)
    while place and waiting[place - 1].stamp > stamp:
        place -= 1
    return place


def _fits(stamp: int, place: int, waiting: list[Scan], passed: deque[int]) -> bool:
    """Tell whether there is room for a scan between those before and behind a place."""
    known = sorted([*passed, *(scan.stamp for scan in waiting), stamp])
    usual = float(np.median(np.diff(known)))
    before = waiting[place - 1].stamp if place else passed[-1] if passed else -np.inf
    after = waiting[place].stamp
    near = after - stamp <= min(_REACH * usual, _LATEST)
    return near and min(stamp - before, after - stamp) >= _ROOM * usual
