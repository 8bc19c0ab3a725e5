"""Views of a run from above: its paths, its error along the way, its map."""

from typing import Any

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from markupsafe import Markup
from numpy.typing import NDArray

from eval.files import GraphSketch
from eval.map_image import rasterise
from eval.metrics.metric import Curve, Plot
from eval.nearest import Points
from eval.report.charts import THINNED, Drawing, chart, draw, show
from eval.report.encoding import POINTS, thin
from eval.trajectory import TrajectoryComparison

Array = NDArray[np.float64]

_ERROR_SCALE = [[step / 4, f"--error-{step}"] for step in range(5)]
_HEIGHT_SCALE = [[step / 4, f"--height-{step}"] for step in range(5)]
_DOTS = 2000  # that a browser moves smoothly
_MOST_EDGES = 1500  # of a kind that are drawn
_EDGE_COLOURS = {"loop closure": "--loop", "composed edge": "--composed"}
_CELLS = 900  # along the longer side of a map
# Pixels, with room for usual labels: with one scale for both axes, room made for a label changes the range
# that is shown, whose labels may need other room, and so on.
_MARGIN = {"l": 72, "r": 8, "t": 8, "b": 48}
_STRAYS = 98  # percentile where colours end, so that a few stray values don't wash out the rest


def trajectories(
    estimate: PoseTrajectory3D,
    comparison: TrajectoryComparison | None = None,
    graph: GraphSketch | None = None,
) -> Markup:
    """Overlay estimate, reference, loop closures and composed edges, seen from above.

    Args:
        estimate: in its own frame.
        comparison: of the same estimate; moves everything into the reference's frame.
        graph: in the estimate's frame.
    """
    path = _moved(estimate.positions_xyz, comparison)
    traces = [] if comparison is None else [_reference(comparison)]
    captions = [THINNED] if len(path) > POINTS else []
    loops = 0 if graph is None else int(graph.is_loop.sum())
    for name, ends in [] if graph is None else _closing(graph, comparison):
        traces.append(_edges(name, ends))
        if len(ends) > _MOST_EDGES:
            captions.append(f"{_MOST_EDGES:,} of {len(ends):,} {name}s are drawn.")
    traces.append(_estimate(path, estimate.timestamps, comparison))
    traces.extend(_ends(path))
    over = "" if comparison is None else " over its reference"
    length = show(float(estimate.path_length))
    words = f"Path of {length} m{over} from above, with {loops} loop closures."
    return draw(from_above("Trajectories", words, traces, path, " ".join(captions)))


def height_profile(
    estimate: PoseTrajectory3D, comparison: TrajectoryComparison | None = None
) -> Markup:
    """Draw the height along the path, and that of the reference."""
    path = _moved(estimate.positions_xyz, comparison)
    curves = [Curve("estimate", np.asarray(estimate.distances), path[:, 2])]
    if comparison is not None:
        true = comparison.reference.positions_xyz
        curves = [
            Curve("reference", comparison.distances, true[:, 2]),
            Curve("estimate", comparison.distances, comparison.estimate.positions_xyz[:, 2]),
        ]
    label = "distance along the path [m]"
    return chart(Plot("Height profile", label, "height z [m]", tuple(curves)))


def error_along_path(comparison: TrajectoryComparison) -> Markup:
    """Colour the estimated path by its distance from the reference."""
    errors, path = comparison.errors, comparison.estimate.positions_xyz
    kept = thin(errors, _DOTS)
    line = {
        "type": "scatter",
        "mode": "lines",
        "hoverinfo": "skip",
        "line": {"color": "--rule", "width": 6},
        **_xy(path[_thin_path(path)]),
    }
    dots = {
        "type": "scatter",
        "mode": "markers",
        **_xy(path[kept]),
        "customdata": np.column_stack([errors, comparison.distances, comparison.seconds])[kept],
        "marker": {"size": 6, "color": errors[kept], "coloraxis": "coloraxis"},
        "hovertemplate": "<b>%{customdata[0]:.4~g} m</b> off<br>after %{customdata[1]:.1f} m and"
        " %{customdata[2]:.1f} s<extra></extra>",
    }
    least, greatest = show(errors.min()), show(errors.max())
    words = f"Path from above, coloured by position error: {least} to {greatest} m."
    drawing = from_above("Error along the path", words, [line, dots], path, _clipped(errors))
    drawing.layout["coloraxis"] = _colour_axis("error [m]", 0.0, _top(errors), _ERROR_SCALE)
    return draw(drawing)


