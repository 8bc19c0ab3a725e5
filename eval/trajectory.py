"""Judges a trajectory against a reference: paper 000, section 4.1, and evo's and KITTI's errors."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eval import relative
from eval.alignment import Alignment, Method, align
from eval.association import MAX_GAP, Pairs, associate

Array = NDArray[np.float64]

PERCENTILES = (50, 75, 90, 95, 99)
RPE_METRES = (1.0, 10.0)
RPE_SECONDS = 1.0
# What needs a reference, and is null without one.
REFERENCED = (
    "mae_m",
    "mae_x_m",
    "mae_y_m",
    "mae_z_m",
    "mse_m2",
    "rmse_m",
    "max_m",
    "percentiles_m",
    "ape_translation_m",
    "ape_rotation_deg",
    "rpe",
    "kitti",
    "coverage",
    "alignment",
)


@dataclass(frozen=True, slots=True)
class TrajectoryComparison:
    """Paired and aligned trajectories with their differences.

    Attributes:
        pairs: the poses before alignment.
        alignment: what moves the estimate onto the reference.
        estimate: the N paired poses of the estimate, aligned.
        differences: (N, 3) estimated minus reference positions in metres, in the reference's frame.
    """

    pairs: Pairs
    alignment: Alignment
    estimate: PoseTrajectory3D
    differences: Array

    @property
    def reference(self) -> PoseTrajectory3D:
        """The N poses of the reference, at the estimate's stamps."""
        return self.pairs.reference

    @property
    def errors(self) -> Array:
        """(N,) Euclidean position errors e_i in metres."""
        return np.asarray(np.linalg.norm(self.differences, axis=1))

    @property
    def distances(self) -> Array:
        """(N,) metres along the reference's path up to each pair."""
        return np.asarray(self.reference.distances)


def compare_trajectories(
    estimate: PoseTrajectory3D,
    reference: PoseTrajectory3D,
    alignment: Method = "se3",
    max_gap: float = MAX_GAP,
) -> TrajectoryComparison:
    """Associate by stamp and align.

    Raises:
        AssociationError: fewer than three poses match.
        AlignmentError: the alignment is unknown or has no solution.
    """
    return compare_pairs(associate(estimate, reference, max_gap), alignment)


def compare_pairs(pairs: Pairs, alignment: Method = "se3") -> TrajectoryComparison:
    """Align trajectories that are paired already.

    Raises:
        AlignmentError: the alignment is unknown or has no solution.
    """
    found = align(pairs.estimate, pairs.reference, alignment)
    aligned = found.apply(pairs.estimate)
    return TrajectoryComparison(
        pairs, found, aligned, aligned.positions_xyz - pairs.reference.positions_xyz
    )


def trajectory_metrics(comparison: TrajectoryComparison) -> dict[str, Any]:
    """Return the metrics of section `trajectory` in metrics.json; units are in the names.

    Relative errors are null where the path or the time is too short for them.
    """
    errors, differences = comparison.errors, np.abs(comparison.differences)
    mean_axes = differences.mean(axis=0).tolist()
    return {
        "mae_m": float(errors.mean()),
        "mae_x_m": mean_axes[0],
        "mae_y_m": mean_axes[1],
        "mae_z_m": mean_axes[2],
        "mse_m2": float((errors**2).mean()),
        "rmse_m": float(np.sqrt((errors**2).mean())),
        "max_m": float(errors.max()),
        "percentiles_m": {
            str(p): float(value)
            for p, value in zip(PERCENTILES, np.percentile(errors, PERCENTILES), strict=True)
        },
        "ape_translation_m": relative.summary(errors),
        "ape_rotation_deg": relative.summary(_rotation_errors(comparison)),
        "rpe": _rpe(comparison),
        "kitti": relative.kitti(comparison.estimate, comparison.reference),
        **_extent(comparison),
    }


def _rotation_errors(comparison: TrajectoryComparison) -> Array:
    """Return the (N,) angles in degrees of ``R_estimate^-1 R_reference``, as evo's APE has them."""
    wxyz = (t.orientations_quat_wxyz for t in (comparison.estimate, comparison.reference))
    estimated, true = (Rotation.from_quat(np.roll(q, -1, axis=1)) for q in wxyz)
    angles: Array = np.degrees((estimated.inv() * true).magnitude())
    return angles


def _rpe(comparison: TrajectoryComparison) -> dict[str, Any]:
    pair = (comparison.estimate, comparison.reference)
    by_delta = {f"{delta:g} m": relative.rpe_by_distance(*pair, delta) for delta in RPE_METRES}
    if comparison.pairs.stamped:
        by_delta[f"{RPE_SECONDS:g} s"] = relative.rpe_by_time(*pair, RPE_SECONDS)
    return by_delta


def _extent(comparison: TrajectoryComparison) -> dict[str, Any]:
    """Say what was compared, and how it was aligned."""
    pairs, alignment = comparison.pairs, comparison.alignment
    return {
        "path_length_m": float(pairs.estimate.path_length),
        "reference_path_length_m": float(pairs.reference.path_length),
        "poses": {
            "estimated": pairs.estimated,
            "matched": int(pairs.estimate.num_poses),
            "outside_reference": pairs.outside,
            "in_reference_gaps": pairs.in_gaps,
            "repeated_stamps": pairs.repeated,
        },
        "coverage": pairs.coverage,
        "alignment": {
            "method": alignment.method,
            "rotation": alignment.R.tolist(),
            "translation_m": alignment.t.tolist(),
            "scale": alignment.scale,
        },
        "warnings": list(alignment.warnings),
    }
