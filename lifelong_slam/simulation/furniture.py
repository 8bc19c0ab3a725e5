"""What stands beside roads: lamps, signs, bollards, fences, walls, shelters, rails, gantries."""

import numpy as np

from lifelong_slam.simulation.mesh import Array, Mesh, from_quads, merge
from lifelong_slam.simulation.shapes import box, cylinder

_STEEL, _SIGN, _STONE, _WOOD = 0.4, 1.6, 0.35, 0.35


def lamp_post(height: float = 7.0, arm: float = 1.6) -> Mesh:
    """Return a lamp post whose arm points along +y."""
    return merge(
        [
            cylinder((0, 0, -0.3), (0, 0, 1.2), 0.11, _STEEL),
            cylinder((0, 0, 1.2), (0, 0, height), 0.08, _STEEL, top_radius=0.05),
            cylinder((0, 0, height), (0, arm, height + 0.25), 0.04, _STEEL, sides=6),
            box((-0.15, arm - 0.1, height + 0.15), (0.15, arm + 0.6, height + 0.3), _STEEL),
        ]
    )


def sign(rng: np.random.Generator, height: float = 2.3) -> Mesh:
    """Return a traffic sign that faces -x."""
    size = float(rng.uniform(0.5, 0.8))
    plate = box((-0.05, -size / 2, height), (-0.03, size / 2, height + size), _SIGN)
    return merge([cylinder((0, 0, -0.3), (0, 0, height + size), 0.035, _STEEL, sides=6), plate])


def bollards(count: int, gap: float = 1.5) -> Mesh:
    """Return a row of bollards along x."""
    x = (np.arange(count) - (count - 1) / 2) * gap
    return merge(cylinder((p, 0, -0.2), (p, 0, 0.95), 0.06, _STEEL, sides=6) for p in x)


def cabinet(rng: np.random.Generator) -> Mesh:
    """Return a distribution box with a bin beside it."""
    x, z = float(rng.uniform(0.5, 1.1)), float(rng.uniform(0.9, 1.5))
    parts = [box((-x / 2, -0.18, -0.2), (x / 2, 0.18, z), 0.4)]
    parts.append(cylinder((x / 2 + 0.8, 0, -0.2), (x / 2 + 0.8, 0, 0.9), 0.22, 0.3))
    return merge(parts)


def parcel(rng: np.random.Generator) -> Mesh:
    """Return what is left on a pavement for a while: boxes, a loaded pallet or wheeled bins."""
    choice = rng.random()
    if choice < 0.4:
        return _boxes(rng)
    return _pallet(rng) if choice < 0.7 else _bins(int(rng.integers(1, 4)))


def _boxes(rng: np.random.Generator) -> Mesh:
    """Return a crate with smaller boxes on it."""
    parts, z = [], 0.0
    x, y = rng.uniform(0.3, 0.5, 2)
    for _ in range(int(rng.integers(1, 4))):
        height = rng.uniform(0.4, 0.7)
        parts.append(box((-x, -y, z), (x, y, z + height), 0.5))
        z, x, y = z + height, x * rng.uniform(0.7, 0.95), y * rng.uniform(0.7, 0.95)
    return merge(parts)


def _pallet(rng: np.random.Generator) -> Mesh:
    """Return a pallet of 1.2 m by 0.8 m with goods on it."""
    planks = [box((-0.6, y - 0.05, 0), (0.6, y + 0.05, 0.14), _WOOD) for y in (-0.35, 0, 0.35)]
    load = box((-0.57, -0.37, 0.14), (0.57, 0.37, rng.uniform(0.6, 1.5)), 0.55)
    return merge([*planks, load])


def _bins(count: int) -> Mesh:
    """Return a row of wheeled bins along x."""
    parts = []
    for x in (np.arange(count) - (count - 1) / 2) * 0.75:
        parts.append(box((x - 0.28, -0.33, 0.05), (x + 0.28, 0.33, 0.98), 0.3))
        parts.append(box((x - 0.3, -0.37, 0.98), (x + 0.3, 0.37, 1.07), 0.3))
    return merge(parts)


def shelter() -> Mesh:
    """Return a bus shelter with a bench and a stop's pole, open towards +y."""
    return merge(
        [
            box((-2.0, -0.75, 2.3), (2.0, 0.75, 2.42), _STEEL),
            box((-2.0, -0.74, 0.25), (2.0, -0.7, 2.2), 0.12),
            *(box((x - 0.03, -0.7, 0.25), (x + 0.03, 0.4, 2.2), 0.12) for x in (-1.9, 1.9)),
            *(
                cylinder((x, y, -0.2), (x, y, 2.35), 0.04, _STEEL, sides=6)
                for x in (-1.95, 1.95)
                for y in (-0.7, 0.7)
            ),
            box((-1.4, -0.6, 0.42), (1.4, -0.2, 0.48), _WOOD),
            cylinder((3.2, 0.5, -0.2), (3.2, 0.5, 2.9), 0.04, _STEEL, sides=6),
            box((2.95, 0.48, 2.4), (3.45, 0.52, 2.9), _SIGN),
        ]
    )


def ribbon(xy: Array, ground: Array, low: float, high: float, reflectivity: float) -> Mesh:
    """Return a thin upright band through (N, 2) points, `low` to `high` m above `ground` (N,)."""
    a = np.column_stack([xy, ground + low])
    b = np.column_stack([xy, ground + high])
    return from_quads(np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1), reflectivity)


