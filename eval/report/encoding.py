"""Puts arrays into a page: fewer samples, fewer digits, compressed."""

import base64
import gzip
import json
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

POINTS = 5000  # samples of a line; about five for each dot across a large screen

_PRECISION = 1e-5  # of an array's range, far below what a screen resolves


def thin(values: NDArray[np.float64], limit: int = POINTS) -> NDArray[np.intp]:
    """Choose samples of a curve that look like all of it.

    Of each of many equal stretches the least, the greatest and the first missing sample stay.

    Args:
        values: (N,) samples; NaN where there is none.
        limit: most samples to choose.

    Returns:
        (M,) ascending indices, M <= limit; all if N <= limit.
    """
    count = len(values)
    if count <= limit:
        return np.arange(count)
    width = -(-count // ((limit - 1) // 3))
    starts = np.arange(0, count, width)
    stretches = np.full((len(starts), width), np.nan)
    stretches.flat[:count] = values
    missing = np.isnan(stretches)
    chosen = [
        np.where(missing, np.inf, stretches).argmin(axis=1),
        np.where(missing, -np.inf, stretches).argmax(axis=1),
        missing.argmax(axis=1),
    ]
    indices: NDArray[np.intp] = np.append((starts + chosen).ravel(), count - 1)
    return np.unique(indices[indices < count])


def pack(value: Any) -> str:
    """Return JSON, compressed by gzip, in base64; arrays become the typed arrays of plotly.js.

    Args:
        value: dictionaries, lists, strings, numbers and arrays of floats, which may be NaN.
    """
    text = json.dumps(value, default=_typed_array, separators=(",", ":"))
    return _compress(text)


@cache
def plotly_js() -> str:
    """Return plotly.js, compressed by gzip, in base64."""
    return _compress(get_plotlyjs())


def _compress(text: str) -> str:
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def _typed_array(value: Any) -> dict[str, str]:
    """Return an array as plotly.js reads it, in single precision where that is enough."""
    values = np.where(np.isfinite(value), value, np.nan)
    single = values.astype(np.float32)
    finite = values[~np.isnan(values)]
    spread = float(np.ptp(finite)) if finite.size else 0.0
    error = np.abs(finite - single[~np.isnan(values)]).max(initial=0.0)
    small = single if error <= _PRECISION * spread else values.astype(np.float64)
    return {
        "dtype": "f4" if small is single else "f8",
        "bdata": base64.b64encode(small.astype(small.dtype.newbyteorder("<")).tobytes()).decode(),
        "shape": ",".join(map(str, values.shape)),
    }
