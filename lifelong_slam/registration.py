"""Registration of two clouds by generalised ICP, with everything needed to judge its answer.

The work is small_gicp's (Koide, *small_gicp*, JOSS 2024; Segal et al., *Generalized-ICP*, RSS 2009).
This module adds what a pose graph asks of a registration: its overlap and residual, whether the
geometry constrains all six degrees of freedom, and a covariance from its Hessian.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import small_gicp
from numpy.typing import NDArray

from lifelong_slam.geometry import transform

Array = NDArray[np.float64]

# Points that share one error, by way of the neighbours that their planes are fitted to. Measured on
# samples of one scene whose noise is independent (NEES in tests/test_registration.py).
CORRELATED_POINTS = 2.0
PLANE_THICKNESS = 1e-3  # variance across a plane of GICP's model, where that along it is 1
SURFACE_REACH = 1.0  # metres within which a target point vouches for its plane
SURFACE_THICKNESS = (
    0.1  # metres off the plane that still count as on it: sensor noise and roughness
)

_NEIGHBOURS = 10  # points that a local plane is fitted to
_COARSE_FACTOR = 4.0  # the first stage accepts correspondences so many times as far away
_COARSE_ITERATIONS = 15
_FINE_ITERATIONS = 30


@dataclass(frozen=True, slots=True)
class Cloud:
    """A downsampled cloud with local covariances and a K-D tree, ready for registration."""

    points: small_gicp.PointCloud
    tree: small_gicp.KdTree

    @classmethod
    def prepare(cls, points: Array, voxel_size: float) -> "Cloud":
        """Downsample (N, 3) points to one a voxel (m) and fit a plane around each.

        One thread: small_gicp's parallel downsampling isn't repeatable.
        """
        cloud, tree = small_gicp.preprocess_points(points, voxel_size, _NEIGHBOURS, 1)
        return cls(cloud, tree)

    def __len__(self) -> int:
        return int(self.points.size())

    @property
    def positions(self) -> Array:
        """(N, 3) points in metres."""
        return np.asarray(self.points.points())[:, :3]

    @property
    def normals(self) -> Array:
        """(N, 3) unit normals, zero where a point has too few neighbours."""
        return np.asarray(self.points.normals())[:, :3]


@dataclass(frozen=True, slots=True)
class Registration:
    """Where a source cloud lies in a target cloud, and how far to believe it.

    Attributes:
        T_target_source: (4, 4).
        hessian: (6, 6) at the solution, tangent order rotation then translation, in the source's
            frame; its unit is that of GICP's plane model (see `covariance_of`).
        error: GICP's cost at the solution.
        inliers: points that have a correspondence.
        overlap: fraction of source points that lie on a target surface.
        support: the same with each point weighted by how much it says about the motion, so that a few
            poles have the voice of all the ground; what guesses are compared by.
        residual: RMS distance in metres of those points from the planes they lie on.
        converged: whether the last stage converged.
    """

    T_target_source: Array
    hessian: Array
    error: float
    inliers: int
    overlap: float
    support: float
    residual: float
    converged: bool

    @property
    def covariance(self) -> Array:
        """(6, 6) covariance of the solution in the source's frame, rotation then translation."""
        return covariance_of(self.hessian, self.error, self.inliers)

    @property
    def translation_information(self) -> Array:
        """(3, 3) information on translation with rotation marginalised (Schur complement)."""
        H = self.hessian
        coupling = H[3:, :3] @ np.linalg.pinv(H[:3, :3], hermitian=True) @ H[:3, 3:]
        information: Array = H[3:, 3:] - coupling
        return information

    @property
    def degeneracy(self) -> float:
        """Ratio of the weakest to the strongest direction of translation, 0 (free) to 1.

        Zhang et al., *On degeneracy of optimization-based state estimation problems*, ICRA 2016,
        judge by the smallest eigenvalue; the ratio is the same idea without a sensor's scale.
        """
        eigenvalues = np.linalg.eigvalsh(self.translation_information)
        return float(max(eigenvalues[0], 0.0) / max(eigenvalues[-1], 1e-12))


