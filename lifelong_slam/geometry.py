"""Rigid-body geometry on stacks of 4x4 matrices, vectorised.

Poses are (..., 4, 4) float64 `T_target_source` matrices. Tangent vectors are (..., 6) in GTSAM's
order, rotation (rad) first and translation (m) second: ``T = Exp([w, v])``. Formulas: Barfoot,
*State Estimation for Robotics* (2017), section 7.1, with the two blocks of the tangent vector swapped.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-4


def invert(T: Array) -> Array:
    """Return the inverse of each (..., 4, 4) pose."""
    inverse = np.zeros_like(T)
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = R_transposed
    inverse[..., :3, 3] = -(R_transposed @ T[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def transform(T: Array, points: Array) -> Array:
    """Map (N, 3) points by one (4, 4) pose."""
    # Column by column: for three columns BLAS costs more than it saves, and its threads wait for each
    # other on a busy machine.
    moved = np.empty(points.shape)
    for row in range(3):
        x, y, z = T[row, :3]
        moved[:, row] = points[:, 0] * x + points[:, 1] * y + points[:, 2] * z + T[row, 3]
    return moved


def skew(w: Array) -> Array:
    """Return the (..., 3, 3) cross-product matrices of (..., 3) vectors."""
    S = np.zeros((*w.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2] = -w[..., 2], w[..., 1]
    S[..., 1, 0], S[..., 1, 2] = w[..., 2], -w[..., 0]
    S[..., 2, 0], S[..., 2, 1] = -w[..., 1], w[..., 0]
    return S


def exp(xi: Array) -> Array:
    """Map (..., 6) tangent vectors [rotation, translation] to (..., 4, 4) poses (Barfoot 7.85)."""
    w, v = xi[..., :3], xi[..., 3:]
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape, 3)
    T[..., :3, 3] = (_left_jacobian(w) @ v[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def log(T: Array) -> Array:
    """Map (..., 4, 4) poses to (..., 6) tangent vectors [rotation, translation]."""
    R = T[..., :3, :3]
    w = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])
    v = np.linalg.solve(_left_jacobian(w), T[..., :3, 3, None])[..., 0]
    return np.concatenate([w, v], axis=-1)


def adjoint(T: Array) -> Array:
    """Return the (..., 6, 6) adjoints: ``T Exp(xi) T^-1 = Exp(Ad(T) xi)`` (Barfoot 7.45)."""
    R = T[..., :3, :3]
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = R
    A[..., 3:, 3:] = R
    A[..., 3:, :3] = skew(T[..., :3, 3]) @ R
    return A


def interpolate(start: Array, end: Array, fraction: Array) -> Array:
    """Move along the geodesic from `start` (fraction 0) to `end` (fraction 1); all broadcast."""
    return start @ exp(np.asarray(fraction)[..., None] * log(invert(start) @ end))


def rotation_angle(T: Array) -> Array:
    """Return the rotation angle in radians of each (..., 4, 4) pose."""
    R = T[..., :3, :3]
    magnitude = Rotation.from_matrix(R.reshape(-1, 3, 3)).magnitude()
    return np.asarray(magnitude.reshape(T.shape[:-2]))


def from_quaternion(position: Array, quaternion_xyzw: Array) -> Array:
    """Build (..., 4, 4) poses of (..., 3) positions and (..., 4) quaternions x y z w."""
    T = np.zeros((*position.shape[:-1], 4, 4))
    R = Rotation.from_quat(quaternion_xyzw.reshape(-1, 4)).as_matrix()
    T[..., :3, :3] = R.reshape(*position.shape, 3)
    T[..., :3, 3] = position
    T[..., 3, 3] = 1.0
    return T


def to_quaternion(T: Array) -> Array:
    """Return the (..., 4) quaternions x y z w of (..., 4, 4) poses, with w >= 0."""
    R = T[..., :3, :3]
    q = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(q.reshape(*T.shape[:-2], 4))


def _left_jacobian(w: Array) -> Array:
    """Return SO(3)'s (..., 3, 3) left Jacobians (Barfoot 7.77b), by series near zero."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    S = skew(w)
    jacobian: Array = np.eye(3) + a * S + b * (S @ S)
    return jacobian
