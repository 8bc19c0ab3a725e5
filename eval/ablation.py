"""Compares pruning methods by what their pose graphs cost and keep over a run of many hours.

Each run of a method is a set of curves over simulated time and the positions of all its keyframes. Errors
are those of section 4.1 of paper 000: root mean square position error after Kabsch alignment. The map error
of a method is the mean distance between the same keyframes in its estimate and in that of the unpruned run,
after Kabsch alignment: a map hangs on the poses of the keyframes that saw it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from eval.alignment import kabsch
from eval.statistics import spread

Array = NDArray[np.float64]

UNPRUNED = "none"
COLUMNS = (
    "hours", "cells", "vertices", "edges", "back_end_s", "prune_s", "optimise_ms", "memory_mb", "ape_m"
)  # fmt: skip
LAW = (
    "Back-end time of an unpruned run beyond its budget: a h + b h^2 with a, b >= 0, least squares on what"
    " was measured (an optimisation takes time in proportion to the vertices, which grow with the hours h)."
    " Its graph goes on growing and is optimised at the samples, where error and memory are measured."
)
_EARLY = 0.2  # share of the run at which the graph should have its final size


@dataclass(frozen=True, slots=True)
class Run:
    """One method's way through one simulated run.

    Attributes:
        method: of pruning.
        wrong: share of wrong loop closures.
        seed: of the run; runs with the same seed and share have the same keyframes.
        curves: (S,) by column of COLUMNS; back_end_s is NaN where it was not measured. `cells` is the
            size of the place: square cells, 4 m wide, that the robot has entered so far.
        positions: (K, 3) of all keyframes at the end, metres.
    """

    method: str
    wrong: float
    seed: int
    curves: dict[str, Array]
    positions: Array

    @property
    def fitted(self) -> NDArray[np.bool_]:
        """(S,) where the back-end time is not measured but fitted."""
        return np.isnan(self.curves["back_end_s"])

    @property
    def back_end_s(self) -> Array:
        """(S,) back-end time, beyond what was measured by LAW."""
        return extrapolate(self.curves["hours"], self.curves["back_end_s"])

    def final(self, column: str) -> float:
        """Return the last value of a curve, the fitted one for the back-end time."""
        curve = self.back_end_s if column == "back_end_s" else self.curves[column]
        return float(curve[-1])

    def growth(self, column: str) -> float:
        """Return the ratio of a curve's last value to that after a fifth of the run."""
        hours, curve = self.curves["hours"], self.curves[column]
        return float(curve[-1] / np.interp(_EARLY * hours[-1], hours, curve))


def position_rmse(estimate: Array, reference: Array) -> float:
    """Return the root mean square distance of (N, 3) positions from their reference, once aligned."""
    return float(np.sqrt(np.mean(_distances(estimate, reference) ** 2)))


def map_error(estimate: Array, reference: Array) -> float:
    """Return the mean distance of (N, 3) positions from their reference, once aligned."""
    return float(np.mean(_distances(estimate, reference)))


def extrapolate(hours: Array, seconds: Array) -> Array:
    """Return (S,) seconds with NaN filled in by LAW.

    Args:
        hours: (S,) simulated.
        seconds: (S,) wall time up to then, NaN from some point on; all NaN stays so.
    """
    measured = ~np.isnan(seconds)
    if not measured.any():
        return seconds
    powers = np.column_stack([hours, hours**2])
    coefficients, _ = nnls(powers[measured], seconds[measured])
    return np.where(measured, seconds, powers @ coefficients)


def summarise(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return for each method and share of wrong closures the spread over the seeds of its figures.

    Those of `compared` are taken seed by seed, where both runs are there:

    - vertices, cells: at the end over those after a fifth of the run;
    - ape, speed_up, map_error_m: against the unpruned run, how many times larger the error, how many times
      less the back-end time, and how far off the map;
    - ape_of_wrong: how many times larger the error is than without wrong closures.
    """
    by_key = {(run.method, run.wrong, run.seed): run for run in runs}
    return [
        {
            "method": method,
            "wrong": wrong,
            "seeds": [run.seed for run in group],
            "fitted": any(bool(run.fitted.any()) for run in group),
            "final": {c: spread([run.final(c) for run in group]) for c in COLUMNS[1:]},
            "compared": {name: spread(values) for name, values in _compared(group, by_key).items()},
        }
        for (method, wrong), group in grouped(runs).items()
    ]


def grouped(runs: Iterable[Run]) -> dict[tuple[str, float], list[Run]]:
    """Return the runs of each method and share of wrong closures."""
    groups: dict[tuple[str, float], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.method, run.wrong), []).append(run)
    return groups


def rows(runs: Iterable[Run]) -> list[dict[str, Any]]:
    """Return one flat row for each sample of each run."""
    return [row for run in runs for row in _rows(run)]


def _rows(run: Run) -> list[dict[str, Any]]:
    key = {"method": run.method, "wrong": run.wrong, "seed": run.seed}
    columns = run.curves | {"back_end_s": run.back_end_s, "back_end_fitted": run.fitted}
    return [
        key | dict(zip(columns, values, strict=True))
        for values in zip(*(column.tolist() for column in columns.values()), strict=True)
    ]


def _compared(
    group: list[Run], by_key: dict[tuple[str, float, int], Run]
) -> dict[str, list[float]]:
    figures = {name: [run.growth(name) for run in group] for name in ("vertices", "cells")}
    for run in group:
        unpruned = by_key.get((UNPRUNED, run.wrong, run.seed))
        right = by_key.get((run.method, 0.0, run.seed))
        compared = {}
        if unpruned and unpruned is not run:
            compared = {
                "ape": run.final("ape_m") / unpruned.final("ape_m"),
                "speed_up": unpruned.final("back_end_s") / run.final("back_end_s"),
                "map_error_m": map_error(run.positions, unpruned.positions),
            }
        if right and right is not run:
            compared["ape_of_wrong"] = run.final("ape_m") / right.final("ape_m")
        for name, value in compared.items():
            figures.setdefault(name, []).append(value)
    return figures


def _distances(estimate: Array, reference: Array) -> Array:
    R, shift, _ = kabsch(estimate, reference)
    distances: Array = np.linalg.norm(estimate @ R.T + shift - reference, axis=1)
    return distances
