"""Pictures of a run, as Matplotlib figures that need neither a display nor global state."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from eval.files import GraphSketch, atomic_path
from eval.map_image import rasterise
from eval.metrics.metric import Curve, Plot
from eval.nearest import Points
from eval.report.encoding import thin
from eval.trajectory import TrajectoryComparison

Array = NDArray[np.float64]

_ESTIMATE, _REFERENCE, _LOOP, _COMPOSED = "#1668b3", "#6b6f76", "#e8590c", "#9c36b5"
_COLOURS = ("#1668b3", "#e8590c", "#2b8a3e", "#9c36b5", "#c92a2a", "#0b7285")
_STACKED = 300  # steps that a stack of curves has on paper
_WIDTH = 9.0  # inches
_DPI = 130
_CHUNK = 1000  # corners


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, replacing the file as a whole."""
    FigureCanvasAgg(figure)
    # Agg takes time in proportion to the square of the corners of a piece of line.
    with atomic_path(path) as temporary, rc_context({"agg.path.chunksize": _CHUNK}):
        figure.savefig(temporary, dpi=_DPI, format="png")


def trajectory(
    estimate: PoseTrajectory3D, comparison: TrajectoryComparison | None, graph: GraphSketch | None
) -> Figure:
    """Draw the path from above, with reference and what closes loops, over its height profile."""
    path = estimate.positions_xyz
    title = f"Trajectory, {estimate.path_length:.0f} m; no reference"
    if comparison is not None:
        path = comparison.alignment.move(path)
        mae = comparison.errors.mean()
        title = f"Trajectory, {estimate.path_length:.0f} m: mean absolute error {mae:.3f} m"
    figure = Figure(figsize=(_WIDTH, _height(path) + 2.6), layout="constrained")
    above, profile = figure.subplots(2, 1, height_ratios=[_height(path), 1.8])
    if comparison is not None:
        true = comparison.reference.positions_xyz
        kept = thin(true.sum(axis=1))
        behind = {"color": _REFERENCE, "lw": 4, "alpha": 0.45}
        above.plot(true[kept, 0], true[kept, 1], label="reference", **behind)
        profile.plot(comparison.distances[kept], true[kept, 2], **behind)
    kept = thin(path.sum(axis=1))
    above.plot(path[kept, 0], path[kept, 1], color=_ESTIMATE, lw=1.3, label="estimate")
    profile.plot(_along(path)[kept], path[kept, 2], color=_ESTIMATE, lw=1.3)
    if graph is not None:
        vertices = graph.positions
        if comparison is not None:
            vertices = comparison.alignment.move(vertices)
        composed, loops = graph.edges[graph.is_composed], graph.edges[graph.is_loop]
        _draw_edges(above, vertices[composed], _COMPOSED, "composed edge")
        _draw_edges(above, vertices[loops], _LOOP, "loop closure")
    above.plot(*path[0, :2], "o", ms=8, color=_ESTIMATE, mec="white", mew=1.5, label="start")
    above.plot(*path[-1, :2], "s", ms=7, color=_ESTIMATE, mec="white", mew=1.5, label="end")
    above.set_aspect("equal", adjustable="datalim")
    _label(above, "x [m]", "y [m]", title)
    _label(profile, "distance along the path [m]", "z [m]", "Height profile")
    _legend(above)
    return figure


