"""Percentiles as metrics report them."""

from collections.abc import Sequence

import numpy as np

from eval.errors import MetricError
from eval.metrics.metric import Array

DEFAULT = (50, 75, 90, 95, 99)


def checked(percentiles: Sequence[float]) -> tuple[float, ...]:
    """Return percentiles that are all between 0 and 100.

    Raises:
        MetricError: there are others.
    """
    if not all(0 <= percentile <= 100 for percentile in percentiles):
        raise MetricError(f"percentiles go from 0 to 100, not {[*percentiles]}")
    return tuple(percentiles)


def spread(values: Array, percentiles: Sequence[float]) -> dict[str, float]:
    """Return the percentiles of (N,) values, by what they are written as."""
    found = np.percentile(values, percentiles).tolist()
    return {f"{p:g}": value for p, value in zip(percentiles, found, strict=True)}
