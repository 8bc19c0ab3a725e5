"""What a registration's Hessian can't tell about its error: noise and motion distortion.

The Hessian says which motions the surfaces hold, and how well if they were as GICP models them. Two things
come on top, and both show in how far the constant-velocity prediction was off:

- *Noise* that scans don't share. GICP's model of it is too good in some directions, in pitch above all.
  It is what is left of the motion when all that is smooth is taken away.
- *Distortion.* A sweep is deskewed by one velocity, which lags behind where the sensor accelerates. What
  that does to the pose follows from where the surfaces lie that were swept early and late.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lifelong_slam.registration import PLANE_THICKNESS, Cloud
from lifelong_slam.scan import Scan

Array = NDArray[np.float64]

_FORGETTING = 0.05  # weight of the newest scan: a memory of two seconds at 10 Hz
_THIRD_DIFFERENCE = 20.0  # 1 + 9 + 9 + 1, the variance of a third difference of white noise
_VOTERS = 200  # points that stand for a scan's surfaces; 400 changed NEES by a fifth at most
_CLOCKS = 1000  # points that tell when a place was swept, a third of a degree apart in 360
_ANGULAR_ACCELERATION = 0.5  # rad/s^2 that constant velocity leaves out, a standard deviation
_ACCELERATION = 1.0  # m/s^2, the same; a car that brakes gently
_NEIGHBOURS = 10  # points around a voter, itself among them, as many as its plane was fitted to


class RegistrationNoise:
    """The covariance of the errors of poses that scans don't share, measured as the scans come in.

    The deviation from a constant-velocity prediction is the second difference of the poses. Its change
    from one scan to the next, the third, leaves next to nothing of a vehicle's motion, whose jerk is
    small within three scans, but of white noise twenty times the variance. Noise told from
    what predictions miss is the principle of Mehra, *Approaches to adaptive filtering*, IEEE TAC 1972.
    """

    def __init__(self) -> None:
        self.covariance: Array = np.zeros((6, 6))
        self._last: Array | None = None
        self._count = 0

    def update(self, deviation: Array | None) -> None:
        """Take in a scan's (6,) deviation from its prediction; None after a gap, where it says nothing."""
        last, self._last = self._last, deviation
        if last is None or deviation is None:
            return
        change = deviation - last
        self._count += 1
        weight = max(_FORGETTING, 1 / self._count)
        sample = np.outer(change, change) / _THIRD_DIFFERENCE
        self.covariance = (1 - weight) * self.covariance + weight * sample


def extrapolation_covariance(seconds: float) -> Array:
    """Return the (6, 6) covariance of a pose that constant velocity was extrapolated to, for so long."""
    rotation, translation = np.array([_ANGULAR_ACCELERATION, _ACCELERATION]) * seconds**2 / 2
    return np.diag([rotation**2] * 3 + [translation**2] * 3)


def distortion_bias(cloud: Cloud, scan: Scan, velocity: Array, lag: Array) -> Array:
    """Return the (6,) error of a pose whose sweep was deskewed by a velocity that is off, up to its sign.

    A point seen at time t from the sweep's middle is displaced by t times the lag. The pose follows as
    the least squares of the displaced planes have it: with rows J_k of the planes' Jacobian,
    ``H^-1 sum(t_k J_k J_k^T) lag``. It vanishes where every kind of surface is spread evenly over the
    sweep.

    Args:
        cloud: the deskewed scan.
        scan: the same as recorded.
        velocity: (6,) that it was deskewed by, rotation (rad/s) then translation (m/s).
        lag: (6,) by how much that is off.
    """
    if scan.offsets is None or len(cloud) == 0:
        return np.zeros(6)
    voters = slice(None, None, max(1, len(cloud) // _VOTERS))
    J = _jacobian(cloud, voters)
    times = _times(cloud.positions[voters], scan.points, scan.offsets, velocity)
    H = J.T @ J
    floor = (1e-9 * np.trace(H) + 1e-6) * np.eye(6)
    bias: Array = np.linalg.solve(H + floor, J.T @ (times * (J @ lag)))
    return bias


def _jacobian(cloud: Cloud, voters: slice) -> Array:
    """Return (M, 6) derivatives of distances to planes, in units of the planes' thickness.

    A plane counts as GICP has it count: for little where the normals around disagree, as in leaves.
    """
    points, normals = cloud.positions[voters], cloud.normals[voters]
    around, _ = cloud.tree.batch_knn_search(points, min(_NEIGHBOURS, len(cloud)), 1)
    cosines = np.einsum("ij,ikj->ik", normals, cloud.normals[np.asarray(around)])
    variance = PLANE_THICKNESS + np.mean(1 - (1 - PLANE_THICKNESS) * cosines**2, axis=1)
    J: Array = np.hstack([np.cross(points, normals), normals]) / np.sqrt(variance)[:, None]
    return J


def _times(points: Array, recorded: Array, offsets: Array, velocity: Array) -> Array:
    """Return when each of (M, 3) deskewed points was swept, in seconds from the sweep's middle.

    It is when the nearest of some (N, 3) recorded points was, that have (N,) `offsets`.
    """
    some = slice(None, None, max(1, len(offsets) // _CLOCKS))
    times = offsets[some] - (offsets.min() + offsets.max()) / 2
    displacement = np.cross(velocity[:3], recorded[some]) + velocity[3:]
    moved = recorded[some] + times[:, None] * displacement
    _, nearest = cKDTree(moved, balanced_tree=False, compact_nodes=False).query(points)
    return np.asarray(times[nearest])
