"""What several runs of one thing say together."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import t

_CONFIDENCE = 0.95


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Return mean, standard deviation and 95 % confidence interval of the mean (Student's t).

    The last two are None for a single value.
    """
    mean, n = float(np.mean(values)), len(values)
    if n == 1:
        return {"mean": mean, "std": None, "ci95": None, "values": [*values]}
    deviation = float(np.std(values, ddof=1))
    half = float(t.ppf((1 + _CONFIDENCE) / 2, n - 1)) * deviation / np.sqrt(n)
    return {"mean": mean, "std": deviation, "ci95": [mean - half, mean + half], "values": [*values]}
