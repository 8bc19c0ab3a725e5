"""Moves an estimate onto its reference (paper 000, section 4.1: Kabsch's algorithm).

Sources: W. Kabsch, *A solution for the best rotation to relate two sets of vectors* (1976);
S. Umeyama, *Least-squares estimation of transformation parameters between two point patterns*
(1991).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eval.errors import AlignmentError

Array = NDArray[np.float64]
Method = Literal["none", "first_pose", "se3", "yaw", "sim3"]

_LINE = 0.01  # spread across a line, relative to the spread along it
_ROLL = 0.02  # rad; an alignment that may be off by more is worth a warning
_FAR = 1000.0  # metres
_STILL = 1e-6  # metres


@dataclass(frozen=True, slots=True)
class Alignment:
    """A similarity that maps the estimate's frame to the reference's: ``p -> scale R p + t``.

    Attributes:
        method: how it was found.
        R: (3, 3) rotation.
        t: (3,) translation in metres.
        scale: 1 unless the method is Sim(3).
        warnings: what the data leave undetermined or make suspicious.
    """

    method: Method
    R: Array
    t: Array
    scale: float = 1.0
    warnings: tuple[str, ...] = ()

    def apply(self, trajectory: PoseTrajectory3D) -> PoseTrajectory3D:
        """Return the trajectory in the reference's frame."""
        own = Rotation.from_quat(trajectory.orientations_quat_wxyz, scalar_first=True)
        return PoseTrajectory3D(
            self.move(trajectory.positions_xyz),
            (Rotation.from_matrix(self.R) * own).as_quat(scalar_first=True),
            trajectory.timestamps,
            name=trajectory.name,
        )

    def move(self, positions: Array) -> Array:
        """Map (N, 3) positions to the reference's frame."""
        return self.scale * positions @ self.R.T + self.t


def align(
    estimate: PoseTrajectory3D, reference: PoseTrajectory3D, method: Method = "se3"
) -> Alignment:
    """Find the alignment of paired poses.

    Args:
        estimate: N poses.
        reference: the N poses they belong to.
        method: `none`; `first_pose`; `se3`, rotation and translation over all pairs; `yaw`,
            rotation about z and translation over all pairs; `sim3`, as se3 with a scale.

    Raises:
        AlignmentError: the method is unknown, positions are NaN or infinite, or a scale is asked of an
            estimate that stands still.
    """
    if method not in _SOLVERS:
        raise AlignmentError(f"unknown alignment {method!r}; there are: {', '.join(_SOLVERS)}")
    if not all(np.isfinite(path.positions_xyz).all() for path in (estimate, reference)):
        raise AlignmentError("positions that are NaN or infinite can't be aligned")
    R, t, scale = _SOLVERS[method](estimate, reference)
    found = Alignment(method, R, t, scale)
    warnings = tuple(_warnings(found, estimate.positions_xyz, reference.positions_xyz))
    return Alignment(method, R, t, scale, warnings)


def kabsch(source: Array, target: Array, with_scale: bool = False) -> tuple[Array, Array, float]:
    """Return R, t and scale that minimise ``sum |scale R source_i + t - target_i|^2``.

    Args:
        source: (N, 3) points.
        target: (N, 3) points.
        with_scale: estimate the scale too, else it is 1.

    Raises:
        AlignmentError: a scale is asked for, and the source points coincide.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred = source - mean_source
    U, singular, Vt = np.linalg.svd((target - mean_target).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R: Array = U @ np.diag(signs) @ Vt
    scale = 1.0
    if with_scale:
        variance = float((centred**2).sum())
        if variance == 0:
            raise AlignmentError("an estimate that stands still has no scale")
        scale = float(singular @ signs) / variance
    return R, mean_target - scale * R @ mean_source, scale


def _none(estimate: PoseTrajectory3D, reference: PoseTrajectory3D) -> tuple[Array, Array, float]:
    return np.eye(3), np.zeros(3), 1.0


def _first_pose(
    estimate: PoseTrajectory3D, reference: PoseTrajectory3D
) -> tuple[Array, Array, float]:
    wxyz = np.stack([estimate.orientations_quat_wxyz[0], reference.orientations_quat_wxyz[0]])
    first, target = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    R = target @ first.T
    return R, reference.positions_xyz[0] - R @ estimate.positions_xyz[0], 1.0


def _se3(estimate: PoseTrajectory3D, reference: PoseTrajectory3D) -> tuple[Array, Array, float]:
    return kabsch(estimate.positions_xyz, reference.positions_xyz)


def _sim3(estimate: PoseTrajectory3D, reference: PoseTrajectory3D) -> tuple[Array, Array, float]:
    return kabsch(estimate.positions_xyz, reference.positions_xyz, with_scale=True)


def _yaw(estimate: PoseTrajectory3D, reference: PoseTrajectory3D) -> tuple[Array, Array, float]:
    source, target = estimate.positions_xyz, reference.positions_xyz
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_source, target - mean_target
    sine = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    cosine = (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]).sum()
    R = Rotation.from_euler("z", np.arctan2(sine, cosine)).as_matrix()
    return R, mean_target - R @ mean_source, 1.0


_Solver = Callable[[PoseTrajectory3D, PoseTrajectory3D], tuple[Array, Array, float]]
_SOLVERS: dict[str, _Solver] = {
    "none": _none,
    "first_pose": _first_pose,
    "se3": _se3,
    "yaw": _yaw,
    "sim3": _sim3,
}


def _warnings(found: Alignment, source: Array, target: Array) -> list[str]:
    """Say what the positions leave undetermined, and what looks like a mix of frames."""
    warnings = []
    # The least, as a turn about the common start takes the far end of a long drive anywhere.
    moved = float(np.linalg.norm(found.move(source) - source, axis=1).min())
    if moved > _FAR:
        warnings.append(
            f"the alignment moves every pose by at least {moved / 1000:.1f} km: do the frames fit?"
        )
    if found.method not in ("se3", "sim3", "yaw"):
        return warnings
    axes = 2 if found.method == "yaw" else 3
    centred = (target - target.mean(axis=0))[:, :axes]
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(target))
    rmse = float(np.sqrt(((found.move(source) - target) ** 2).sum(axis=1).mean()))
    if spread[0] <= _STILL:
        warnings.append("the reference hardly moves: the alignment's rotation is not determined")
    elif spread[0] <= rmse:
        warnings.append(
            f"errors ({rmse:.1f} m RMSE) are as large as the path (standard deviation {spread[0]:.1f} m):"
            " the alignment's rotation is not determined"
        )
    elif axes == 3 and spread[1] <= max(_LINE * spread[0], rmse / _ROLL):
        open_by = np.degrees(np.arctan2(rmse, spread[1]))
        warnings.append(
            f"the path is nearly a straight line (standard deviations: {spread[0]:.1f} m along,"
            f" {spread[1]:.2f} m across; errors of {rmse:.3f} m): the alignment leaves roll about it"
            f" open by some {open_by:.1f} deg, so absolute rotation errors mean little"
        )
    return warnings