def declared(plot: Plot) -> Figure:
    """Draw what a metric declares: lines over each other, or stacked as shares of a whole."""
    figure = Figure(figsize=(_WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    colours = [_COLOURS[i % len(_COLOURS)] for i in range(len(plot.curves))]
    if plot.stacked:
        _stack(axes, plot.curves, colours)
    else:
        for curve, colour in zip(plot.curves, colours, strict=True):
            shown = thin(curve.y)
            axes.plot(curve.x[shown], curve.y[shown], color=colour, lw=1.3, label=curve.name)
    low, high = axes.get_ylim()
    if all(np.nanmin(curve.y, initial=0) >= 0 for curve in plot.curves):
        axes.set_ylim(0, high + 0.2 * (high - max(low, 0)))  # room for the legend
    _label(axes, plot.x_label, plot.y_label, plot.title)
    if len(plot.curves) > 1:
        _legend(axes, columns=min(len(plot.curves), 4), place="upper center")
    return figure


def _stack(axes: Axes, curves: Sequence[Curve], colours: Sequence[str]) -> None:
    """Stack curves over their common abscissae, as means of groups where there are many."""
    x, values = curves[0].x, np.array([np.nan_to_num(curve.y) for curve in curves])
    if len(x) == 0:
        return
    starts = np.arange(0, len(x), max(1, len(x) // _STACKED))
    sizes = np.diff(np.append(starts, len(x)))
    means = np.add.reduceat(values, starts, axis=1) / sizes
    labels = [curve.name for curve in curves]
    axes.stackplot(x[starts], means, labels=labels, colors=colours, alpha=0.85, lw=0)
    axes.margins(x=0)


def map_from_above(points: Points, path: Array) -> Figure:
    """Draw a map from above, coloured by height and fainter where there are few points.

    Args:
        points: (N, 3) map in metres.
        path: (M, 3) positions driven, in the same frame; may be empty.
    """
    shape = path if len(points) == 0 else points[:: max(1, len(points) // 10_000)].astype(float)
    figure = Figure(figsize=(_WIDTH, 0.85 * _height(shape) + 0.8), layout="constrained")
    axes = figure.subplots()
    cell = ""
    if len(points):
        image = rasterise(points)
        cell = f", cells of {image.cell:.2f} m"
        low, high = np.nanpercentile(image.height, (2, 98))
        strength = np.log1p(image.count) / np.log1p(np.percentile(image.count[image.count > 0], 95))
        shown = axes.imshow(
            image.height,
            extent=image.extent,
            origin="lower",
            cmap="turbo",
            vmin=low,
            vmax=max(high, low + 0.1),
            alpha=np.clip(0.25 + 0.75 * strength, 0, 1) * (image.count > 0),
            interpolation="nearest",
        )
        figure.colorbar(shown, ax=axes, label="mean height z [m]", shrink=0.8, pad=0.01)
    if len(path):
        axes.plot(path[:, 0], path[:, 1], color="black", lw=1.2, label="path")
        axes.plot(*path[0, :2], "o", ms=7, color="black", mec="white", mew=1.5, label="start")
    axes.set_aspect("equal", adjustable="datalim")
    _label(axes, "x [m]", "y [m]", f"Map from above: {len(points):,} points{cell}")
    axes.grid(False)  # it would shine through the cells
    _legend(axes)
    return figure


def _draw_edges(axes: Axes, ends: Array, colour: str, name: str) -> None:
    """Draw edges between (E, 2, 3) vertices as straight lines."""
    if len(ends) == 0:
        return
    lines = LineCollection(list(ends[:, :, :2]), colors=colour, linewidths=1.0, alpha=0.7, zorder=3)
    axes.add_collection(lines)
    middles = ends.mean(axis=1)
    label = f"{len(ends)} {name}{'' if len(ends) == 1 else 's'}"
    axes.plot(middles[:, 0], middles[:, 1], "o", ms=3.5, color=colour, zorder=3, label=label)


def _along(path: Array) -> Array:
    """Return (N,) metres along (N, 3) positions."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _height(path: Array) -> float:
    """Return inches that show a path of this shape well at the figure's width."""
    if len(path) == 0:
        return _WIDTH / 2
    extent = np.ptp(path[:, :2], axis=0)
    return float(np.clip(_WIDTH * extent[1] / max(extent[0], 1e-9), 2.5, 9.0))


def _label(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
    axes.grid(color="#dee2e6", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(axes: Axes, columns: int = 1, place: Literal["best", "upper center"] = "best") -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc=place, ncols=columns, framealpha=0.9, edgecolor="#dee2e6", fontsize=9)
