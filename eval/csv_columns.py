"""Finds by a CSV file's heading which columns hold stamp, position and orientation of poses."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNITS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}  # counts in a second; exact in floats
_UNIT_NAMES = {"sec": "s", "secs": "s", "seconds": "s", "msec": "ms", "usec": "us", "nsec": "ns"}
_TIME = re.compile(
    r"(?:.*[._ ])?(?:t|time|time_?stamps?|stamps?)(?:[._ ]?[mun]?s(?:ecs?|econds)?)?"
)
_POSITION = re.compile(
    r"(?:(?:.*[._ ])?(?:position|pos|translation|trans|p|t)[._ ]?|p_.*_)?(?P<axis>[xyz])"
)
_ORIENTATION = re.compile(
    r"(?:(?:.*[._ ])?(?:orientation|rotation|quaternion|quat|rot|q)[._ ]?|q_.*_)(?P<axis>[xyzw])"
)

# A pose each of these or less often isn't a trajectory of anything that moves.
_SHORTEST, _LONGEST = 1e-4, 100.0  # s
_FIRST, _LAST = 946_684_800, 4_102_444_800  # s since 1970: years 2000 to 2100


@dataclass(frozen=True, slots=True)
class PoseColumns:
    """Where a table has its poses.

    Attributes:
        indices: columns of stamp, x, y, z, qx, qy, qz, qw.
        rate: counts of the stamps in a second, where the heading says.
    """

    indices: tuple[int, ...]
    rate: int | None


def find_columns(heading: str) -> PoseColumns | None:
    """Return the columns of a comma-separated heading that names all eight, else None.

    Known are the names of EuRoC (``p_RS_R_x [m]``, ``q_RS_w []``), of ROS messages
    (``pose.position.x``), and short ones (``t``, ``x``, ``qx``); of two with one meaning the first counts.
    """
    found: dict[str, int] = {}
    rate = None
    for index, cell in enumerate(heading.lstrip("#% ").split(",")):
        name, _, bracket = re.sub(r"[\])\"']", "", cell.lower()).replace("(", "[").partition("[")
        if (quantity := _quantity(name.strip())) and quantity not in found:
            found[quantity] = index
            rate = _named_rate(name, bracket) if quantity == "t" else rate
    wanted = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
    if not found.keys() >= {*wanted}:
        return None
    return PoseColumns(tuple(found[quantity] for quantity in wanted), rate)


def guess_rate(stamps: Array) -> int:
    """Return how many counts of (N,) stamps make a second, where nothing says.

    The unit must make the mean interval plausible. Where several do, one that puts the stamps after the
    year 2000 wins; else fractions are of seconds, and whole numbers count nanoseconds, as EuRoC's do.
    """
    whole = bool((stamps % 1 == 0).all())
    default = "ns" if whole else "s"
    if len(stamps) < 2 or stamps[-1] <= stamps[0]:
        return UNITS[default]
    interval = float(stamps[-1] - stamps[0]) / (len(stamps) - 1)
    plausible = [name for name, n in UNITS.items() if _SHORTEST <= interval / n <= _LONGEST]
    dated = [name for name in plausible if _FIRST <= stamps[0] / UNITS[name] <= _LAST]
    if not dated and default in plausible:
        return UNITS[default]
    return UNITS[[*dated, *plausible, default][0]]


def _quantity(name: str) -> str | None:
    """Return what a column of this name holds: t, x, y, z, qx, qy, qz, qw or None."""
    if orientation := _ORIENTATION.fullmatch(name):
        return "q" + orientation["axis"]
    if position := _POSITION.fullmatch(name):
        return position["axis"]
    return "t" if _TIME.fullmatch(name) else None


def _named_rate(name: str, bracket: str) -> int | None:
    words: Sequence[str] = [bracket.strip(), *re.split(r"[._ ]", name.strip())]
    known = [UNITS.get(_UNIT_NAMES.get(word, word)) for word in words]
    return next((rate for rate in known if rate is not None), None)
