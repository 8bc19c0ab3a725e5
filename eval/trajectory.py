"""Compares a trajectory to a reference (paper 000, section 4.1)."""

from dataclasses import dataclass

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eval.alignment import Alignment, Method, align
from eval.association import MAX_GAP, Pairs, associate

Array = NDArray[np.float64]

_FEW = 0.5  # share that should at least have been compared
_TINY = 10  # poses; an alignment has up to seven degrees of freedom


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
    def rotation_errors(self) -> Array:
        """(N,) angles of ``R_estimate^-1 R_reference`` in degrees, as evo's APE has them."""
        quaternions = (t.orientations_quat_wxyz for t in (self.estimate, self.reference))
        estimated, true = (Rotation.from_quat(q, scalar_first=True) for q in quaternions)
        angles: Array = np.degrees((estimated.inv() * true).magnitude())
        return angles

    @property
    def seconds(self) -> Array:
        """(N,) seconds since the first pair; poses, if there are no stamps."""
        return np.asarray(self.reference.timestamps - self.reference.timestamps[0])

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes all errors doubtful: an odd alignment, or how little was compared."""
        pairs, warnings = self.pairs, [*self.alignment.warnings]
        matched = pairs.estimate.num_poses
        if matched < _FEW * pairs.estimated:
            warnings.append(
                f"only {matched} of {pairs.estimated} estimated poses were compared:"
                f" {pairs.outside} lie outside the reference's time, {pairs.in_gaps} in its gaps,"
                f" {pairs.repeated} repeat a stamp"
            )
        if matched < _TINY:
            warnings.append(
                f"only {matched} poses were compared: the alignment makes so few fit, however wrong"
            )
        if pairs.coverage < _FEW:
            warnings.append(
                f"the estimate covers only {100 * pairs.coverage:.0f} % of the reference's duration"
            )
        return tuple(warnings)

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
