"""Moves an estimate onto its reference, by Kabsch's algorithm.

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
_SLIM = 0.1  # the same of a path that looks like a line
_ROLL = 0.02  # rad; an alignment that may be off by more is worth a warning
_FAR = 1000.0  # metres
_STILL = 1e-6  # metres
_MIRRORS = ((1, -1, 1), (1, 1, -1))  # of the axes; a rotation makes all others of these
_TURNED = 90.0  # deg; nearer to upside down than to upright
_BETTER = 0.7  # of the RMSE; noise makes no mirror image fit that much better


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
    warnings = tuple(_warnings(found, estimate, reference))
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
    return _scaled_kabsch(estimate.positions_xyz, reference.positions_xyz)


def _yaw(estimate: PoseTrajectory3D, reference: PoseTrajectory3D) -> tuple[Array, Array, float]:
    return _turn(estimate.positions_xyz, reference.positions_xyz)


def _scaled_kabsch(source: Array, target: Array) -> tuple[Array, Array, float]:
    return kabsch(source, target, with_scale=True)


def _turn(source: Array, target: Array) -> tuple[Array, Array, float]:
    """Return R about z, t and scale 1 that minimise what `kabsch` does."""
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
_FITS: dict[str, Callable[[Array, Array], tuple[Array, Array, float]]] = {
    "se3": kabsch,
    "yaw": _turn,
    "sim3": _scaled_kabsch,
}


def _warnings(
    found: Alignment, estimate: PoseTrajectory3D, reference: PoseTrajectory3D
) -> list[str]:
    """Say what the poses leave undetermined, and what looks like a mix of frames."""
    source, target = estimate.positions_xyz, reference.positions_xyz
    warnings = []
    # The least, as a turn about the common start takes the far end of a long drive anywhere.
    moved = float(np.linalg.norm(found.move(source) - source, axis=1).min())
    if moved > _FAR:
        warnings.append(
            f"the alignment moves every pose by at least {moved / 1000:.1f} km: do the frames fit?"
        )
    if found.method not in _FITS:
        return warnings
    spread = _spread(target, 2 if found.method == "yaw" else 3)
    errors = _errors(found, source, target)
    rmse = _rms(errors)
    if spread[0] <= _STILL:
        return [*warnings, "the reference hardly moves: the alignment's rotation is not determined"]
    mirrored = _mirrored_errors(found.method, source, target)
    if _rms(mirrored) < _BETTER * rmse:
        cause = "left-handed or upside down" if found.method == "yaw" else "left-handed"
        warnings.append(
            f"a mirror image of the estimate fits: mean error {mirrored.mean():.3f} m instead of"
            f" {errors.mean():.3f} m; is one of the two {cause}, with an axis the wrong way round?"
        )
    elif spread[0] <= rmse:
        warnings.append(
            f"errors ({rmse:.1f} m RMSE) are as large as the path (standard deviation {spread[0]:.1f} m):"
            " the alignment's rotation is not determined"
        )
    elif len(spread) == 3 and spread[1] <= max(_LINE * spread[0], rmse / _ROLL):
        warnings.append(_open_roll(spread, rmse))
    if _BETTER <= (_rms(mirrored) + _STILL) / (rmse + _STILL) <= 1 / _BETTER:
        warnings += _flat(spread, errors, mirrored, _median_turn(found, estimate, reference))
    return warnings


def _flat(spread: Array, errors: Array, mirrored: Array, turn: float) -> list[str]:
    """Say what a path means that its mirror image fits as well, if its poses are turned by a lot."""
    line = len(spread) == 3 and spread[1] <= _SLIM * spread[0]  # roll alone would explain it
    if line or turn <= _TURNED or spread[0] <= _rms(errors):
        return []
    return [
        f"rotation errors are about {turn:.0f} deg, and the path is so flat that a mirror image fits as"
        f" well (mean error {mirrored.mean():.3f} m, {errors.mean():.3f} m as it is): the estimate is"
        " left-handed, or its poses have other axes, as with z down"
    ]


def _open_roll(spread: Array, rmse: float) -> str:
    """Say by how much errors leave the rotation about the path's longest extent open."""
    extents = f"standard deviations: {spread[0]:.1f} m along, {spread[1]:.2f} m across"
    if spread[1] <= _SLIM * spread[0]:
        reason = f"the path is nearly a straight line ({extents}; errors of {rmse:.3f} m)"
    else:
        reason = f"errors of {rmse:.3f} m are large for the path ({extents})"
    return (
        f"{reason}: the alignment leaves roll about {'it' if 'line' in reason else 'its long axis'}"
        f" open by some {np.degrees(np.arctan2(rmse, spread[1])):.1f} deg, so absolute rotation errors mean"
        " little"
    )


def _spread(positions: Array, axes: int) -> Array:
    """Return the standard deviations along the principal axes in metres, the largest first."""
    centred = (positions - positions.mean(axis=0))[:, :axes]
    return np.asarray(np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(positions)))


def _errors(found: Alignment, source: Array, target: Array) -> Array:
    return np.asarray(np.linalg.norm(found.move(source) - target, axis=1))


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))


def _mirrored_errors(method: Method, source: Array, target: Array) -> Array:
    """Return (N,) errors in metres of the mirror image that fits best."""
    images = [source * mirror for mirror in _MIRRORS]
    fits = [Alignment(method, *_FITS[method](image, target)) for image in images]
    return min(map(_errors, fits, images, [target] * len(images)), key=_rms)


def _median_turn(
    found: Alignment, estimate: PoseTrajectory3D, reference: PoseTrajectory3D
) -> float:
    """Return the median angle in degrees between aligned and true orientations."""
    wxyz = (path.orientations_quat_wxyz for path in (found.apply(estimate), reference))
    aligned, true = (Rotation.from_quat(q, scalar_first=True) for q in wxyz)
    return float(np.degrees(np.median((aligned.inv() * true).magnitude())))
