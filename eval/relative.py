"""Errors of relative motion: evo's RPE, and KITTI's errors over segments of 100 to 800 m.

Sources: J. Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems* (2012); A. Geiger
et al., *Are we ready for autonomous driving?* (2012), with the odometry benchmark's choice of
segments.
"""

from typing import Any

import numpy as np
from evo.core.filters import filter_pairs_by_path
from evo.core.metrics import RPE
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_KITTI_STEP = 10  # a segment starts at every tenth pose


def rpe_by_distance(
    estimate: PoseTrajectory3D, reference: PoseTrajectory3D, delta: float
) -> dict[str, Any] | None:
    """Return RPE statistics over consecutive pieces of `delta` metres of the reference's path.

    The reference decides on the pieces, so that all estimates are judged on the same ones (evo's
    ``--pairs_from_reference``).

    Returns:
        Statistics, or None where the path is shorter than `delta`.
    """
    return _statistics(estimate, reference, filter_pairs_by_path(reference.poses_se3, delta))


def rpe_by_time(
    estimate: PoseTrajectory3D, reference: PoseTrajectory3D, delta: float
) -> dict[str, Any] | None:
    """Return RPE statistics over consecutive pieces of `delta` seconds, or None where too short.

    A piece that ends more than a tenth of `delta` late, after a gap, is left out.
    """
    stamps = reference.timestamps
    pieces = []
    start = 0
    while stamps[-1] - stamps[start] >= 0.9 * delta:
        end = int(np.searchsorted(stamps, stamps[start] + delta - 0.01 * delta))
        end = min(max(end, start + 1), len(stamps) - 1)
        if abs(stamps[end] - stamps[start] - delta) <= 0.1 * delta:
            pieces.append((start, end))
        start = end
    return _statistics(estimate, reference, pieces)


def kitti(estimate: PoseTrajectory3D, reference: PoseTrajectory3D) -> dict[str, Any] | None:
    """Return KITTI's mean relative errors, overall and by length of segment.

    Returns:
        Translation in percent and rotation in degrees per metre, or None on paths under 100 m.
    """
    distances = reference.distances
    P, Q = _matrices(estimate), _matrices(reference)
    starts = np.arange(0, len(distances), _KITTI_STEP)
    by_length: dict[str, Any] = {}
    everything: list[Array] = []
    for length in KITTI_LENGTHS:
        ends = np.searchsorted(distances, distances[starts] + length, side="right")
        first, last = starts[ends < len(distances)], ends[ends < len(distances)]
        if len(first) == 0:
            continue
        translation, angle = _relative_errors(P, Q, first, last)
        errors = np.column_stack([100 * translation / length, np.degrees(angle) / length])
        everything.append(errors)
        by_length[f"{length:.0f}"] = _kitti_means(errors)
    if not everything:
        return None
    return {**_kitti_means(np.concatenate(everything)), "by_length_m": by_length}


def _kitti_means(errors: Array) -> dict[str, Any]:
    translation, rotation = errors.mean(axis=0).tolist()
    return {
        "translation_percent": translation,
        "rotation_deg_per_m": rotation,
        "segments": len(errors),
    }


def _statistics(
    estimate: PoseTrajectory3D, reference: PoseTrajectory3D, pieces: list[tuple[int, int]]
) -> dict[str, Any] | None:
    if not pieces:
        return None
    first, last = np.array(pieces).T
    translation, angle = _relative_errors(_matrices(estimate), _matrices(reference), first, last)
    return {
        "pairs": len(pieces),
        "translation_m": summary(translation),
        "rotation_deg": summary(np.degrees(angle)),
    }


def summary(errors: Array) -> dict[str, float]:
    """Return evo's statistics of (N,) errors."""
    metric = RPE()
    metric.error = errors
    return {name: float(value) for name, value in metric.get_all_statistics().items()}


def _relative_errors(
    P: Array, Q: Array, first: NDArray[np.int64], last: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return translation (m) and angle (rad) of ``(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)``."""
    E = np.linalg.solve(np.linalg.solve(Q[first], Q[last]), np.linalg.solve(P[first], P[last]))
    angle = Rotation.from_matrix(E[:, :3, :3]).magnitude()
    return np.linalg.norm(E[:, :3, 3], axis=1), angle


def _matrices(trajectory: PoseTrajectory3D) -> Array:
    """Return the (N, 4, 4) poses."""
    T = np.tile(np.eye(4), (trajectory.num_poses, 1, 1))
    quaternions = np.roll(trajectory.orientations_quat_wxyz, -1, axis=1)
    T[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    T[:, :3, 3] = trajectory.positions_xyz
    return T
