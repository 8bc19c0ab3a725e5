"""How g2o files write poses, motions and information matrices, in space and in the plane."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import from_quaternion, to_quaternion

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SINGULAR = 1e-12  # least eigenvalue of an information matrix, relative to its greatest
_HARDLY_KNOWN = 1e-6  # likewise, in one that wasn't positive definite
_OUT_OF_PLANE = [0, 1, 5]  # roll, pitch and z in GTSAM's order


@dataclass(frozen=True, slots=True)
class Format:
    """How poses and edges of one dimension are written.

    Attributes:
        vertex: tag of a vertex.
        edge: tag of an edge.
        prior: tag of a prior.
        numbers: that make a pose.
        order: of the rows of an information matrix, as indices into GTSAM's tangent vector.
    """

    vertex: str
    edge: str
    prior: str
    numbers: int
    order: tuple[int, ...]

    @property
    def planar(self) -> bool:
        """Whether these are SE(2)."""
        return len(self.order) == 3

    @property
    def axes(self) -> int:
        """Coordinates of a position, which come first in a pose and in an information matrix."""
        return 2 if self.planar else 3

    def pack(self, poses: Array) -> Array:
        """Return (N, numbers) rows of (N, 4, 4) poses."""
        if self.planar:
            heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
            return np.column_stack([poses[:, :2, 3], heading])
        return np.hstack([poses[:, :3, 3], to_quaternion(poses)])

    def unpack(self, values: Array) -> Array:
        """Return the (N, 4, 4) poses of (N, numbers) rows."""
        return (
            planar_poses(values) if self.planar else from_quaternion(values[:, :3], values[:, 3:])
        )

    def information(self, covariances: Array) -> Array:
        """Return the (N, n, n) information matrices in the file's order of (N, 6, 6) covariances."""
        rows, columns = np.ix_(self.order, self.order)
        information = np.linalg.inv(covariances[:, rows, columns])
        mean: Array = (information + np.swapaxes(information, 1, 2)) / 2
        return mean

    def covariance(self, information: Array) -> Array:
        """Return the (N, 6, 6) covariances of (N, n, n) information matrices in the file's order."""
        known = np.linalg.inv(information)
        covariances: Array = np.zeros((len(known), 6, 6))
        rows, columns = np.ix_(self.order, self.order)
        covariances[:, rows, columns] = known
        if self.planar:
            x, y, theta = np.diagonal(known, axis1=1, axis2=2).T
            covariances[:, _OUT_OF_PLANE, _OUT_OF_PLANE] = np.stack([theta, theta, (x + y) / 2], 1)
        return covariances


SE3 = Format("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "EDGE_SE3_PRIOR", 7, (3, 4, 5, 0, 1, 2))
SE2 = Format("VERTEX_SE2", "EDGE_SE2", "EDGE_PRIOR_SE2", 3, (3, 4, 2))


def symmetric(upper: Array, size: int) -> Array:
    """Return the (N, size, size) matrices of (N, size (size + 1) / 2) upper triangles."""
    matrices: Array = np.zeros((len(upper), size, size))
    matrices[:, *np.triu_indices(size)] = upper
    matrices += np.swapaxes(np.triu(matrices, 1), 1, 2)
    return matrices


def without_information(information: Array) -> Mask:
    """Tell which of (N, n, n) information matrices say nothing: the trace isn't positive."""
    nothing: Mask = np.trace(information, axis1=1, axis2=2) <= 0
    return nothing


def made_definite(information: Array, axes: int) -> tuple[Array, Mask]:
    """Return (N, n, n) positive definite information matrices, and (N,) which of them weren't.

    Such a one is replaced by the nearest that is positive semidefinite: eigenvalues below zero become zero
    (Higham, *Computing a nearest symmetric positive semidefinite matrix*, 1988). Those near zero are then
    raised to a millionth, so that there is a covariance: what the matrix doesn't know hardly counts. All
    that is in units of the most that the matrix knows about the position, and about the attitude.

    Args:
        information: symmetric, of positive trace.
        axes: rows that are about the position, the first.
    """
    eigenvalues = np.linalg.eigvalsh(information)
    bad: Mask = eigenvalues[:, 0] <= _SINGULAR * eigenvalues[:, -1]
    units = _units(information[bad], axes)
    products = units[:, :, None] * units[:, None]
    eigenvalues, V = np.linalg.eigh(information[bad] / products)
    raised = np.maximum(eigenvalues, _HARDLY_KNOWN * eigenvalues[:, -1:])
    definite = information.copy()
    definite[bad] = (V * raised[:, None]) @ np.swapaxes(V, 1, 2) * products
    return definite, bad


def _units(information: Array, axes: int) -> Array:
    """Return for each row of (N, n, n) matrices the root of the most that is known of its kind.

    Where nothing is known of one kind the other's unit takes its place: a radian for a metre.
    """
    known: Array = np.zeros(information.shape[:2])
    for kind in (slice(None, axes), slice(axes, None)):
        block = information[:, kind, kind]
        if block.size:
            known[:, kind] = np.linalg.eigvalsh(block)[:, -1:]
    most = known.max(axis=1, keepdims=True)
    units: Array = np.sqrt(np.where(known > _SINGULAR * most, known, most))
    return units


def planar_poses(values: Array) -> Array:
    """Return the (N, 4, 4) poses of (N, 3) rows x y theta."""
    zero, half = np.zeros(len(values)), values[:, 2] / 2
    quaternions = np.column_stack([zero, zero, np.sin(half), np.cos(half)])
    return from_quaternion(np.column_stack([values[:, :2], zero]), quaternions)
