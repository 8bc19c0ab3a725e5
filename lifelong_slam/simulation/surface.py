"""Points on the true static surface, wherever the rig can see it."""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.simulation.mesh import Mesh
from lifelong_slam.simulation.raycast import Caster, Floats

_VOXEL = 0.5  # metres; surfaces within one voxel of a visible point count as visible
_SPACING = 0.08  # metres between points, as a mean over the surface
_NEAR = 50.0  # metres from a sensor within which the surface is sampled in full
_FAR_SHARE = 0.1  # of the points beyond that
_MOST = 4_000_000  # points; more than that are thinned at random
_CHUNK = 500_000  # points sampled at a time
_COARSE = 8  # voxels across the blocks that rule triangles out early
_BITS = 21  # of each voxel index in a key


def visible_surface(
    mesh: Mesh, rays: Iterable[Floats], rng: np.random.Generator, *, reach: float
) -> NDArray[np.float32]:
    """Sample the parts of `mesh` that rays (N, 6) meet within `reach` metres.

    What is only seen from afar is sampled more thinly: sensors see little of it, too.

    Returns:
        (M, 6) points, metres, and the unit normals there.
    """
    near, seen = _seen_voxels(Caster(mesh), rays, reach)
    if not len(seen):
        return np.zeros((0, 6), dtype=np.float32)
    parts = []
    for part in _samples(mesh, seen, rng):
        keys = _keys(part[:, :3] / _VOXEL)
        chosen = _among(keys, near) | (rng.random(len(keys)) < _FAR_SHARE) & _among(keys, seen)
        parts.append(part[chosen])
    points = np.concatenate(parts)
    if len(points) > _MOST:
        points = points[np.sort(rng.choice(len(points), _MOST, replace=False))]
    return points


def _seen_voxels(
    caster: Caster, rays: Iterable[Floats], reach: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the sorted keys of the voxels seen from near, and of all that are seen.

    The neighbours of voxels with visible points count as seen.
    """
    near: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    seen = near
    for batch in rays:
        distance, *_ = caster.cast(batch)
        hit, distance = batch[distance < reach], distance[distance < reach]
        keys = _keys((hit[:, :3] + hit[:, 3:] * distance[:, None]) / _VOXEL)
        near, seen = np.union1d(near, keys[distance < _NEAR]), np.union1d(seen, keys)
    return _with_neighbours(near), _with_neighbours(seen)


def _with_neighbours(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    shifts = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    steps = shifts @ (1 << (_BITS * np.arange(3, dtype=np.int64)))
    return np.asarray(np.unique(keys[:, None] + steps), dtype=np.int64)


def _samples(
    mesh: Mesh, seen: NDArray[np.int64], rng: np.random.Generator
) -> Iterator[NDArray[np.float32]]:
    """Yield chunks of (N, 6) points and normals spread over the triangles that may be visible."""
    near = _may_be_seen(mesh, seen)
    triangles, normals = mesh.triangles[near], mesh.normals[near]
    expected = mesh.areas[near] / _SPACING**2
    counts = np.floor(expected + rng.random(len(expected))).astype(np.int64)
    ends = np.cumsum(counts)
    first = 0
    while first < len(counts):
        before = ends[first - 1] if first else 0
        last = max(int(np.searchsorted(ends, before + _CHUNK, side="right")), first + 1)
        corners = np.repeat(triangles[first:last], counts[first:last], axis=0)
        root, v = np.sqrt(rng.random((len(corners), 1))), rng.random((len(corners), 1))
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        points = (1 - root) * a + root * (1 - v) * b + root * v * c
        there = np.repeat(normals[first:last], counts[first:last], axis=0)
        yield np.concatenate([points, there], axis=1).astype(np.float32)
        first = last


def _may_be_seen(mesh: Mesh, seen: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether each triangle, tested at its corners and centre, nears a seen block.

    Large triangles are kept without a test: their inside may be seen where their corners are not.
    """
    centres = mesh.triangles.mean(axis=1, keepdims=True)
    probes = np.concatenate([mesh.triangles, centres], axis=1)
    size = np.linalg.norm(mesh.triangles - centres, axis=2).max(axis=1)
    blocks = np.unique(_keys(_points(seen) / _COARSE))
    found = _among(_keys(probes.reshape(-1, 3) / (_VOXEL * _COARSE)), blocks).reshape(-1, 4)
    return np.asarray(found.any(axis=1) | (size > _VOXEL * _COARSE))


def _keys(coordinates: NDArray[np.floating]) -> NDArray[np.int64]:
    """Pack the floors of (N, 3) coordinates into one integer each."""
    index = np.floor(coordinates).astype(np.int64) + (1 << (_BITS - 1))
    packed: NDArray[np.int64] = index @ (1 << (_BITS * np.arange(3, dtype=np.int64)))
    return packed


def _points(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Unpack keys into (N, 3) integer coordinates."""
    parts = (keys[:, None] >> (_BITS * np.arange(3))) & ((1 << _BITS) - 1)
    return np.asarray(parts - (1 << (_BITS - 1)))


def _among(keys: NDArray[np.int64], ordered: NDArray[np.int64]) -> NDArray[np.bool_]:
    if not len(ordered):
        return np.zeros(len(keys), dtype=np.bool_)
    place = np.minimum(np.searchsorted(ordered, keys), len(ordered) - 1)
    return np.asarray(ordered[place] == keys)
