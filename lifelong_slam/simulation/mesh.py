"""Triangles with a reflectivity: what every thing in a simulated world is made of.

A mesh is a soup of triangles without shared vertices. That costs memory, yet it makes every part a
plain array that can be moved, merged and sampled without bookkeeping.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mesh:
    """A soup of triangles.

    Attributes:
        triangles: (M, 3, 3) corners in metres.
        reflectivity: (M,) diffuse reflectivity at the laser's wavelength, 0 to 1 (retroreflectors
            may exceed 1).
    """

    triangles: Array
    reflectivity: Array

    def __len__(self) -> int:
        return len(self.triangles)

    def moved(self, T: Array) -> "Mesh":
        """Return the mesh mapped by a (4, 4) affine matrix."""
        return Mesh(self.triangles @ T[:3, :3].T + T[:3, 3], self.reflectivity)

    def subset(self, chosen: NDArray[np.bool_]) -> "Mesh":
        """Return the triangles that `chosen` (M,) selects."""
        return Mesh(self.triangles[chosen], self.reflectivity[chosen])

    @property
    def areas(self) -> Array:
        """(M,) areas in square metres."""
        areas: Array = np.linalg.norm(self._doubled(), axis=1) / 2
        return areas

    @property
    def normals(self) -> Array:
        """(M, 3) unit normals; triangles without area have a normal of zero."""
        doubled = self._doubled()
        length = np.linalg.norm(doubled, axis=1, keepdims=True)
        return np.asarray(doubled / np.where(length > 0, length, 1.0))

    def _doubled(self) -> Array:
        a, b, c = self.triangles.swapaxes(0, 1)
        return np.asarray(np.cross(b - a, c - a))


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """Return one mesh of all triangles, in order."""
    parts = list(meshes)
    if not parts:
        return Mesh(np.zeros((0, 3, 3)), np.zeros(0))
    return Mesh(
        np.concatenate([part.triangles for part in parts]),
        np.concatenate([part.reflectivity for part in parts]),
    )


def from_triangles(triangles: ArrayLike, reflectivity: float) -> Mesh:
    """Make a mesh of (M, 3, 3) corners with one reflectivity."""
    corners = np.asarray(triangles, dtype=np.float64).reshape(-1, 3, 3)
    return Mesh(corners, np.full(len(corners), reflectivity))


def from_quads(quads: ArrayLike, reflectivity: float) -> Mesh:
    """Make a mesh of (Q, 4, 3) quadrilaterals, corners in order around each."""
    corners = np.asarray(quads, dtype=np.float64).reshape(-1, 4, 3)
    return from_triangles(corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3), reflectivity)


def from_grid(points: Array, reflectivity: float, keep: NDArray[np.bool_] | None = None) -> Mesh:
    """Make a mesh of a (U, V, 3) grid of points; `keep` (U-1, V-1) chooses among its cells."""
    cells = np.stack([points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]], axis=2)
    chosen = cells.reshape(-1, 4, 3) if keep is None else cells[keep]
    return from_quads(chosen, reflectivity)


def planar(x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Array:
    """Return the (4, 4) pose at x, y, z turned by `yaw` radians about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])
