"""What every source's scans go through before SLAM: bad input is counted, logged, survived."""

import logging
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.scan import NANOSECONDS, Scan

_log = logging.getLogger(__name__)

EMPTY = "empty"
REPEATED = "stamp repeated"
BACKWARDS = "stamp ran back"
AHEAD = "stamp jumped ahead"
STUMP = "sweep ended before the last one"
UNREADABLE = "unreadable"

GAP_FACTOR = 3.0
_JUMP = 10 * NANOSECONDS
_INTERVALS = 100  # how many of the latest intervals the usual one is the median of
_MIN_INTERVALS = 5


@dataclass(slots=True)
class InputCounts:
    """What was read, and what of it was left out.

    Attributes:
        read: scans that came from the source.
        used: scans that were passed on.
        skipped: scans left out, by reason; those that the source itself could not read among them
            (from its attribute `unreadable`, where it has one), though they don't count as read.
        dropped_points: points left out for coordinates or times that are NaN or infinite.
        gaps: intervals longer than `GAP_FACTOR` times the usual one.
        reordered: scans that the source put back in order (from its attribute `reordered`, where it
            has one).
    """

    read: int = 0
    used: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    dropped_points: int = 0
    gaps: int = 0
    reordered: int = 0

    def summary(self) -> str:
        """Return one line for the end of a run."""
        parts = [f"{self.used} of {self.read} scans used"]
        parts += [f"{count} skipped ({reason})" for reason, count in sorted(self.skipped.items())]
        if self.dropped_points:
            parts.append(f"{self.dropped_points} non-finite points dropped")
        if self.gaps:
            parts.append(f"{self.gaps} gaps")
        if self.reordered:
            parts.append(f"{self.reordered} put back in order")
        return ", ".join(parts)


def clean(source: Iterable[Scan], counts: InputCounts) -> Iterator[Scan]:
    """Yield scans that are finite, not empty and strictly later than the one before.

    `counts` is kept up to date while scans are drawn. Each kind of trouble is logged as a warning
    when first met. Gaps in time are only noted: they are for SLAM to handle.

    Raises:
        SourceError: the source ended and not one scan was usable.
    """
    try:
        yield from _cleaned(source, counts)
    finally:
        if unreadable := getattr(source, "unreadable", 0):
            counts.skipped[UNREADABLE] = unreadable
        counts.reordered = getattr(source, "reordered", 0)
    if counts.used == 0:
        where = getattr(source, "path", "this recording")
        raise SourceError(f"no usable scans in {where}: {counts.summary()}")


def _cleaned(source: Iterable[Scan], counts: InputCounts) -> Iterator[Scan]:
    intervals: deque[int] = deque(maxlen=_INTERVALS)
    last: Scan | None = None
    for scan, after in _with_next(source):
        counts.read += 1
        scan = _finite(scan, counts)
        if reason := _why_skip(scan, last, after):
            _skip(scan, reason, counts)
            continue
        if last is not None:
            _note_gap(scan, last.stamp, intervals, counts)
        last = scan
        counts.used += 1
        yield scan


def _finite(scan: Scan, counts: InputCounts) -> Scan:
    """Drop points whose coordinates or times aren't finite, together with their times."""
    with np.errstate(over="ignore", invalid="ignore"):
        total = scan.points.sum() + (0.0 if scan.offsets is None else scan.offsets.sum())
    if np.isfinite(total):  # one pass over good data instead of three
        return scan
    keep: NDArray[np.bool_] = np.asarray(np.isfinite(scan.points).all(axis=1))
    if scan.offsets is not None:
        keep &= np.isfinite(scan.offsets)
    dropped = len(keep) - int(np.count_nonzero(keep))
    if dropped and not counts.dropped_points:
        _log.warning("scan %d has %d non-finite points: dropped", counts.read, dropped)
    counts.dropped_points += dropped
    offsets = None if scan.offsets is None else scan.offsets[keep]
    return Scan(scan.stamp, scan.points[keep], offsets)


def _with_next(source: Iterable[Scan]) -> Iterator[tuple[Scan, Scan | None]]:
    """Yield each scan with the one after it."""
    scan = None
    for after in source:
        if scan is not None:
            yield scan, after
        scan = after
    if scan is not None:
        yield scan, None


def _why_skip(scan: Scan, last: Scan | None, after: Scan | None) -> str | None:
    if len(scan.points) == 0:
        return EMPTY
    if last is not None and scan.stamp <= last.stamp:
        return REPEATED if scan.stamp == last.stamp else BACKWARDS
    if after is not None and scan.stamp - after.stamp > _JUMP:
        # one wrong stamp far ahead would turn all that follow into scans that ran back
        return AHEAD if last is None or after.stamp > last.stamp else None
    if last is not None and not _sweeps_on(scan, last):
        return STUMP
    return None


def _sweeps_on(scan: Scan, last: Scan) -> bool:
    """Tell whether a sweep's middle and end lie after those of the last: poses hold there."""
    return scan.middle_stamp > last.middle_stamp and scan.end_stamp > last.end_stamp


def _skip(scan: Scan, reason: str, counts: InputCounts) -> None:
    counts.skipped[reason] += 1
    if counts.skipped[reason] == 1:
        _log.warning("scan %d at %s s skipped: %s", counts.read, _seconds(scan), reason)


def _note_gap(scan: Scan, last: int, intervals: deque[int], counts: InputCounts) -> None:
    interval = scan.stamp - last
    if len(intervals) >= _MIN_INTERVALS and interval > GAP_FACTOR * float(np.median(intervals)):
        counts.gaps += 1
        if counts.gaps == 1:
            _log.warning(
                "a gap of %.3f s before the scan at %s s", interval / NANOSECONDS, _seconds(scan)
            )
    intervals.append(interval)


def _seconds(scan: Scan) -> str:
    seconds, nanoseconds = divmod(scan.stamp, NANOSECONDS)
    return f"{seconds}.{nanoseconds:09d}"
