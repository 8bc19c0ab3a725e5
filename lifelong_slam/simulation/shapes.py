"""Simple solids: boxes, cylinders, extrusions, clouds of leaves."""

import numpy as np
from numpy.typing import ArrayLike

from lifelong_slam.simulation.mesh import Array, Mesh, from_quads, from_triangles, merge

# Corners of a unit box by face, seen from outside.
_BOX_FACES = np.array(
    [
        [[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]],
        [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
        [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]],
        [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]],
        [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]],
    ],
    dtype=np.float64,
)


def box(low: ArrayLike, high: ArrayLike, reflectivity: float) -> Mesh:
    """Return the box between two opposite corners (3,)."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return from_quads(a + _BOX_FACES * (b - a), reflectivity)


def cylinder(
    bottom: ArrayLike,
    top: ArrayLike,
    radius: float,
    reflectivity: float,
    *,
    top_radius: float | None = None,
    sides: int = 8,
) -> Mesh:
    """Return an open cylinder, or a cone's stump, between two points (3,) that don't coincide."""
    a, b = np.asarray(bottom, dtype=np.float64), np.asarray(top, dtype=np.float64)
    axis = (b - a) / np.linalg.norm(b - a)
    helper = np.array([1.0, 0, 0]) if abs(axis[2]) > 0.9 else np.array([0, 0, 1.0])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    ring = np.cos(angle) * u + np.sin(angle) * v
    low, high = a + radius * ring, b + (radius if top_radius is None else top_radius) * ring
    return from_quads(np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1), reflectivity)


def disc(centre: ArrayLike, radius: float, reflectivity: float, *, sides: int = 12) -> Mesh:
    """Return a disc that stands in the x-z plane, such as the side of a wheel."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    rim = np.asarray(centre) + radius * np.stack(
        [np.cos(angle), np.zeros(sides + 1), np.sin(angle)], axis=1
    )
    middle = np.broadcast_to(np.asarray(centre, dtype=np.float64), (sides, 3))
    return from_triangles(np.stack([middle, rim[:-1], rim[1:]], axis=1), reflectivity)


def extrusion(
    profile: ArrayLike, half_width: float, reflectivity: float, *, taper: ArrayLike = 1.0
) -> Mesh:
    """Return a side view (K, 2) of x and z, star-shaped about its mean, widened to +-half_width.

    `taper` (K,) narrows the body at each corner, as a car's cabin is narrower than its sills.
    """
    corners = np.asarray(profile, dtype=np.float64)
    width = half_width * np.broadcast_to(np.asarray(taper, dtype=np.float64), len(corners))
    right = np.stack([corners[:, 0], -width, corners[:, 1]], axis=1)
    left = right * [1, -1, 1]
    skin = np.stack([right, left, np.roll(left, -1, 0), np.roll(right, -1, 0)], axis=1)
    flanks = []
    for side in (right, left):
        middle = np.broadcast_to(side.mean(axis=0), side.shape)
        flanks.append(np.stack([middle, side, np.roll(side, -1, 0)], axis=1))
    return merge(
        [from_quads(skin, reflectivity), from_triangles(np.concatenate(flanks), reflectivity)]
    )


def leaves(
    rng: np.random.Generator,
    centre: ArrayLike,
    radii: ArrayLike,
    count: int,
    size: float,
    reflectivity: float,
) -> Mesh:
    """Return `count` randomly turned triangles in an ellipsoid.

    Foliage is neither a closed surface nor empty: some beams pass the outer leaves and return from
    inner ones, which a closed crown would not give.
    """
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = rng.uniform(0.25, 1.0, (count, 1)) ** (1 / 2)
    middle = np.asarray(centre) + direction * reach * np.asarray(radii)
    corners = middle[:, None] + size * rng.uniform(-0.6, 0.6, (count, 3, 3))
    return from_triangles(corners, reflectivity)


def box_frame(length: float, width: float) -> Array:
    """Return the (4, 2) corners of a centred rectangle in order."""
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, width / 2]