def map_by_distance(points: Points, distances: Array, path: Array | None = None) -> Markup:
    """Colour a map by the distance of its points to the reference.

    Args:
        points: (N, 3) map in metres.
        distances: (N,) metres from each point to its nearest in the reference.
        path: (M, 3) positions driven, in the same frame.
    """
    flat: Array = np.column_stack([points[:, :2], distances])
    words = "Map from above, coloured by its distance to the reference"
    words += f": {show(np.mean(distances))} m on average." if len(distances) else ": no points."
    colours = _colour_axis("distance [m]", 0.0, _top(distances), _ERROR_SCALE)
    title = "Map by its distance to the reference"
    return _map(title, words, flat, colours, path, _clipped(distances))


def map_by_height(points: Points, path: Array | None = None) -> Markup:
    """Colour a map by height.

    Args:
        points: (N, 3) map in metres.
        path: (M, 3) positions driven, in the same frame.
    """
    low, high = np.percentile(points[:, 2], (2, 98)).tolist() if len(points) else (0.0, 1.0)
    colours = _colour_axis("height z [m]", low, max(high, low + 0.1), _HEIGHT_SCALE)
    return _map("Map", "Map from above, coloured by height.", points, colours, path, "")


def from_above(
    title: str, words: str, traces: list[dict[str, Any]], shape: Array, caption: str
) -> Drawing:
    """Return a drawing with one scale for x and y, in a frame about as wide as what it shows.

    Args:
        title: a line that names what is shown.
        words: what somebody who can't see it should know.
        traces: of plotly.js.
        shape: (N, 2 or more) positions that the frame is made for.
        caption: what a reader should know about how it was drawn.
    """
    layout = {
        "xaxis": {"title": {"text": "x [m]"}, "hoverformat": ".1f"},
        "yaxis": {"title": {"text": "y [m]"}, "hoverformat": ".1f", "scaleanchor": "x"},
        "hovermode": "closest",
        "margin": _MARGIN,
    }
    width, height = np.ptp(shape[:, :2], axis=0) if len(shape) else (1.0, 1.0)
    aspect = float(np.clip(height / max(width, 1e-9), 0.3, 0.65))
    return Drawing(title, words, traces, layout, caption, round(aspect, 2))


def _map(
    title: str,
    words: str,
    points: Points,
    colours: dict[str, Any],
    path: Array | None,
    caption: str,
) -> Markup:
    """Draw (N, 3) points, whose last coordinate is shown by colour, as cells."""
    traces: list[dict[str, Any]] = []
    sentence = "The map is empty."
    shape = np.zeros((1, 2)) if path is None else path
    if len(points):
        image = rasterise(points, _CELLS)
        left, right, bottom, top = image.extent
        shape = np.array([[left, bottom], [right, top]])
        traces.append(
            {
                "type": "heatmap",
                "z": image.height,
                "x0": left + image.cell / 2,
                "dx": image.cell,
                "y0": bottom + image.cell / 2,
                "dy": image.cell,
                "coloraxis": "coloraxis",
                "hoverongaps": False,
                "hovertemplate": "<b>%{z:.4~g} m</b><br>x %{x:.1f} m, y %{y:.1f} m<extra></extra>",
            }
        )
        sentence = (
            f"{len(points):,} points; a cell of {image.cell:.2g} m shows the mean of its points."
        )
    if path is not None:
        line = {"color": "--ink", "width": 1.2}
        traces.append({**_line(path[_thin_path(path)], "path"), "line": line})
    drawing = from_above(title, words, traces, shape, " ".join(filter(None, [sentence, caption])))
    drawing.layout["coloraxis"] = colours
    return draw(drawing)


def _reference(comparison: TrajectoryComparison) -> dict[str, Any]:
    path = comparison.reference.positions_xyz
    return {
        **_line(path[_thin_path(path)], "reference"),
        "line": {"color": "--reference", "width": 5},
        "opacity": 0.55,
        "hoverinfo": "skip",
    }


