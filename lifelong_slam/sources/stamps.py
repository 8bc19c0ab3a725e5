"""The time of a message: its header's stamp, or its receive time where the stamp can't be right."""

import logging
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from statistics import median_low

import numpy as np

from lifelong_slam.errors import SourceError
from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.sources.headers import Arrival

_log = logging.getLogger(__name__)

_LATEST = 100  # messages that the usual lag of receive times behind stamps is the median of
_SHORTEST_INTERVAL = NANOSECONDS // 500
_LONGEST_INTERVAL = 10 * NANOSECONDS


class Stamps:
    """Gives the messages of one LiDAR their times.

    The first messages decide. Where their stamps are zero, mostly stand still, or advance as no LiDAR
    turns while receive times do (a wrong unit), every message is given its receive time. Else a stamp
    that is unset, or stands still while new data come, is replaced by the receive time, less what
    receive times usually are behind stamps. So are the first stamps as long as they are of another
    clock: drivers start before the clock is set. A clock that is set later on is for cleaning.
    """

    def __init__(self, first: Sequence[Arrival], where: str) -> None:
        """Decide by the first messages; `where` names the recording in the log.

        Raises:
            SourceError: neither stamps nor receive times tell the messages apart.
        """
        self._where = where
        self._step = _typical_step(first)
        self._fault = _fault(first, self._step)
        if self._fault and len(first) > 1 and self._step == 0:
            raise SourceError(
                f"{where}: headers {self._fault}, and receive times are all the same:"
                " nothing tells when the clouds were measured"
            )
        if self._fault:
            _log.warning("%s: headers %s: receive times used", where, self._fault)
        self._first_lags = [a.receive_time - a.header.stamp for a in first if a.header.stamp]
        times = [a.receive_time if self._fault else a.header.stamp for a in first]
        self.interval = _median([abs(b - a) for a, b in pairwise(times)])
        self.rewind()

    def rewind(self) -> None:
        """Begin again with the first message."""
        self._lags = deque(self._first_lags, maxlen=_LATEST)
        self._before: Arrival | None = None
        self._settled = False
        self._replaced = 0

    def time(self, message: Arrival) -> int:
        """Return the time of the next message in integer nanoseconds.

        Raises:
            ValueError: its stamp can't be right, and receive times are of no use.
        """
        before, self._before = self._before, message
        if self._fault:
            return message.receive_time
        fault = self._fault_of(message, before)
        if not fault:
            self._settled = True
            self._lags.append(message.receive_time - message.header.stamp)
            return message.header.stamp
        if not _plausible(self._step):
            raise ValueError(f"its header has {fault}")
        self._replaced += 1
        if self._replaced == 1:
            _log.warning(
                "%s: the header received at %.3f s has %s: there and wherever else, the receive time"
                " less the usual lag is used",
                *(self._where, message.receive_time / NANOSECONDS, fault),
            )
        return self._expected(message)

    def _fault_of(self, message: Arrival, before: Arrival | None) -> str:
        """Say what is wrong with one stamp, or nothing; simulated time may start at zero."""
        if not self._lags:
            return ""
        stamp = message.header.stamp
        off = abs(self._expected(message) - stamp) > _LONGEST_INTERVAL
        if off and (stamp == 0 or (not self._settled and _plausible(self._step))):
            return "no stamp" if stamp == 0 else "a stamp of another clock"
        if before is not None and _stands(before, message, self._step):
            return "the stamp of the one before"
        return ""

    def _expected(self, message: Arrival) -> int:
        return message.receive_time - median_low(self._lags)


def _fault(messages: Sequence[Arrival], step: float) -> str:
    """Say what is wrong with the stamps as a whole, or nothing."""
    if messages and not any(message.header.stamp for message in messages):
        return "hold no stamps"
    pairs = list(pairwise(messages))
    if pairs and np.mean([_stands(a, b, step) for a, b in pairs]) > 0.5:
        return "have stamps that stand still"
    received = _median([b.receive_time - a.receive_time for a, b in pairs])
    stamped = _median(
        [abs(b.header.stamp - a.header.stamp) for a, b in pairs if a.header.stamp != b.header.stamp]
    )
    if stamped and _plausible(received) and not _plausible(stamped):
        return (
            f"have stamps that advance by {stamped / NANOSECONDS:.3g} s"
            f" while {received / NANOSECONDS:.3g} s pass"
        )
    return ""


def _stands(before: Arrival, after: Arrival, step: float) -> bool:
    """Tell whether a stamp is that of the message before, though other data came after a while."""
    return (
        before.header.stamp == after.header.stamp
        and after.receive_time - before.receive_time >= step / 2
        and before.body != after.body  # not a message that was recorded twice
    )


def _typical_step(messages: Sequence[Arrival]) -> float:
    """Return the nanoseconds between the receive times of sweeps, even if these come in parts."""
    steps = [b.receive_time - a.receive_time for a, b in pairwise(messages)]
    return float(np.quantile(steps, 0.75)) if steps else 0.0


def _median(intervals: Sequence[int]) -> float:
    return float(np.median(intervals)) if intervals else 0.0


def _plausible(interval: float) -> bool:
    return _SHORTEST_INTERVAL <= interval <= _LONGEST_INTERVAL