def covariance_of(hessian: Array, error: float, inliers: int) -> Array:
    """Return the (6, 6) covariance of a GICP solution in its Hessian's frame and order.

    The inverse Hessian, scaled by the variance that the residuals really show (GICP's plane model
    only fixes it up to a factor), and by the number of neighbouring points that share one error.
    A point holds the pose in one direction, across its plane, so there are as many residuals as
    points: those along the plane are in the sum, but of next to no weight. Directions that the
    geometry leaves free get a large but finite variance.

    Args:
        hessian: (6, 6).
        error: GICP's cost at the solution, half a sum of squared Mahalanobis distances.
        inliers: points in that sum.
    """
    # With six points or fewer nothing is left to tell the variance by but the model's own 1.
    variance = 2 * error / (inliers - 6) if inliers > 6 else 1.0
    floor = 1e-9 * np.trace(hessian) * np.eye(6)
    covariance = CORRELATED_POINTS * variance * np.linalg.inv(hessian + floor + 1e-6 * np.eye(6))
    symmetric: Array = (covariance + covariance.T) / 2
    return symmetric


def register(
    target: Cloud, source: Cloud, guesses: Sequence[Array], max_distance: float
) -> Registration:
    """Align `source` to `target` from several guesses and return the best fit.

    Each guess is aligned coarse to fine. The fit with the best support wins; ties go to the earlier
    guess.

    Args:
        target: cloud that stays.
        source: cloud that moves.
        guesses: (4, 4) T_target_source candidates, the most trusted one first.
        max_distance: correspondence distance of the fine stage in metres.
    """
    best: Registration | None = None
    for guess in guesses:
        candidate = _align(target, source, guess, max_distance)
        if best is None or candidate.support > best.support:
            best = candidate
    if best is None:
        raise ValueError("register needs at least one guess")
    return best


def refine(target: Cloud, source: Cloud, guess: Array, max_distance: float) -> Registration:
    """Align `source` to `target` from a guess known to be good: the fine stage only."""
    if len(target) == 0 or len(source) == 0:  # small_gicp reads beyond an empty cloud
        return Registration(guess, np.zeros((6, 6)), 0.0, 0, 0.0, 0.0, 0.0, converged=False)
    return _judge(target, source, _gicp(target, source, guess, max_distance, _FINE_ITERATIONS))


def _align(target: Cloud, source: Cloud, guess: Array, max_distance: float) -> Registration:
    if len(target) == 0 or len(source) == 0:
        return refine(target, source, guess, max_distance)
    coarse = _gicp(target, source, guess, _COARSE_FACTOR * max_distance, _COARSE_ITERATIONS)
    return refine(target, source, coarse.T_target_source, max_distance)


def _gicp(
    target: Cloud, source: Cloud, guess: Array, max_distance: float, iterations: int
) -> small_gicp.RegistrationResult:
    return small_gicp.align(
        target.points,
        source.points,
        target.tree,
        guess,
        registration_type="GICP",
        max_correspondence_distance=max_distance,
        max_iterations=iterations,
        num_threads=1,
    )


def _judge(target: Cloud, source: Cloud, result: small_gicp.RegistrationResult) -> Registration:
    """Measure overlap and residual of a solution against the target's local planes."""
    moved = transform(result.T_target_source, source.positions)
    indices, squared = target.tree.batch_knn_search(moved, 1, 1)
    nearest, distance = np.asarray(indices)[:, 0], np.sqrt(np.asarray(squared)[:, 0])
    normals = target.normals[nearest]
    off_plane = np.abs(np.einsum("ij,ij->i", moved - target.positions[nearest], normals))
    planar = np.einsum("ij,ij->i", normals, normals) > 0
    on_surface = planar & (distance < SURFACE_REACH) & (off_plane < SURFACE_THICKNESS)
    weights = _leverage(source.normals)
    return Registration(
        T_target_source=np.asarray(result.T_target_source),
        hessian=np.asarray(result.H),
        error=float(result.error),
        inliers=int(result.num_inliers),
        overlap=float(on_surface.mean()) if len(on_surface) else 0.0,
        support=float(weights[on_surface].sum() / max(weights.sum(), 1e-12)),
        residual=float(np.sqrt(np.mean(off_plane[on_surface] ** 2))) if on_surface.any() else 0.0,
        converged=bool(result.converged),
    )


def _leverage(normals: Array) -> Array:
    """Return how much each of (N, 3) plane normals adds to what is known about translation.

    On a road nine points in ten are ground, and rings on the ground coincide best where the sensor
    stands still; all together they are one direction of three (statistical leverage, as in
    normal-space sampling: Rusinkiewicz and Levoy, 3DIM 2001).
    """
    information = normals.T @ normals + (1e-3 * len(normals) + 1e-9) * np.eye(3)
    weights: Array = np.einsum("ij,jk,ik->i", normals, np.linalg.inv(information), normals)
    return weights
