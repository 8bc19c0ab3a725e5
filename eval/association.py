"""Pairs the poses of an estimate with a reference's (paper 000, section 4.1).

evo's own matching lets two poses claim one and snaps to the nearest stamp. Here each pose of the
estimate meets the reference interpolated at its own stamp, where the reference is dense enough.
"""

from dataclasses import dataclass

import numpy as np
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from eval.errors import AssociationError

# Acceleration a bends the path between two reference poses by up to a * gap^2 / 8: 4 cm at 0.25 s
# and 5 m/s^2. References come at 10 Hz or faster; a longer gap means that some are missing.
MAX_GAP = 0.25
# Two stamps closer than this are one instant: float seconds since 1970 resolve 0.2 us.
_SAME = 1e-6
_FEWEST = 3


@dataclass(frozen=True, slots=True)
class Pairs:
    """Matched poses.

    Attributes:
        estimate: N poses as estimated.
        reference: the N poses of the reference at the same instants.
        stamped: whether the stamps mean time; without, they count poses.
        estimated: poses of the estimate before matching.
        outside: those before the reference begins or after it ends.
        in_gaps: those between two reference poses too far apart for interpolation.
        repeated: those whose stamp an earlier pose has already.
        coverage: share of the reference's duration between the first and the last matched pose.
    """

    estimate: PoseTrajectory3D
    reference: PoseTrajectory3D
    stamped: bool
    estimated: int
    outside: int
    in_gaps: int
    repeated: int
    coverage: float


def associate(
    estimate: PoseTrajectory3D, reference: PoseTrajectory3D, max_gap: float = MAX_GAP
) -> Pairs:
    """Interpolate the reference at the estimate's stamps, within the overlap in time.

    Positions are interpolated linearly, orientations along the shortest arc.

    Args:
        estimate: poses to be judged.
        reference: poses to trust, in order of time.
        max_gap: longest time in seconds between two reference poses to interpolate across.

    Raises:
        AssociationError: fewer than three poses match, or stamps run back.
    """
    stamps, times = estimate.timestamps, reference.timestamps
    if (np.diff(stamps) < 0).any() or (np.diff(times) < 0).any():
        raise AssociationError("stamps run back; poses must be in order of time")
    if times[-1] == times[0]:
        raise AssociationError("the reference needs at least two poses at different instants")
    fresh = np.diff(stamps, prepend=-np.inf) > 0
    within, gap = _surroundings(times, stamps)
    inside, dense = fresh & within, gap <= max_gap
    matched = inside & dense
    if matched.sum() < _FEWEST:
        raise AssociationError(
            _why(stamps, times, int(inside.sum()), gap[inside & ~dense], max_gap)
        )
    return Pairs(
        estimate=_select(estimate, matched),
        reference=interpolate(reference, stamps[matched]),
        stamped=True,
        estimated=len(stamps),
        outside=int((fresh & ~inside).sum()),
        in_gaps=int((inside & ~dense).sum()),
        repeated=int((~fresh).sum()),
        coverage=_coverage(stamps[matched], times),
    )


def within_reach(
    trajectory: PoseTrajectory3D, stamps: NDArray[np.float64], max_gap: float = MAX_GAP
) -> NDArray[np.bool_]:
    """Return for each stamp whether the trajectory can be interpolated there.

    Args:
        trajectory: poses in order of time; nothing is within reach of a single one.
        stamps: seconds, of any shape.
        max_gap: longest time in seconds between two poses to interpolate across.
    """
    times = trajectory.timestamps
    within, gap = _surroundings(times, stamps)
    reached: NDArray[np.bool_] = within & (gap <= max_gap) & (times[0] < times[-1])
    return reached


def interpolate(trajectory: PoseTrajectory3D, stamps: NDArray[np.float64]) -> PoseTrajectory3D:
    """Return the trajectory at (M,) stamps that lie within it, give or take a microsecond."""
    unique = np.diff(trajectory.timestamps, prepend=-np.inf) > 0
    times = trajectory.timestamps[unique]
    within = np.clip(stamps, times[0], times[-1])
    wxyz = trajectory.orientations_quat_wxyz[unique]
    rotations = Slerp(times, Rotation.from_quat(wxyz, scalar_first=True))(within)
    positions = trajectory.positions_xyz[unique]
    return PoseTrajectory3D(
        np.column_stack([np.interp(within, times, positions[:, axis]) for axis in range(3)]),
        rotations.as_quat(scalar_first=True),
        stamps,
        name=trajectory.name,
    )


def pair_by_index(estimate: PosePath3D, reference: PosePath3D) -> Pairs:
    """Pair poses without stamps one by one, as in KITTI's files.

    Raises:
        AssociationError: the numbers of poses differ, or there are fewer than three.
    """
    count = reference.num_poses
    if estimate.num_poses != count:
        raise AssociationError(
            f"without stamps both need as many poses: {estimate.num_poses} estimated,"
            f" {count} in the reference"
        )
    if count < _FEWEST:
        raise AssociationError(f"{count} poses are too few to compare; it takes {_FEWEST}")
    counted = [
        PoseTrajectory3D(
            path.positions_xyz,
            path.orientations_quat_wxyz,
            np.arange(count, dtype=float),
            name=path.name,
        )
        for path in (estimate, reference)
    ]
    return Pairs(counted[0], counted[1], False, count, 0, 0, 0, 1.0)


def _select(trajectory: PoseTrajectory3D, chosen: NDArray[np.bool_]) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        trajectory.positions_xyz[chosen],
        trajectory.orientations_quat_wxyz[chosen],
        trajectory.timestamps[chosen],
        name=trajectory.name,
    )


def _surroundings(
    times: NDArray[np.float64], stamps: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return for each stamp whether it lies within the times, and the gap there in seconds.

    At one of the times, the gap is 0.
    """
    within = (stamps >= times[0] - _SAME) & (stamps <= times[-1] + _SAME)
    after = np.clip(np.searchsorted(times, stamps), 1, len(times) - 1)
    nearest = np.minimum(np.abs(stamps - times[after]), np.abs(stamps - times[after - 1]))
    return within, np.where(nearest <= _SAME, 0.0, times[after] - times[after - 1])


def _coverage(matched: NDArray[np.float64], times: NDArray[np.float64]) -> float:
    duration = times[-1] - times[0]
    return float(min((matched[-1] - matched[0]) / duration, 1.0)) if duration > 0 else 1.0


def _why(
    stamps: NDArray[np.float64],
    times: NDArray[np.float64],
    inside: int,
    gaps: NDArray[np.float64],
    max_gap: float,
) -> str:
    """Say why too few poses match."""
    if inside < _FEWEST:
        return (
            f"only {inside} of {len(stamps)} poses lie within the reference's time: estimate"
            f" {stamps[0]:.3f} to {stamps[-1]:.3f} s, reference {times[0]:.3f} to {times[-1]:.3f} s"
        )
    return (
        f"reference poses are {np.median(gaps):.3f} s apart, too far to interpolate:"
        f" allow more than max_gap={max_gap} s if that is meant"
    )
