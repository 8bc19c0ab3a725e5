"""The contract of a metric plugin: what it is asked, what it answers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from eval.evidence import Evidence

Array = NDArray[np.float64]


class Section(StrEnum):
    """Where in metrics.json the values of a metric go."""

    TRAJECTORY = "trajectory"
    MAP = "map"
    RESOURCES = "resources"
    GRAPH = "graph"


@dataclass(frozen=True, slots=True)
class Curve:
    """One line of a plot.

    Attributes:
        name: for the legend.
        x: (N,) abscissae.
        y: (N,) ordinates; NaN leaves a gap.
    """

    name: str
    x: Array
    y: Array


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot as data: the report draws it for the browser, `eval.plots` on paper.

    Attributes:
        title: a line that names what is shown.
        x_label: with its unit.
        y_label: with its unit.
        curves: at least one.
        stacked: the curves add up, as shares of a whole.
    """

    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    stacked: bool = False


@dataclass(frozen=True, slots=True)
class Measurement:
    """What a metric found.

    Attributes:
        values: by the metric's `keys`: numbers, None where the data say nothing, or dictionaries and lists
            of those. The unit is in the key, as in `mae_m`.
        headline: the figure to show if only one is shown, in the metric's unit; None if there is none.
        samples: (N,) arrays that the values sum up, by name.
        plots: what is worth looking at.
        warnings: what makes the values doubtful, a sentence each.
    """

    values: Mapping[str, Any]
    headline: float | None
    samples: Mapping[str, Array] = field(default_factory=dict)
    plots: tuple[Plot, ...] = ()
    warnings: tuple[str, ...] = ()


@runtime_checkable
class Metric(Protocol):
    """Judges one side of a SLAM system's output.

    Attributes:
        name: unique, in snake_case.
        title: unique, of a few words, for people.
        section: of metrics.json.
        keys: of the values, unique in the section.
        needs: names of the fields of Evidence without which there is nothing to measure.
        unit: of the headline; an empty string for a count or a ratio.
        less_is_better: whether the smaller of two headlines is the better one; None if neither is.
        meaning: one sentence that says what the headline tells.
    """

    name: str
    title: str
    section: Section
    keys: tuple[str, ...]
    needs: tuple[str, ...]
    unit: str
    less_is_better: bool | None
    meaning: str

    def measure(self, evidence: Evidence) -> Measurement:
        """Judge the evidence, which has all that the metric needs.

        Raises:
            EvalError: the evidence doesn't allow it; the message is kept as the reason.
        """
        ...
