"""Scans of several LiDARs: what all of them measured during one turn."""

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.scan import NANOSECONDS, Scan

_TURN = 0.9  # of the time from sweep to sweep: what begins later belongs to the next turn


def join_sweeps(sweeps: Iterable[tuple[str, Scan]], turn: Callable[[], float]) -> Iterator[Scan]:
    """Join sweeps that begin within one turn to one scan, with the stamp of the first to come.

    Odometry needs scans that see the same things and aren't taken at the same time: LiDARs that look
    in different directions have nothing to register against each other, and two poses a millisecond
    apart give no velocity. A sweep that was recorded twice isn't joined, but left for cleaning.

    Args:
        sweeps: LiDAR and sweep, in the order they came, all in one frame.
        turn: returns what is known by then: nanoseconds from sweep to sweep of the slowest LiDAR;
            0 joins nothing.
    """
    group: dict[tuple[str, int], Scan] = {}
    for lidar, sweep in sweeps:
        first = next(iter(group.values()), sweep)
        over = abs(sweep.stamp - first.stamp) >= _TURN * turn()
        if group and (over or (lidar, sweep.stamp) in group):
            yield _joined(list(group.values()))
            group.clear()
        group[lidar, sweep.stamp] = sweep
    if group:
        yield _joined(list(group.values()))


def _joined(sweeps: Sequence[Scan]) -> Scan:
    if len(sweeps) == 1:
        return sweeps[0]
    stamp = sweeps[0].stamp
    return Scan(
        stamp,
        np.concatenate([sweep.points for sweep in sweeps]),
        np.concatenate([_offsets(sweep, stamp) for sweep in sweeps]),
    )


def _offsets(sweep: Scan, stamp: int) -> NDArray[np.float64]:
    """Return the seconds of a sweep's points from `stamp`; those of its own without point times."""
    own = np.zeros(len(sweep.points)) if sweep.offsets is None else sweep.offsets
    return own + (sweep.stamp - stamp) / NANOSECONDS
