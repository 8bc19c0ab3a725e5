"""Errors of relative motion: evo's RPE, and KITTI's errors over segments of 100 to 800 m.

Sources: J. Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems* (2012); A. Geiger
et al., *Are we ready for autonomous driving?* (2012), with the odometry benchmark's choice of
segments.
"""

from dataclasses import dataclass

import numpy as np
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_KITTI_STEP = 10  # a segment starts at every tenth pose
_SAME_DISTANCE = 1e-6  # metres: sums of a thousand steps of 0.1 m reach 100 m


@dataclass(frozen=True, slots=True)
class RelativeErrors:
    """Errors of the estimated motion over M pieces of the path.

    Attributes:
        first: (M,) index of the pose that a piece starts at.
        last: (M,) index of the pose that it ends at.
        translation: (M,) metres.
        rotation: (M,) degrees.
    """

    first: Indices
    last: Indices
    translation: Array
    rotation: Array


def relative_errors(
    estimate: PosePath3D, reference: PosePath3D, first: Indices, last: Indices
) -> RelativeErrors:
    """Return the size of ``(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`` for estimated P and true Q.

    Args:
        estimate: N poses.
        reference: the N poses they belong to.
        first: (M,) indices i.
        last: (M,) indices j.
    """
    turn, move = _motion(estimate, first, last)
    true_turn, true_move = _motion(reference, first, last)
    # (Q^-1 P) translates by R_Q^T (p - q), as far as p - q.
    translation = np.linalg.norm(move - true_move, axis=1)
    rotation = np.degrees((true_turn.inv() * turn).magnitude())
    return RelativeErrors(first, last, translation, rotation)


def over_distance(
    estimate: PosePath3D, reference: PosePath3D, delta: float
) -> RelativeErrors | None:
    """Return the errors over consecutive pieces of `delta` metres of the reference's path.

    The reference decides on the pieces, so that all estimates are judged on the same ones (evo's
    ``--pairs_from_reference``).

    Returns:
        The errors, or None where the path is shorter than `delta`.
    """
    along = reference.distances
    first, last = _consecutive(np.searchsorted(along, along + delta - _SAME_DISTANCE))
    return relative_errors(estimate, reference, first, last) if len(first) else None


def over_time(
    estimate: PosePath3D, reference: PoseTrajectory3D, delta: float
) -> RelativeErrors | None:
    """Return the errors over consecutive pieces of `delta` seconds, or None where too short.

    Stamps may be off by a hundredth of `delta`; a piece that ends more than a tenth late, after a
    gap, is left out.
    """
    stamps = reference.timestamps
    first, last = _consecutive(np.searchsorted(stamps, stamps + 0.99 * delta))
    in_time = stamps[last] - stamps[first] <= 1.1 * delta
    first, last = first[in_time], last[in_time]
    return relative_errors(estimate, reference, first, last) if len(first) else None


def over_kitti_segments(
    estimate: PosePath3D, reference: PosePath3D
) -> tuple[Array, RelativeErrors] | None:
    """Return KITTI's segments: (M,) nominal lengths in metres, and the errors over each.

    A segment ends at the first pose beyond its length.

    Returns:
        Lengths and errors, or None on paths under 100 m.
    """
    along = reference.distances
    starts = np.arange(0, len(along), _KITTI_STEP)
    ends = [np.searchsorted(along, along[starts] + n, side="right") for n in KITTI_LENGTHS]
    first, last = np.tile(starts, len(KITTI_LENGTHS)), np.concatenate(ends)
    lengths = np.repeat(KITTI_LENGTHS, len(starts))
    inside = last < len(along)
    if not inside.any():
        return None
    errors = relative_errors(estimate, reference, first[inside], last[inside])
    return lengths[inside], errors


def _consecutive(ends: Indices) -> tuple[Indices, Indices]:
    """Chain pieces from pose 0 on, given where a piece that starts at each of the N poses ends."""
    following = np.maximum(
        ends, np.arange(len(ends)) + 1
    ).tolist()  # beyond 1e16 m, no piece is longer
    chain = [0]
    while (end := following[chain[-1]]) < len(following):
        chain.append(end)
    found = np.array(chain, dtype=np.int64)
    return found[:-1], found[1:]


def _motion(path: PosePath3D, first: Indices, last: Indices) -> tuple[Rotation, Array]:
    """Return rotations and (M, 3) translations of ``P_i^-1 P_j``."""
    rotations = Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True)
    back = rotations[first].inv()
    move = back.apply(path.positions_xyz[last] - path.positions_xyz[first])
    return back * rotations[last], np.asarray(move).reshape(-1, 3)