def posts(
    xy: Array, ground: Array, height: float, radius: float, reflectivity: float = _STEEL
) -> Mesh:
    """Return an upright post at each of (N, 2) points."""
    template = cylinder((0, 0, -0.3), (0, 0, height), radius, 1.0, sides=6).triangles
    shift = np.column_stack([xy, ground])[:, None, None, :]
    triangles = (template[None] + shift).reshape(-1, 3, 3)
    return Mesh(triangles, np.full(len(triangles), reflectivity))


def fence(xy: Array, ground: Array, height: float = 1.1) -> Mesh:
    """Return a fence of posts, rails and slats through (N, 2) points 0.5 m apart or so."""
    rails = [ribbon(xy, ground, z, z + 0.09, _WOOD) for z in (0.25, height - 0.2)]
    slats = posts(xy, ground, height, 0.04, _WOOD)
    return merge([*rails, slats])


def wall(xy: Array, ground: Array, height: float) -> Mesh:
    """Return a garden wall with pillars through (N, 2) points."""
    step = np.diff(xy, axis=0, append=xy[-1:] + (xy[-1:] - xy[-2:-1]))
    normal = step[:, ::-1] * [-1, 1] / np.linalg.norm(step, axis=1, keepdims=True) * 0.12
    faces = [ribbon(xy + sign * normal, ground, -0.5, height, _STONE) for sign in (-1, 1)]
    top = np.stack(
        [np.column_stack([xy + side * normal, ground + height]) for side in (-1, 1)], axis=1
    )
    lid = from_quads(np.stack([top[:-1, 0], top[1:, 0], top[1:, 1], top[:-1, 1]], 1), _STONE)
    pillars = posts(xy[::6], ground[::6], height + 0.25, 0.22, _STONE)
    return merge([*faces, lid, pillars])


def guard_rail(xy: Array, ground: Array) -> Mesh:
    """Return a W-beam on posts through (N, 2) points; posts stand at every second of them."""
    beams = [ribbon(xy, ground, z, z + 0.13, _STEEL) for z in (0.44, 0.62)]
    return merge([*beams, posts(xy[::2], ground[::2], 0.75, 0.06)])


def noise_barrier(xy: Array, ground: Array, height: float) -> Mesh:
    """Return panels between posts that stand proud of them, every 4th point."""
    panel = ribbon(xy, ground, -0.5, height, 0.3)
    base = ribbon(xy, ground + 0.0, -0.5, 0.6, _STONE)
    return merge([panel, base, posts(xy[::4], ground[::4], height + 0.15, 0.16, _STEEL)])


def gantry(left: float, right: float, clearance: float = 5.6) -> Mesh:
    """Return a sign gantry across the road (along y) whose plates face -x."""
    top = clearance + 1.0
    plates = np.arange(right + 2.0, left - 4.0, 5.5).tolist()
    steps = np.arange(right, left - 1.5, 1.5).tolist()
    low, high = clearance + 0.1, clearance + 0.9
    lattice = [
        cylinder((0, a, high if i % 2 else low), (0, a + 1.5, low if i % 2 else high), 0.05, _STEEL)
        for i, a in enumerate(steps)
    ]
    return merge(
        [
            *(cylinder((0, y, -0.5), (0, y, top), 0.22, _STEEL) for y in (left, right)),
            *(
                cylinder((x, right, z), (x, left, z), 0.08, _STEEL, sides=6)
                for x in (-0.3, 0.3)
                for z in (clearance, top)
            ),
            *lattice,
            *(box((-0.45, y, clearance - 0.4), (-0.38, y + 3.6, top + 1.2), _SIGN) for y in plates),
        ]
    )


def bridge(left: float, right: float, clearance: float = 5.2, width: float = 9.0) -> Mesh:
    """Return a bridge over the road (along y) with pillars, abutments and railings."""
    deck = clearance + 1.1
    ends = (left + 4.0, right - 4.0)
    rail_y = np.arange(ends[1], ends[0], 2.0).tolist()
    return merge(
        [
            box((-width / 2, ends[1] - 12, clearance), (width / 2, ends[0] + 12, deck), _STONE),
            *(
                box((x, ends[1] - 12, clearance - 0.9), (x + 0.6, ends[0] + 12, clearance), _STONE)
                for x in (-3.2, 0.0, 2.6)
            ),
            *(
                cylinder((x, y, -1), (x, y, clearance), 0.5, _STONE, sides=12)
                for x in (-3.0, 0.0, 3.0)
                for y in (left + 0.8, right - 0.8)
            ),
            *(box((-width / 2, y - 6, -3), (width / 2, y + 6, clearance), _STONE)
              for y in (ends[0] + 6, ends[1] - 6)),
            *(box((x, ends[1] - 12, deck + 0.9), (x + 0.08, ends[0] + 12, deck + 1.0), _STEEL)
              for x in (-width / 2, width / 2 - 0.08)),
            *(cylinder((x, y, deck), (x, y, deck + 1.0), 0.04, _STEEL, sides=5)
              for x in (-width / 2 + 0.04, width / 2 - 0.04) for y in rail_y),
        ]
    )  # fmt: skip
