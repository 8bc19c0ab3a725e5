"""Pictures of a run, as Matplotlib figures that need neither a display nor global state."""

from pathlib import Path
from typing import Literal

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from eval.files import GraphSketch, Timeline, atomic_path
from eval.map_image import rasterise
from eval.trajectory import TrajectoryComparison

Array = NDArray[np.float64]

_ESTIMATE, _REFERENCE, _LOOP = "#1668b3", "#6b6f76", "#e8590c"
_STAGE_COLOURS = ("#1668b3", "#e8590c", "#2b8a3e", "#9c36b5")
_AXIS_COLOURS = {"x": "#c92a2a", "y": "#2b8a3e", "z": "#1668b3"}
_WIDTH = 9.0  # inches
_DPI = 130


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, replacing the file as a whole."""
    FigureCanvasAgg(figure)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=_DPI, format="png")


def trajectory(
    estimate: PoseTrajectory3D, comparison: TrajectoryComparison | None, graph: GraphSketch
) -> Figure:
    """Draw the path from above, with reference and loop closures, over its height profile."""
    path = estimate.positions_xyz
    vertices = graph.positions
    title = f"Trajectory, {estimate.path_length:.0f} m; no reference"
    if comparison is not None:
        path = comparison.alignment.move(path)
        vertices = comparison.alignment.move(vertices)
        mae = comparison.errors.mean()
        title = f"Trajectory, {estimate.path_length:.0f} m: mean absolute error {mae:.3f} m"
    figure = Figure(figsize=(_WIDTH, _height(path) + 2.6), layout="constrained")
    above, profile = figure.subplots(2, 1, height_ratios=[_height(path), 1.8])
    if comparison is not None:
        true = comparison.reference.positions_xyz
        above.plot(true[:, 0], true[:, 1], color=_REFERENCE, lw=4, alpha=0.45, label="reference")
        profile.plot(comparison.distances, true[:, 2], color=_REFERENCE, lw=4, alpha=0.45)
    above.plot(path[:, 0], path[:, 1], color=_ESTIMATE, lw=1.3, label="estimate")
    profile.plot(_along(path), path[:, 2], color=_ESTIMATE, lw=1.3)
    _draw_loops(above, vertices, graph)
    above.plot(*path[0, :2], "o", ms=8, color=_ESTIMATE, mec="white", mew=1.5, label="start")
    above.plot(*path[-1, :2], "s", ms=7, color=_ESTIMATE, mec="white", mew=1.5, label="end")
    above.set_aspect("equal", adjustable="datalim")
    _label(above, "x [m]", "y [m]", title)
    _label(profile, "distance along the path [m]", "z [m]", "Height profile")
    _legend(above)
    return figure


def errors(comparison: TrajectoryComparison) -> Figure:
    """Draw position error over time and over distance, and each axis's share of it."""
    figure = Figure(figsize=(_WIDTH, 7.5), layout="constrained")
    over_time, over_distance, by_axis = figure.subplots(3, 1)
    seconds = comparison.reference.timestamps - comparison.reference.timestamps[0]
    values = comparison.errors
    mae, rmse = values.mean(), np.sqrt((values**2).mean())
    for axes, along in ((over_time, seconds), (over_distance, comparison.distances)):
        axes.fill_between(along, values, color=_ESTIMATE, alpha=0.15, lw=0)
        axes.plot(along, values, color=_ESTIMATE, lw=1.3)
        axes.axhline(mae, color=_LOOP, lw=1.2, ls="--", label=f"mean {mae:.3f} m")
        axes.set_ylim(bottom=0)
    unit = "time since the first pair [s]" if comparison.pairs.stamped else "pose"
    title = f"Position error: MAE {mae:.3f} m, RMSE {rmse:.3f} m, max {values.max():.3f} m"
    _label(over_time, unit, "error [m]", title)
    _label(over_distance, "distance along the reference [m]", "error [m]", "")
    for index, (name, colour) in enumerate(_AXIS_COLOURS.items()):
        share = comparison.differences[:, index]
        label = f"{name}: MAE {np.abs(share).mean():.3f} m"
        by_axis.plot(comparison.distances, share, color=colour, lw=1.1, label=label)
    by_axis.axhline(0, color="black", lw=0.6)
    _label(
        by_axis,
        "distance along the reference [m]",
        "estimate - reference [m]",
        "By axis of the reference",
    )
    _legend(over_time)
    _legend(by_axis)
    return figure


