"""A table of a comparison: numbers with their uncertainty, and how they are written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from eval.numbers import number
from eval.statistics import spread

PUBLISHED = "published"
OURS = "ours"
_NOTHING = ""


@dataclass(frozen=True, slots=True)
class Cell:
    """A figure over one or several seeds.

    Attributes:
        mean: of the seeds' figures; NaN where there is none.
        half_width: of the 95 % confidence interval of the mean (Student's t); NaN for a single figure.
        count: of figures.
    """

    mean: float = float("nan")
    half_width: float = float("nan")
    count: int = 0

    @classmethod
    def of(cls, values: Sequence[float | None]) -> "Cell":
        """Sum up the figures of some seeds; None says that one has none."""
        numbers = [value for value in values if value is not None]
        if not numbers:
            return cls()
        found = spread(numbers)
        interval = found["ci95"]
        half = float("nan") if interval is None else interval[1] - found["mean"]
        return cls(found["mean"], half, len(numbers))

    def text(self, digits: int | None) -> str:
        """Return the figure as it is printed, with some digits behind the point or four in all."""
        if np.isnan(self.mean):
            return _NOTHING
        if digits is None:
            mean, half_width = number(self.mean), number(self.half_width, 2)
        else:
            mean, half_width = f"{self.mean:,.{digits}f}", f"{self.half_width:,.{digits}f}"
        return mean if np.isnan(self.half_width) else f"{mean} ± {half_width}"


@dataclass(frozen=True, slots=True)
class Column:
    """One column of figures.

    Attributes:
        heading: from the outermost to the innermost level.
        digits: behind the point; None for four in all.
        less_is_better: which of two figures is the better one; None if neither is.
    """

    heading: tuple[str, ...]
    digits: int | None = 3
    less_is_better: bool | None = None


@dataclass(frozen=True, slots=True)
class Table:
    """Figures of runs side by side.

    Attributes:
        name: for files, in snake_case.
        title: a line.
        notes: sentences that say what the figures mean and depend on.
        index: headings of the columns that say which runs a row is about.
        rows: what these columns hold, and the row's figures in the order of `columns`.
        columns: of figures.
        contest: rows that agree in as many leading columns compete for the best figure; None if none do.
    """

    name: str
    title: str
    notes: tuple[str, ...]
    index: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: Mapping[tuple[str, ...], Sequence[Cell]]
    contest: int | None = None

    def numbers(self) -> pd.DataFrame:
        """Return the figures as numbers: each column's mean, and half width and count if seeds differ."""
        frame = pd.DataFrame(list(self.rows), columns=list(self.index))
        for i, column in enumerate(self.columns):
            name = " ".join(column.heading)
            cells = [row[i] for row in self.rows.values()]
            frame[name] = [cell.mean for cell in cells]
            if any(cell.count > 1 for cell in cells):
                frame[f"{name}, half width of CI 95 %"] = [cell.half_width for cell in cells]
                frame[f"{name}, runs"] = [cell.count for cell in cells]
        return frame

    def text(self, flat: bool = False) -> pd.DataFrame:
        """Return the figures as they are printed; `flat` joins the levels of the headings."""
        body = [
            [*row, *(cell.text(c.digits) for cell, c in zip(cells, self.columns, strict=True))]
            for row, cells in self.rows.items()
        ]
        depth = 1 if flat else max((len(c.heading) for c in self.columns), default=1)
        headings = [(name,) for name in self.index] + [c.heading for c in self.columns]
        if depth == 1:
            return pd.DataFrame(body, columns=[" ".join(heading) for heading in headings])
        padded = [("",) * (depth - len(heading)) + heading for heading in headings]
        return pd.DataFrame(body, columns=pd.MultiIndex.from_tuples(padded))

    def best(self) -> NDArray[np.bool_]:
        """Return (rows, columns of `text`) whether a figure is the best of those it competes with."""
        marks = np.zeros((len(self.rows), len(self.index) + len(self.columns)), dtype=bool)
        if self.contest is None:
            return marks
        means = np.array([[cell.mean for cell in cells] for cells in self.rows.values()])
        keys = [row[: self.contest] for row in self.rows]
        for key in set(keys):
            rivals = np.array([other == key for other in keys])
            for i, column in enumerate(self.columns):
                if column.less_is_better is not None:
                    signed = means[rivals, i] * (1 if column.less_is_better else -1)
                    marks[rivals, len(self.index) + i] = _is_least(signed)
        return marks


def _is_least(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (N,) whether a value is the least, unless there is nothing to tell them apart."""
    known = values[~np.isnan(values)]
    if len(set(known.tolist())) < 2:
        return np.zeros(len(values), dtype=bool)
    least: NDArray[np.bool_] = values == known.min()
    return least
