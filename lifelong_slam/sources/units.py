"""Notices coordinates that can't be metres in the sensor's frame, by the ranges of the first scans."""

import logging
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.scan import Scan

_log = logging.getLogger(__name__)

_SCANS = 10
_LEAST_SHARE = 0.1  # of the points; a range that leaves fewer wasn't chosen for them
_NEAREST = 0.1  # metres; no LiDAR has a median range below
_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "feet": 0.3048}


def check_scale(scale: float) -> float:
    """Return the metres in one unit of a recording's coordinates.

    Raises:
        SourceError: it isn't a positive number.
    """
    if not 0 < scale < np.inf:
        raise SourceError(f"scale must be positive: metres in one unit, not {scale}")
    return scale


def check_units(scans: Iterable[Scan], max_range: float) -> Iterator[Scan]:
    """Pass scans on, if one of the first few has enough points within `max_range` metres.

    A unit can't be read off points: what lies at 500 may be in metres, seen from the air, or in
    millimetres on a table. What the sensor's settings leave of them can. So nothing is converted without
    being asked: an error says what other units would make of the ranges. Where most points lie beyond
    `max_range`, but not all, a warning says the same.

    Raises:
        SourceError: less than a tenth of the points lie within the range, in all of the first scans.
    """
    scans = iter(scans)
    held: list[Scan] = []
    for scan in islice(scans, _SCANS):
        held.append(scan)
        ranges = _ranges([scan])
        if len(ranges) and np.mean(ranges <= max_range) >= _LEAST_SHARE:
            break
    else:
        ranges = _ranges(held)
    _check_ranges(ranges, max_range)
    while held:
        yield held.pop(0)
    yield from scans


def _ranges(scans: Sequence[Scan]) -> NDArray[np.float64]:
    """Return (N,) distances in metres of the points that were measured."""
    ranges = [np.linalg.norm(scan.points, axis=1) for scan in scans]
    together = np.concatenate([np.empty(0), *ranges])
    return np.asarray(together[together > 0])


def _check_ranges(ranges: NDArray[np.float64], max_range: float) -> None:
    if len(ranges) == 0 or (median := float(np.median(ranges))) <= max_range:
        return
    within = float(np.mean(ranges <= max_range))
    message = (
        f"points lie at a median range of {median:.0f} m, {100 * within:.2g} % of them within "
        f"sensor.max_range = {max_range:g} m: {_suggestion(median, max_range)}"
    )
    if within < _LEAST_SHARE:
        raise SourceError(message)
    _log.warning("%s", message)


def _suggestion(median: float, max_range: float) -> str:
    """Say what would explain a median range beyond the largest one."""
    guesses = [
        f"{median * scale:.3g} m if they are in {unit} (scenario.scale={scale:g})"
        for unit, scale in _UNITS.items()
        if _NEAREST <= median * scale <= max_range
    ]
    if not guesses:
        return (
            "scans are needed in metres and in the sensor's own frame, not in that of a map (such "
            "as UTM)"
        )
    return f"{', '.join(guesses)}; if they are in metres, raise sensor.max_range"