def growth(timeline: Timeline) -> Figure:
    """Draw graph size and memory over the scans."""
    figure = Figure(figsize=(_WIDTH, 5.5), layout="constrained")
    size, memory = figure.subplots(2, 1, sharex=True)
    scans = np.arange(1, len(timeline["stamp"]) + 1)
    for column, colour in (("vertices", _ESTIMATE), ("edges", _LOOP)):
        last = f"{timeline[column][-1]:.0f}" if len(scans) else "none"
        size.plot(scans, timeline[column], color=colour, lw=1.5, label=f"{column}: {last}")
    memory.plot(scans, timeline["rss_mb"], color="#495057", lw=1.5)
    size.set_ylim(bottom=0)
    memory.set_ylim(bottom=0)
    peak = timeline["rss_mb"].max() if len(scans) else 0
    _label(size, "", "count", "Graph growth")
    _label(memory, "scan", "resident memory [MB]", f"Memory, at most {peak:.0f} MB")
    _legend(size)
    return figure


def stages(timeline: Timeline, names: tuple[str, ...]) -> Figure:
    """Draw the time of each stage, stacked over the scans (averaged where there are many)."""
    figure = Figure(figsize=(_WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    present = [name for name in names if f"{name}_ms" in timeline]
    values = np.array([timeline[f"{name}_ms"] for name in present]).reshape(len(present), -1)
    mean = values.mean(axis=1) if values.size else np.zeros(len(present))
    group = max(1, values.shape[1] // 300)
    starts = np.arange(0, values.shape[1], group)
    if len(starts):
        sizes = np.diff(np.append(starts, values.shape[1]))
        averaged = np.add.reduceat(values, starts, axis=1) / sizes
        labels = [f"{name}: {ms:.1f} ms" for name, ms in zip(present, mean, strict=True)]
        colours = _STAGE_COLOURS[: len(present)]
        axes.stackplot(starts + 1, averaged, labels=labels, colors=colours, alpha=0.85, lw=0)
        axes.set_xlim(1, max(2, starts[-1] + 1))
        axes.set_ylim(0, max(1.25 * averaged.sum(axis=0).max(), 1e-3))  # room for the legend
    note = "" if group == 1 else f", means over {group} scans"
    _label(axes, "scan", "time [ms]", f"Time per stage: {mean.sum():.1f} ms a scan{note}")
    _legend(axes, columns=len(names), place="upper center")
    return figure


def map_from_above(points: NDArray[np.float32], path: Array) -> Figure:
    """Draw a map from above, coloured by height and fainter where there are few points.

    Args:
        points: (N, 3) map in metres.
        path: (M, 3) positions driven, in the same frame.
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
    axes.plot(path[:, 0], path[:, 1], color="black", lw=1.2, label="path")
    axes.plot(*path[0, :2], "o", ms=7, color="black", mec="white", mew=1.5, label="start")
    axes.set_aspect("equal", adjustable="datalim")
    _label(axes, "x [m]", "y [m]", f"Map from above: {len(points):,} points{cell}")
    axes.grid(False)  # it would shine through the cells
    _legend(axes)
    return figure


def _draw_loops(axes: Axes, vertices: Array, graph: GraphSketch) -> None:
    """Draw loop closures as straight lines between their vertices."""
    loops = graph.edges[graph.is_loop]
    if len(loops) == 0:
        return
    plural = "" if len(loops) == 1 else "s"
    lines = LineCollection(
        list(vertices[loops][:, :, :2]),
        colors=_LOOP,
        linewidths=1.0,
        alpha=0.7,
        zorder=3,
    )
    axes.add_collection(lines)
    middles = vertices[loops].mean(axis=1)
    label = f"{len(loops)} loop closure{plural}"
    axes.plot(middles[:, 0], middles[:, 1], "o", ms=3.5, color=_LOOP, zorder=3, label=label)


def _along(path: Array) -> Array:
    """Return (N,) metres along (N, 3) positions."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _height(path: Array) -> float:
    """Return inches that show a path of this shape well at the figure's width."""
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
