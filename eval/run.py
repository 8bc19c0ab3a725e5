"""Evaluates a run folder: metrics.json and plots/ from the files that a run left."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from matplotlib.figure import Figure
from numpy.typing import NDArray

from eval import plots
from eval.alignment import Method
from eval.errors import AlignmentError, AssociationError
from eval.files import (
    GraphSketch,
    Timeline,
    read_graph,
    read_points,
    read_timeline,
    read_tum,
    write_json,
)
from eval.trajectory import (
    REFERENCED,
    TrajectoryComparison,
    compare_trajectories,
    trajectory_metrics,
)

_log = logging.getLogger(__name__)

STAGES = ("odometry", "loop", "optimise", "prune")


def evaluate_run(
    folder: Path, run_info: dict[str, Any] | None = None, alignment: Method = "se3"
) -> dict[str, Any]:
    """Read the files of a run folder, write metrics.json and plots/ into it, return the metrics.

    What can't be computed is null, with the reason beside it; everything else is still there.

    Args:
        folder: a run folder with trajectory.tum, map.ply, pose_graph.g2o and timeline.csv, and
            reference.tum where there is one.
        run_info: section `run` of metrics.json, such as versions, seed and machine; without it,
            that of an earlier metrics.json is kept. Its `wall_seconds`, `peak_rss_mb` and
            `cpu_percent`, where present, also go into section `resources`.
        alignment: how the estimate is moved onto the reference.

    Raises:
        FileError: a file of the run folder is missing or malformed; the reference may be missing.
    """
    run_info = _earlier_info(folder) if run_info is None else run_info
    estimate = read_tum(folder / "trajectory.tum")
    graph = read_graph(folder / "pose_graph.g2o")
    points = read_points(folder / "map.ply")
    timeline = read_timeline(folder / "timeline.csv")
    comparison, reason = _compare(estimate, folder / "reference.tum", alignment)
    metrics = {
        "trajectory": {"reason": reason, **_trajectory_metrics(estimate, comparison)},
        "map": _map_metrics(points),
        "resources": _resources(timeline, run_info),
        "graph": _graph_metrics(graph),
        "run": run_info,
    }
    write_json(folder / "metrics.json", metrics)
    figures = _figures(estimate, comparison, graph, points, timeline)
    for name, figure in figures.items():
        plots.save(figure, folder / "plots" / f"{name}.png")
    return metrics


def _earlier_info(folder: Path) -> dict[str, Any]:
    """Return section `run` of an earlier metrics.json, if there is one."""
    try:
        info = json.loads((folder / "metrics.json").read_text())["run"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return info if isinstance(info, dict) else {}


def _compare(
    estimate: PoseTrajectory3D, path: Path, alignment: Method
) -> tuple[TrajectoryComparison | None, str | None]:
    """Compare to the reference, or say why that can't be done."""
    if not path.is_file():
        return None, "the source has no reference trajectory"
    try:
        return compare_trajectories(estimate, read_tum(path), alignment), None
    except (AssociationError, AlignmentError) as error:
        _log.warning("trajectory not compared: %s", error)
        return None, str(error)


def _trajectory_metrics(
    estimate: PoseTrajectory3D, comparison: TrajectoryComparison | None
) -> dict[str, Any]:
    if comparison is not None:
        return trajectory_metrics(comparison)
    without = {
        "path_length_m": float(estimate.path_length),
        "poses": {"estimated": estimate.num_poses},
    }
    return {**dict.fromkeys(REFERENCED), **without}


def _map_metrics(points: NDArray[np.float32]) -> dict[str, Any]:
    if len(points) == 0:
        return {"points": 0, "min_m": None, "max_m": None, "extent_m": None}
    low, high = points.min(axis=0).astype(float), points.max(axis=0).astype(float)
    return {
        "points": len(points),
        "min_m": low.tolist(),
        "max_m": high.tolist(),
        "extent_m": (high - low).tolist(),
    }


def _resources(timeline: Timeline, run_info: dict[str, Any]) -> dict[str, Any]:
    """Sum up the timeline; wall time, memory and CPU of the whole run where it measured them."""
    stages = {name: timeline[f"{name}_ms"] for name in STAGES if f"{name}_ms" in timeline}
    total = np.sum(list(stages.values()), axis=0)
    scans = len(timeline["stamp"])
    wall = run_info.get("wall_seconds")
    seconds = wall if wall else float(np.sum(total)) / 1000
    sampled = timeline["rss_mb"].max() if scans else None
    return {
        "scans": scans,
        "scans_per_s": scans / seconds if seconds > 0 else None,
        "wall_s": wall,
        "processing_s": float(np.sum(total)) / 1000,
        "peak_rss_mb": run_info.get("peak_rss_mb") or sampled,
        "cpu_percent": run_info.get("cpu_percent"),
        "stages_ms": {name: _spread(values) for name, values in {**stages, "total": total}.items()},
    }


def _spread(values: NDArray[np.float64]) -> dict[str, float] | None:
    """Return mean, percentiles, maximum and sum of (N,) values."""
    if np.size(values) == 0:
        return None
    p50, p95, p99 = np.percentile(values, (50, 95, 99)).tolist()
    return {
        "mean": float(values.mean()),
        "p50": p50,
        "p95": p95,
        "p99": p99,
        "max": float(values.max()),
        "sum": float(values.sum()),
    }


def _graph_metrics(graph: GraphSketch) -> dict[str, int]:
    loops = int(graph.is_loop.sum())
    return {
        "vertices": len(graph.positions),
        "edges": len(graph.edges),
        "odometry_edges": len(graph.edges) - loops,
        "loop_edges": loops,
    }


def _figures(
    estimate: PoseTrajectory3D,
    comparison: TrajectoryComparison | None,
    graph: GraphSketch,
    points: NDArray[np.float32],
    timeline: Timeline,
) -> dict[str, Figure]:
    """Draw every figure by the name of its file."""
    figures = {
        "trajectory": plots.trajectory(estimate, comparison, graph),
        "growth": plots.growth(timeline),
        "stages": plots.stages(timeline, STAGES),
        "map": plots.map_from_above(points, estimate.positions_xyz),
    }
    if comparison is not None:
        figures["errors"] = plots.errors(comparison)
    return figures
