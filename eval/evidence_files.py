"""Reads the files that a SLAM system is judged by."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from numpy.typing import DTypeLike

from eval.alignment import Alignment, Method
from eval.association import MAX_GAP, associate, pair_by_index
from eval.errors import AlignmentError, AssociationError
from eval.evidence import Evidence
from eval.files import read_graph, read_timeline
from eval.grid import Grid, read_grid
from eval.map_alignment import map_alignment
from eval.nearest import Points
from eval.relations import Relations, read_relations
from eval.trajectory import TrajectoryComparison, compare_pairs
from eval.trajectory_files import read_trajectory

_BLOCK = 1_000_000


@dataclass(frozen=True, slots=True)
class EvidenceFiles:
    """Where the evidence lies; None where there is none.

    Attributes:
        estimate: estimated trajectory.
        reference: trajectory to trust.
        topic: of the estimate, where it is a bag with several.
        reference_topic: of the reference.
        relations: true relative poses.
        map: estimated points, in the frame of `estimate`.
        reference_map: points to trust, in the frame of `reference`.
        grid: estimated occupancy grid.
        reference_grid: occupancy grid to trust.
        graph: final pose graph.
        timeline: one row a scan.
    """

    estimate: Path | None = None
    reference: Path | None = None
    topic: str | None = None
    reference_topic: str | None = None
    relations: Path | None = None
    map: Path | None = None
    reference_map: Path | None = None
    grid: Path | None = None
    reference_grid: Path | None = None
    graph: Path | None = None
    timeline: Path | None = None


def read_evidence(
    files: EvidenceFiles,
    alignment: Method = "se3",
    max_gap: float = MAX_GAP,
    run: Mapping[str, Any] | None = None,
) -> Evidence:
    """Read what there is, pair and align the trajectories, and take the map with them.

    Where there are both trajectories and a reference map, the map is moved into the frame of the
    reference, see `map_alignment`. Trajectories that can't be compared are a reason, not an error.

    Args:
        files: to read.
        alignment: how the estimate is moved onto the reference.
        max_gap: longest time in seconds between two reference poses to interpolate across.
        run: what the run knows about itself.

    Raises:
        FileError: a file is missing or malformed.
    """
    estimate = _read_trajectory(files.estimate, files.topic)
    reference = _read_trajectory(files.reference, files.reference_topic)
    comparison, reason = _compare(estimate, reference, alignment, max_gap)
    points, surface = _read_map(files.map), _read_map(files.reference_map)
    if points is not None and surface is not None and comparison is not None:
        points = _move(map_alignment(comparison), points, surface.dtype)
    return Evidence(
        estimate=_stamped(estimate),
        comparison=comparison,
        relations=_read_relations(files.relations),
        map=points,
        reference_map=surface,
        grid=_read_grid(files.grid),
        reference_grid=_read_grid(files.reference_grid),
        graph=read_graph(files.graph) if files.graph else None,
        timeline=read_timeline(files.timeline) if files.timeline else None,
        run=run or {},
        reasons={"comparison": reason} if reason else {},
    )


def _compare(
    estimate: PosePath3D | None,
    reference: PosePath3D | None,
    alignment: Method,
    max_gap: float,
) -> tuple[TrajectoryComparison | None, str | None]:
    """Compare to the reference, or say why that can't be done."""
    if estimate is None or reference is None:
        absent = "estimated" if estimate is None else "reference"
        return None, f"there is no {absent} trajectory"
    try:
        if isinstance(estimate, PoseTrajectory3D) and isinstance(reference, PoseTrajectory3D):
            pairs = associate(estimate, reference, max_gap)
        else:
            pairs = pair_by_index(estimate, reference)
        return compare_pairs(pairs, alignment), None
    except (AssociationError, AlignmentError) as error:
        return None, str(error)


def _stamped(trajectory: PosePath3D | None) -> PoseTrajectory3D | None:
    """Count the poses of a trajectory without stamps instead."""
    if trajectory is None or isinstance(trajectory, PoseTrajectory3D):
        return trajectory
    return PoseTrajectory3D(
        trajectory.positions_xyz,
        trajectory.orientations_quat_wxyz,
        np.arange(trajectory.num_poses, dtype=float),
    )


def _move(alignment: Alignment, points: Points, dtype: DTypeLike) -> Points:
    """Return (N, 3) points in the reference's frame, as precise as its own, in blocks of memory."""
    moved: Points = np.empty(points.shape, dtype=np.result_type(points, dtype))
    for start in range(0, len(points), _BLOCK):
        block = slice(start, start + _BLOCK)
        moved[block] = alignment.move(points[block].astype(np.float64))
    return moved


def _read_trajectory(path: Path | None, topic: str | None) -> PosePath3D | None:
    return None if path is None else read_trajectory(path, topic)


def _read_map(path: Path | None) -> Points | None:
    if path is None:
        return None
    from eval.map_files import read_map  # may need Open3D: only where there is a map

    return read_map(path)


def _read_relations(path: Path | None) -> Relations | None:
    return None if path is None else read_relations(path)


def _read_grid(path: Path | None) -> Grid | None:
    return None if path is None else read_grid(path)
