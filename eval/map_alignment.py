"""Moves a map onto the reference of the trajectory that it was built along."""

import numpy as np
from evo.core.trajectory import PosePath3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eval.alignment import Alignment, kabsch
from eval.trajectory import TrajectoryComparison

Array = NDArray[np.float64]

LEVER = 20.0  # m; how far from the sensor the points of a map typically are
_AS_WELL = 1.5  # times the position error that another alignment may have
_PRECISION = 1e-3  # metres, of trajectory files


def map_alignment(comparison: TrajectoryComparison) -> Alignment:
    """Return what moves the estimated map into the frame of the reference.

    That is the alignment of the trajectories; but positions leave the roll about a nearly straight
    path open, which moves no pose and turns the map. So with SE(3), orientations count as well,
    unless the positions then fit worse: then these are orientations of another body.
    """
    by_positions, pairs = comparison.alignment, comparison.pairs
    if by_positions.method != "se3":
        return by_positions
    by_poses = align_by_poses(pairs.estimate, pairs.reference)
    distances = by_poses.move(pairs.estimate.positions_xyz) - pairs.reference.positions_xyz
    fits = _rms(distances) <= _AS_WELL * _rms(comparison.differences) + _PRECISION
    return by_poses if fits else by_positions


def _rms(differences: Array) -> float:
    return float(np.sqrt((differences**2).sum(axis=1).mean()))


def align_by_poses(estimate: PosePath3D, reference: PosePath3D, lever: float = LEVER) -> Alignment:
    """Find rotation and translation that fit what was seen from paired poses, not the positions alone.

    Positions leave the rotation about a nearly straight path undetermined, which moves no position but
    turns the map. So each pose counts with its position and with the six points at a lever's length along
    its axes: Kabsch's algorithm over all of them minimises the sum of squared distances of points around
    the sensor from where the reference puts them.

    Args:
        estimate: N poses, of the same body as those of the reference.
        reference: the N poses they belong to.
        lever: metres.
    """
    R, t, _ = kabsch(_around(estimate, lever), _around(reference, lever))
    return Alignment("se3", R, t)


def _around(path: PosePath3D, lever: float) -> Array:
    """Return (7 N, 3) positions of N poses, and of the points at a lever's length along their axes."""
    quaternions = np.roll(path.orientations_quat_wxyz, -1, axis=1)
    axes = lever * Rotation.from_quat(quaternions).as_matrix().transpose(2, 0, 1)
    points: Array = path.positions_xyz + np.concatenate([np.zeros_like(axes[:1]), axes, -axes])
    return points.reshape(-1, 3)
