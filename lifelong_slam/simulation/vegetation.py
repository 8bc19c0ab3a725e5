"""Trees, bushes and hedges."""

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.simulation.mesh import Mesh, merge
from lifelong_slam.simulation.shapes import cylinder, leaves

_BARK, _LEAF = 0.3, 0.45


def tree(rng: np.random.Generator, height: float) -> Mesh:
    """Return a tree with a leaning trunk, some boughs and an irregular crown."""
    lean = rng.normal(0, 0.03, 2) * height
    fork = np.array([*lean, height * rng.uniform(0.3, 0.42)])
    radius = height * rng.uniform(0.014, 0.022)
    parts = [cylinder((0, 0, -0.5), fork, radius * 1.2, _BARK, top_radius=radius)]
    spread = height * rng.uniform(0.16, 0.26)
    for _ in range(int(rng.integers(4, 7))):
        aside, up = rng.normal(0, spread * 0.6, 2), height * rng.uniform(0.1, 0.5)
        tip = fork + np.array([*aside, up])
        parts.append(cylinder(fork, tip, radius * 0.5, _BARK, top_radius=radius * 0.2, sides=5))
        radii = spread * rng.uniform(0.55, 1.0, 3) * [1, 1, 0.9]
        count = int(45 * spread)
        parts.append(leaves(rng, tip, radii, count, 0.14 * spread + 0.12, _LEAF))
    return merge(parts)


def foliage(plant: Mesh) -> NDArray[np.bool_]:
    """Return which of a plant's triangles (M,) are leaves; the others are wood."""
    return np.asarray(plant.reflectivity == _LEAF)


def conifer(rng: np.random.Generator, height: float) -> Mesh:
    """Return a slim tree whose branches start near the ground."""
    parts = [cylinder((0, 0, -0.5), (0, 0, height), height * 0.015, _BARK, top_radius=0.02)]
    for level in np.linspace(0.12, 0.95, 8):
        radius = 0.22 * height * (1.03 - level) * rng.uniform(0.8, 1.2)
        centre = (*rng.normal(0, 0.05, 2), level * height)
        count = int(20 + 30 * radius)
        parts.append(leaves(rng, centre, (radius, radius, 0.07 * height), count, 0.35, _LEAF))
    return merge(parts)


def bush(rng: np.random.Generator, size: float) -> Mesh:
    """Return a bush about `size` metres across."""
    radii = size / 2 * rng.uniform(0.7, 1.2, 3)
    return leaves(rng, (0, 0, radii[2] * 0.8), radii, int(50 * size), 0.15 + 0.08 * size, _LEAF)


def hedge(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """Return a trimmed hedge along x, 0.7 m thick, uneven on all sides."""
    count = int(55 * length * height)
    middle = rng.uniform([-length / 2, -0.35, 0], [length / 2, 0.35, height], (count, 3))
    corners = middle[:, None] + rng.uniform(-0.16, 0.16, (count, 3, 3))
    return Mesh(corners, np.full(count, _LEAF))
