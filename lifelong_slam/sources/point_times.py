"""Point times in the encodings that LiDAR drivers use, turned into seconds from the header stamp.

Drivers disagree on a point time's field name, datatype, unit (s, ms, us, ns) and origin (the
sweep's start or end, the Unix epoch, the sensor's own clock). `PointTimes` looks at the first
sweeps of a recording that tell, decides once, logs what it decided, and keeps to it.

The unit follows from two facts. A sweep lasts between 2 ms and 2 s: those bounds are a factor of
1000 apart, as are the units, so at most one unit makes a given span plausible. And times that count
from the epoch have the magnitude of the header stamp in one unit only.

Many drivers count in 32 bits without a sign. Where a header is later than the first point, or the
sensor's own counter overflows, such counts wrap around 2^32: in nanoseconds that is 4.29 s. A sweep is
shorter than half of it, so what lies further from its reference than a sweep lasts, but near to a
whole wrap, can only have wrapped (also where the count was copied to a wider field since).
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.scan import NANOSECONDS

_log = logging.getLogger(__name__)

Values = NDArray[Any]

SHORTEST_SWEEP = 0.002
LONGEST_SWEEP = 2.0

_UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
_WRAPS = tuple(2**32 * unit for unit in _UNITS.values())  # nanoseconds after which 32 bits wrap
_STEADY = 0.25  # seconds that sweeps may lie about relative to their stamps
_PRECISE_EPOCH = 1_000_000 * NANOSECONDS  # later stamps count from the epoch, not from power-up
_NAMES = (
    *("t", "time", "timestamp", "timestamps", "offsettime", "timeoffset", "toffset", "times"),
    *("pointtime", "pointtimeoffset", "relativetime", "deltatime", "ts", "stamp", "stamps"),
)
_UNIT_SUFFIXES = ("nsec", "usec", "msec", "sec", "ns", "us", "ms", "s")


@dataclass(frozen=True, slots=True)
class Sweep:
    """What the decision needs of one sweep.

    Attributes:
        stamp: header stamp in integer nanoseconds.
        times: candidate time fields, name to (N,) raw values, as read from the sensor.
        points: (N, 3) coordinates; those that are NaN or the origin are no returns, and drivers
            leave the times of such points unset.
    """

    stamp: int
    times: Mapping[str, Values]
    points: NDArray[np.float64]

    @property
    def returns(self) -> NDArray[np.bool_]:
        """(N,) bool, True where the sensor measured something."""
        returns = np.isfinite(self.points).all(axis=1) & self.points.any(axis=1)
        return np.asarray(returns)

    @property
    def tells(self) -> bool:
        """Whether a candidate field differs between returns, as times do."""
        returns = self.returns
        return any(_differ(_measured(values[returns])) for values in self.times.values())


@dataclass(frozen=True, slots=True)
class Encoding:
    """How one recording holds its point times.

    Attributes:
        field: name of the time field.
        unit: nanoseconds in one count of the field.
        origin: "header" (relative to the stamp), "epoch" (on the stamp's clock) or "sweep" (on a
            clock unrelated to the stamp: the sweep's first point is taken to hold the stamp).
    """

    field: str
    unit: int
    origin: str

    def offsets(self, values: Values, stamp: int) -> NDArray[np.float64]:
        """Return (N,) seconds from `stamp` of (N,) raw values; "sweep" counts from the least."""
        if len(values) == 0:
            return np.empty(0)
        if self.origin == "sweep":
            nanoseconds = _since_first(values, self.unit)
            return (nanoseconds - np.nanmin(nanoseconds)) / NANOSECONDS
        return _nanoseconds(values, self.unit, stamp if self.origin == "epoch" else 0) / NANOSECONDS


def is_time_field(name: str) -> bool:
    """Tell whether a field of this name holds point times: `t`, `time_stamp`, `offset_time_ns`."""
    bare = name.lower().replace("_", "")
    bases = [bare, *(bare.removesuffix(suffix) for suffix in _UNIT_SUFFIXES)]
    return any(base in _NAMES for base in bases)


@dataclass(slots=True)
class PointTimes:
    """Decodes the point times of one recording; `decide` first, then `offsets` for each sweep."""

    where: str
    encoding: Encoding | None = None
    decided: bool = False
    odd_sweeps: int = field(default=0)

    def decide(self, sweeps: Sequence[Sweep]) -> None:
        """Choose the encoding from some sweeps, or none for now; the first answer is logged."""
        names = sorted({name for sweep in sweeps for name in sweep.times}, key=_preference)
        for name in names:
            self.encoding = _find_encoding(name, [s for s in sweeps if name in s.times])
            if self.encoding:
                unit = next(key for key, value in _UNITS.items() if value == self.encoding.unit)
                origin = _ORIGINS[self.encoding.origin]
                _log.info("%s: point times in field '%s', %s %s", self.where, name, unit, origin)
                break
        else:
            self._warn_of_none(names)
        self.decided = True

    def _warn_of_none(self, names: Sequence[str]) -> None:
        if self.decided:
            return
        if not names:
            _log.warning("%s: no point times: sweeps can't be deskewed", self.where)
            return
        _log.warning(
            "%s: point times in %s are constant or span no plausible sweep: treated as absent, "
            "sweeps can't be deskewed",
            *(self.where, " and ".join(f"'{name}'" for name in names)),
        )

    def offsets(self, sweep: Sweep) -> NDArray[np.float64] | None:
        """Return (N,) seconds from the stamp, or None where this sweep's times are unusable.

        Times far from the rest of their sweep are NaN (unset times of points without return).
        """
        if self.encoding is None or self.encoding.field not in sweep.times:
            return None
        values = sweep.times[self.encoding.field]
        if self.encoding.origin == "sweep" and (returns := sweep.returns).any():
            values = np.where(returns, values, values[np.argmax(returns)])
        offsets = self.encoding.offsets(values, sweep.stamp)
        if len(offsets) == 0 or np.abs(offsets).max() <= LONGEST_SWEEP:  # False for a NaN too
            return offsets
        return self._without_outliers(offsets, sweep.returns)

    def _without_outliers(
        self, offsets: NDArray[np.float64], returns: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        usable = offsets[returns & np.isfinite(offsets)]
        middle = float(np.median(usable)) if len(usable) else np.inf
        if abs(middle) > LONGEST_SWEEP:
            self.odd_sweeps += 1
            if self.odd_sweeps == 1:
                _log.warning(
                    "%s: a sweep's point times lie %.3g s from its stamp: not deskewed",
                    *(self.where, middle),
                )
            return None
        return np.where(np.abs(offsets - middle) <= LONGEST_SWEEP, offsets, np.nan)


_ORIGINS = {
    "header": "from the header stamp",
    "epoch": "on the clock of the header stamps",
    "sweep": "on a clock of their own: the header stamp is taken as the time of the first point",
}


def _preference(name: str) -> tuple[int, str]:
    """Order candidate fields: plain names first, then by the alphabet."""
    bare = name.lower().replace("_", "")
    return (_NAMES.index(bare) if bare in _NAMES else len(_NAMES), name)


def _find_encoding(name: str, sweeps: Sequence[Sweep]) -> Encoding | None:
    """Return the encoding that makes the median sweep plausible, or None."""
    samples = [(s.stamp, _measured(s.times[name][s.returns])) for s in sweeps]
    samples = [(stamp, values) for stamp, values in samples if _differ(values)]
    if not samples:
        return None
    unit = _unit(samples)
    return None if unit is None else Encoding(name, unit, _origin(name, samples, unit))


def _measured(values: Values) -> Values:
    """Return the values that can be times."""
    if values.dtype.kind == "f":
        return np.asarray(values[np.isfinite(values)])
    return values if values.dtype.kind in "iu" else values[:0]


def _differ(values: Values) -> bool:
    return bool((values != values[:1]).any())


def _unit(samples: Sequence[tuple[int, Values]]) -> int | None:
    """Return the nanoseconds in one count, or None where no unit gives a plausible sweep."""
    stamp, values = samples[len(samples) // 2]
    middle = float(np.median(values))
    whole = np.issubdtype(values.dtype, np.integer)  # whole seconds can't time a sweep's points
    units = list(_UNITS.values())[whole:]
    for unit in units:
        like_stamp = abs(middle * unit - stamp) < 0.1 * stamp
        if stamp > _PRECISE_EPOCH and like_stamp:
            return unit if 0 < _span(samples, unit) < LONGEST_SWEEP else None
    for unit in units:
        if SHORTEST_SWEEP <= _span(samples, unit) < LONGEST_SWEEP:
            return unit
    return None


def _span(samples: Sequence[tuple[int, Values]], unit: int) -> float:
    """Return the seconds that the median sweep lasts."""
    ends = [np.quantile(_since_first(values, unit), (0.005, 0.995)) for _, values in samples]
    return float(np.median(np.diff(ends))) / NANOSECONDS


def _since_first(values: Values, unit: int) -> NDArray[np.float64]:
    """Return (N,) nanoseconds from the first finite value."""
    return _nanoseconds(values, unit, _first(values) * unit)


def _first(values: Values) -> int | float:
    if np.issubdtype(values.dtype, np.integer):
        return int(values[:1].astype(np.int64)[0])
    return float(values[np.argmax(np.isfinite(values))])


def _nanoseconds(values: Values, unit: int, zero: int | float) -> NDArray[np.float64]:
    """Return (N,) nanoseconds after `zero`, of counts of `unit` nanoseconds that may have wrapped."""
    if np.issubdtype(values.dtype, np.integer):  # exact: no float holds epoch nanoseconds
        zero = int(zero)
        counts = values.astype(np.int64) - zero // unit
        nanoseconds = counts.astype(np.float64) * unit - zero % unit
    else:
        nanoseconds = (values.astype(np.float64) - zero / unit) * unit
    return _unwrapped(nanoseconds)


def _unwrapped(nanoseconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Undo the wrap of those that lie about as far off as 32 bits of some unit reach."""
    limit = LONGEST_SWEEP * NANOSECONDS
    if not (np.abs(nanoseconds) > limit).any():
        return nanoseconds
    for wrap in (*_WRAPS, *np.negative(_WRAPS)):
        nanoseconds = np.where(np.abs(nanoseconds - wrap) <= limit, nanoseconds - wrap, nanoseconds)
    return nanoseconds


def _origin(name: str, samples: Sequence[tuple[int, Values]], unit: int) -> str:
    """Choose the origin under which sweeps lie near to their stamps, all in the same place."""
    spreads = {}
    for origin in ("header", "epoch"):
        encoding = Encoding(name, unit, origin)
        lags = [float(np.median(encoding.offsets(v, stamp))) for stamp, v in samples]
        if np.median(np.abs(lags)) <= LONGEST_SWEEP:
            spreads[origin] = np.quantile(lags, 0.9) - np.quantile(lags, 0.1)
    best = min(spreads, key=lambda origin: spreads[origin], default="sweep")
    return best if spreads.get(best, np.inf) <= _STEADY else "sweep"
