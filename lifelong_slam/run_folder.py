"""Writes the run folder: everything that a run leaves behind, as standard files.

Systems work in the sensor's frame; here, and only here, results become poses of the base. The
map's frame is the base's pose where the system's own map has the sensor's, so with the calibration
X = `T_base_sensor` each pose becomes ``X T_map_sensor(i) X^-1`` and each map point ``X p``.
"""

import csv
import io
import os
from collections.abc import Callable
from dataclasses import astuple
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.files import atomic_write
from lifelong_slam.geometry import adjoint, invert, transform
from lifelong_slam.io.bags import write_cloud_bag, write_pose_bag
from lifelong_slam.io.g2o import write_g2o
from lifelong_slam.io.ply import write_ply
from lifelong_slam.result import Edge, GraphSnapshot
from lifelong_slam.timeline import COLUMNS, Timeline
from lifelong_slam.trajectory import Trajectory, format_seconds, write_tum

if TYPE_CHECKING:
    from lifelong_slam.runner import RunRecord

Writers = list[Callable[[], None]]

TRAJECTORY, TRAJECTORY_BAG, REFERENCE = "trajectory.tum", "trajectory.bag", "reference.tum"
MAP, MAP_BAG, REFERENCE_MAP = "map.ply", "map.bag", "reference_map.ply"
POSE_GRAPH, TIMELINE = "pose_graph.g2o", "timeline.csv"
_BLOCK = 1_000_000


def write_run(
    folder: Path,
    record: "RunRecord",
    reference: Trajectory | None,
    T_base_sensor: NDArray[np.float64],
) -> None:
    """Write trajectories, map, pose graph and timeline of a finished run; see `run_writers`."""
    for writers in run_writers(folder, record, reference, T_base_sensor):
        for write in writers:
            write()


def run_writers(
    folder: Path,
    record: "RunRecord",
    reference: Trajectory | None,
    T_base_sensor: NDArray[np.float64],
) -> tuple[Writers, Writers]:
    """Return functions that write a file each of a finished run, roughly the smallest first.

    Args:
        folder: made if it is missing; each file in it is replaced as a whole.
        record: what the run produced, in the sensor's frame.
        reference: T_world_base of the source, written as it is, or None.
        T_base_sensor: (4, 4) pose of the sensor on the base.

    Returns:
        Writers of the files that a run is judged by, and of bags with the same content.
    """
    result = record.result
    trajectory = trajectory_to_base(result.trajectory, T_base_sensor)
    points = points_to_base(result.map_points, T_base_sensor)
    graph = graph_to_base(result.graph, T_base_sensor)
    topics = {"/trajectory/base/pose": trajectory}
    if reference is not None:
        topics["/odometry/base/pose"] = reference
    stamp = int(trajectory.stamps[-1]) if len(trajectory) else 0
    return (
        [
            partial(write_tum, folder / TRAJECTORY, trajectory),
            partial(write_timeline, folder / TIMELINE, record.timeline),
            partial(_write_reference, folder / REFERENCE, reference),
            partial(write_g2o, folder / POSE_GRAPH, graph),
            partial(write_ply, folder / MAP, points),
        ],
        [
            partial(write_pose_bag, folder / TRAJECTORY_BAG, topics),
            partial(write_cloud_bag, folder / MAP_BAG, "/map", "map", stamp, points),
        ],
    )


def _write_reference(path: Path, reference: Trajectory | None) -> None:
    if reference is None:
        path.unlink(missing_ok=True)
    else:
        write_tum(path, reference)


def link_reference_map(folder: Path, surface: Path | None) -> None:
    """Have `reference_map.ply` lead to points on the true surface, or lead nowhere any more.

    A relative link: such files are large, and belong to the recording.

    Args:
        folder: the run folder.
        surface: the points, in the frame of the source's reference, or None.
    """
    link = folder / REFERENCE_MAP
    link.unlink(missing_ok=True)
    if surface is not None:
        link.symlink_to(os.path.relpath(surface.resolve(), folder.resolve()))


def trajectory_to_base(trajectory: Trajectory, T_base_sensor: NDArray[np.float64]) -> Trajectory:
    """Turn poses of the sensor into poses of the base."""
    poses = T_base_sensor @ trajectory.poses @ invert(T_base_sensor)
    return Trajectory(trajectory.stamps, poses)


def points_to_base(
    points: NDArray[np.float32], T_base_sensor: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Turn (N, 3) map points from the sensor's map frame to the base's, in blocks of memory."""
    moved = np.empty((len(points), 3), dtype=np.float32)
    for start in range(0, len(points), _BLOCK):
        block = slice(start, start + _BLOCK)
        moved[block] = transform(T_base_sensor, points[block].astype(np.float64))
    return moved


def graph_to_base(graph: GraphSnapshot, T_base_sensor: NDArray[np.float64]) -> GraphSnapshot:
    """Turn a graph of sensor poses into one of base poses.

    With X the calibration, ``X T Exp(xi) X^-1 = (X T X^-1) Exp(Ad(X) xi)``: a covariance C in the
    target's frame becomes ``Ad(X) C Ad(X)^T``.
    """
    inverse = invert(T_base_sensor)
    A = adjoint(T_base_sensor)
    edges = [
        Edge(
            edge.source,
            edge.target,
            T_base_sensor @ edge.T_source_target @ inverse,
            A @ edge.covariance @ A.T,
            edge.kind,
        )
        for edge in graph.edges
    ]
    return GraphSnapshot(
        {i: T_base_sensor @ pose @ inverse for i, pose in graph.poses.items()}, edges
    )


def write_timeline(path: Path, timeline: Timeline) -> None:
    """Write one CSV row a scan: stamp in seconds, stages in ms, graph size, memory, CPU."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for stamp, *values in map(astuple, timeline):
        writer.writerow([format_seconds(stamp), *map(_number, values)])
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def _number(value: float) -> str:
    """Format a count as it is and a measurement to the microsecond or kilobyte."""
    return str(value) if isinstance(value, int) else f"{value:.3f}"