def _estimate(
    path: Array, stamps: Array, comparison: TrajectoryComparison | None
) -> dict[str, Any]:
    """Return the estimated path, which tells stamp and error under the cursor."""
    kept = _thin_path(path)
    told = [stamps[kept]]
    template = "%{x:.2f}, %{y:.2f} m<br>stamp %{customdata[0]:.3f}"
    if comparison is not None:
        matched = comparison.estimate.timestamps
        told.append(np.interp(stamps[kept], matched, comparison.errors, np.nan, np.nan))
        template += "<br>error %{customdata[1]:.4~g} m"
    return {
        **_line(path[kept], "estimate"),
        "line": {"color": "--estimate", "width": 2},
        "customdata": np.column_stack(told),
        "hovertemplate": f"{template}<extra></extra>",
    }


def _closing(
    graph: GraphSketch, comparison: TrajectoryComparison | None
) -> list[tuple[str, Array]]:
    """Return the kinds of edges that close loops, as far as there are any, with (E, 2, 3) ends."""
    vertices = _moved(graph.positions, comparison)
    kinds = (("composed edge", graph.is_composed), ("loop closure", graph.is_loop))
    return [(name, vertices[graph.edges[chosen]]) for name, chosen in kinds if chosen.any()]


def _edges(name: str, ends: Array) -> dict[str, Any]:
    """Return edges of one kind between (E, 2, 3) vertices as straight lines."""
    shown = ends[np.linspace(0, len(ends) - 1, min(len(ends), _MOST_EDGES)).astype(int), :, :2]
    gaps = np.full((len(shown), 1, 2), np.nan)
    return {
        **_line(np.concatenate([shown, gaps], axis=1).reshape(-1, 2), f"{name}s"),
        "mode": "lines+markers",
        "line": {"color": _EDGE_COLOURS[name], "width": 1.2},
        "opacity": 0.7,
        "marker": {"color": _EDGE_COLOURS[name], "size": 4},
        "hovertemplate": f"{name}<br>%{{x:.1f}}, %{{y:.1f}} m<extra></extra>",
    }


def _ends(path: Array) -> list[dict[str, Any]]:
    """Return marks where the path starts and ends."""
    if len(path) == 0:
        return []
    marks = (("start", "circle", path[:1]), ("end", "square", path[-1:]))
    return [
        {
            "type": "scatter",
            "mode": "markers",
            **_xy(place),
            "marker": {
                "symbol": symbol,
                "size": 11,
                "color": "--estimate",
                "line": {"color": "--surface", "width": 2},
            },
            "hovertemplate": f"{word}<br>%{{x:.2f}}, %{{y:.2f}} m<extra></extra>",
        }
        for word, symbol, place in marks
    ]


def _line(path: Array, name: str) -> dict[str, Any]:
    return {"type": "scatter", "mode": "lines", "name": name, **_xy(path)}


def _xy(path: Array) -> dict[str, Array]:
    return {"x": path[:, 0], "y": path[:, 1]}


def _thin_path(path: Array) -> NDArray[np.intp]:
    """Choose poses that keep the corners of (N, 3) positions."""
    return np.union1d(thin(path[:, 0], POINTS // 2), thin(path[:, 1], POINTS // 2))


def _moved(positions: Array, comparison: TrajectoryComparison | None) -> Array:
    return positions if comparison is None else comparison.alignment.move(positions)


def _colour_axis(title: str, low: float, high: float, scale: list[list[Any]]) -> dict[str, Any]:
    bar = {"title": {"text": title, "side": "right"}, "thickness": 12, "outlinewidth": 0}
    return {"cmin": low, "cmax": high, "colorscale": scale, "colorbar": bar}


def _top(values: Array) -> float:
    """Return where a scale of colours ends."""
    return max(float(np.percentile(values, _STRAYS)), 1e-9) if len(values) else 1.0


def _clipped(values: Array) -> str:
    if len(values) == 0:
        return ""
    share, greatest = 100 - _STRAYS, show(np.max(values))
    return f"Colours end at {show(_top(values))} m; {share} % lie beyond, up to {greatest} m."
