"""Buildings with recessed windows and doors, sills, balconies, roofs and chimneys."""

import numpy as np

from lifelong_slam.simulation.mesh import Array, Mesh, from_quads, from_triangles, merge
from lifelong_slam.simulation.shapes import box

_GLASS, _TILES, _METAL = 0.06, 0.25, 0.4
# Corners of a cell in order around it, as slices of the breaks in x and in z.
_LOW, _HIGH = np.s_[:-1], np.s_[1:]
_CORNERS = ((_LOW, _LOW), (_HIGH, _LOW), (_HIGH, _HIGH), (_LOW, _HIGH))
_FOUNDATION = 1.5  # metres below ground, so that no gap opens on a slope


def building(rng: np.random.Generator, length: float, depth: float, height: float) -> Mesh:
    """Return a building about the origin, x along its front, which faces -y."""
    wall = float(rng.uniform(0.25, 0.6))
    windows = float(rng.uniform(0.9, 1.5)), float(rng.uniform(1.2, 1.7))
    parts = []
    for turn, (wide, off) in enumerate(
        [(length, depth / 2), (depth, length / 2), (length, depth / 2), (depth, length / 2)]
    ):
        recess = float(rng.uniform(0.12, 0.3))
        facade = _facade(rng, wide, height, windows, recess, wall)
        parts.append(_turned(facade, turn, off))
    parts.append(_roof(rng, length, depth, height))
    if rng.random() < 0.5:
        parts.append(_balconies(rng, length, depth, height))
    parts.append(_entrance(rng, length, depth))
    return merge(parts)


def _facade(
    rng: np.random.Generator,
    wide: float,
    height: float,
    opening: tuple[float, float],
    recess: float,
    wall: float,
) -> Mesh:
    """Return a wall in the x-z plane, facing -y, with a grid of recessed windows."""
    pitch = float(rng.uniform(2.3, 3.6))
    columns = max(int((wide - 1.0) / pitch), 1)
    rows = max(int((height - 0.8) / 3.0), 1)
    x = _breaks(wide, columns, min(opening[0], wide / columns - 0.5)) - wide / 2
    z = _breaks(height, rows, min(opening[1], height / rows - 0.8))
    z = np.concatenate([[-_FOUNDATION], z])
    cells = np.stack(
        [np.stack(np.meshgrid(x[a], z[b], indexing="ij"), axis=-1) for a, b in _CORNERS], axis=2
    )
    fronts = np.insert(cells, 1, 0.0, axis=-1)  # the wall is at y = 0
    # Walls and windows alternate; rows are shifted by one for the foundation.
    column, row = np.indices(fronts.shape[:2])
    window_here = (column % 2 == 1) & (row % 2 == 0) & (row >= 2)
    openings = fronts[window_here]
    panes = openings + np.array([0, recess, 0])
    reveals = np.stack([openings, np.roll(openings, -1, 1), np.roll(panes, -1, 1), panes], axis=2)
    sills = [box(p[0] + [-0.05, -recess - 0.08, -0.06], p[1] + [0.05, 0, 0], wall) for p in panes]
    return merge(
        [
            from_quads(fronts[~window_here], wall),
            from_quads(panes, _GLASS),
            from_quads(reveals, wall),
            *sills,
        ]
    )


def _breaks(total: float, count: int, opening: float) -> Array:
    """Return where walls and openings alternate over `total` metres, both ends included."""
    centre = (np.arange(count) + 0.5) * total / count
    inner = np.stack([centre - opening / 2, centre + opening / 2], axis=1).ravel()
    return np.concatenate([[0.0], inner, [total]])


def _turned(mesh: Mesh, quarters: int, offset: float) -> Mesh:
    """Push a facade out to -y by `offset`, then turn it about the vertical."""
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarters]
    turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    push = np.eye(4)
    push[1, 3] = -offset
    return mesh.moved(turn @ push)


def _roof(rng: np.random.Generator, length: float, depth: float, height: float) -> Mesh:
    """Return a gabled roof with a chimney, or a flat one with a parapet."""
    a, b = length / 2 + 0.3, depth / 2 + 0.4
    if rng.random() < 0.35:
        parapet = [
            box((-a, y - 0.15, height - 0.1), (a, y + 0.15, height + 0.7), 0.35) for y in (-b, b)
        ]
        lid = box((-a, -b, height - 0.1), (a, b, height + 0.1), 0.3)
        return merge([lid, *parapet])
    ridge = height + float(rng.uniform(0.35, 0.6)) * b
    eaves = height - 0.15
    quads = [
        [(-a, -b, eaves), (a, -b, eaves), (a, 0, ridge), (-a, 0, ridge)],
        [(-a, b, eaves), (a, b, eaves), (a, 0, ridge), (-a, 0, ridge)],
    ]
    gables = [[(x, -b, eaves), (x, b, eaves), (x, 0, ridge)] for x in (-a + 0.3, a - 0.3)]
    x = float(rng.uniform(-a + 1, a - 1))
    chimney = box((x - 0.35, 0.4, eaves), (x + 0.35, 1.0, ridge + 0.8), 0.3)
    return merge([from_quads(quads, _TILES), from_triangles(gables, 0.35), chimney])


def _balconies(rng: np.random.Generator, length: float, depth: float, height: float) -> Mesh:
    """Return a column of balconies on the front."""
    x = float(rng.uniform(-length / 4, length / 4))
    wide, out = float(rng.uniform(1.6, 3.0)), float(rng.uniform(0.7, 1.1))
    parts = []
    for z in np.arange(3.0, height - 2.0, 3.0):
        low = np.array([x - wide / 2, -depth / 2 - out, z])
        high = np.array([x + wide / 2, -depth / 2, z + 0.12])
        rail = np.array([high[0], low[1] + 0.05, z + 1.0])
        parts += [box(low, high, 0.4), box(low + np.array([0, 0, 0.9]), rail, _METAL)]
        posts = np.linspace(low[0], high[0] - 0.04, 6)
        parts += [box((p, low[1], z), (p + 0.04, low[1] + 0.04, z + 0.95), _METAL) for p in posts]
    return merge(parts)


def _entrance(rng: np.random.Generator, length: float, depth: float) -> Mesh:
    """Return steps and a canopy at the front."""
    x, y = float(rng.uniform(-length / 3, length / 3)), -depth / 2
    return merge(
        [
            box((x - 0.9, y - 0.9, -0.5), (x + 0.9, y, 0.2), 0.35),
            box((x - 0.7, y - 0.5, -0.5), (x + 0.7, y, 0.36), 0.35),
            box((x - 1.0, y - 1.0, 2.5), (x + 1.0, y, 2.62), _METAL),
            box((x - 0.65, y - 0.05, 0.36), (x - 0.55, y, 2.5), _METAL),
            box((x + 0.55, y - 0.05, 0.36), (x + 0.65, y, 2.5), _METAL),
        ]
    )
