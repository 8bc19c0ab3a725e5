"""Pictures of how pose graphs grow under several pruning methods."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from eval.ablation import Run, grouped
from eval.files import atomic_path

Array = NDArray[np.float64]

# Okabe and Ito's palette, which people with any kind of colour vision tell apart.
_COLOURS = {
    "none": "#000000", "geometry": "#0072B2", "decimate": "#E69F00", "random": "#CC79A7",
    "chow_liu": "#009E73", "dense": "#D55E00",
}  # fmt: skip
_OTHER = "#56B4E9"
_DPI = 150


@dataclass(frozen=True, slots=True)
class Panel:
    """What one picture shows.

    Attributes:
        column: of the curves.
        title: of the picture.
        unit: of its vertical axis.
        logarithmic: whether that axis is, where the curves span a decade.
        scale: factor from the curve to the unit.
    """

    column: str
    title: str
    unit: str
    logarithmic: bool = False
    scale: float = 1.0


PANELS = (
    Panel("vertices", "Vertices", "vertices", logarithmic=True),
    Panel("edges", "Edges", "edges", logarithmic=True),
    Panel("back_end_s", "Back-end time, cumulative", "time [s]", logarithmic=True),
    Panel("optimise_ms", "Time of one optimisation", "time [ms]", logarithmic=True),
    Panel("memory_mb", "Memory that the run has taken", "resident memory [MB]"),
    Panel("ape_m", "Error of all keyframes ever taken", "APE RMSE [cm]", scale=100.0),
)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG and SVG beside each other, each replaced as a whole."""
    FigureCanvasAgg(figure)
    for suffix in (".png", ".svg"):
        with atomic_path(path.with_name(path.name + suffix)) as temporary:
            figure.savefig(temporary, dpi=_DPI, format=suffix[1:])


def single(runs: Sequence[Run], panel: Panel) -> Figure:
    """Draw one quantity over time, a line for each method, with its spread over the seeds."""
    figure = Figure(figsize=(7.5, 4.4), layout="constrained")
    axes = figure.subplots()
    _draw(axes, runs, panel)
    axes.set_xlabel("time driven [h]")
    axes.legend(frameon=False, fontsize=9, ncols=2)
    return figure


def overview(runs: Sequence[Run], title: str) -> Figure:
    """Draw all quantities beside each other."""
    figure = Figure(figsize=(11.0, 11.0), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    for axes, panel in zip(figure.subplots(3, 2, sharex=True).flat, PANELS, strict=True):
        _draw(axes, runs, panel)
    for axes in figure.axes[-2:]:
        axes.set_xlabel("time driven [h]")
    lines, labels = figure.axes[2].get_legend_handles_labels()  # the one with fitted lines
    figure.legend(
        lines, labels, loc="outside lower center", ncols=min(len(labels), 7), frameon=False
    )
    return figure


def _draw(axes: Axes, runs: Sequence[Run], panel: Panel) -> None:
    for (method, _), group in grouped(runs).items():
        _draw_method(axes, method, group, panel)
    axes.set_title(panel.title, loc="left", fontsize=11, fontweight="bold")
    axes.set_ylabel(panel.unit)
    axes.grid(color="#dee2e6", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(left=0)
    low, high = axes.dataLim.intervaly
    if panel.logarithmic and high > 10 * low:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(bottom=0)


def _draw_method(axes: Axes, method: str, group: list[Run], panel: Panel) -> None:
    """Draw mean and range over the seeds; dashed from where one of them is fitted."""
    hours = group[0].curves["hours"]
    is_time = panel.column == "back_end_s"
    curves = [run.back_end_s if is_time else run.curves[panel.column] for run in group]
    # Keyframes don't fall on the full quarter of an hour, nor on the same instant for all seeds.
    values = panel.scale * np.array(
        [np.interp(hours, run.curves["hours"], c) for run, c in zip(group, curves, strict=True)]
    )
    mean, colour = values.mean(axis=0), _COLOURS.get(method, _OTHER)
    end = int(np.min([_measured(run) for run in group])) if is_time else len(hours)
    axes.fill_between(hours, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.15, lw=0)
    axes.plot(hours[:end], mean[:end], color=colour, lw=1.7, label=method)
    if end < len(hours):
        label = f"{method}, fitted"
        axes.plot(
            hours[end - 1 :], mean[end - 1 :], color=colour, lw=1.7, ls=(0, (4, 2)), label=label
        )


def _measured(run: Run) -> int:
    """Return how many samples come before the first fitted one."""
    return int(np.count_nonzero(~run.fitted))
