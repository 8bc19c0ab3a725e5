"""Roads: a cross-section swept along a path and draped over the terrain."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.simulation.mesh import Array, Mesh, from_grid, from_quads, merge
from lifelong_slam.simulation.routes import Path
from lifelong_slam.simulation.terrain import Terrain

ASPHALT, CONCRETE, GRASS, PAINT_LINE = 0.17, 0.3, 0.35, 0.8

_SLICE = 1.0  # metres along the road between cross-sections
_JOINT = 0.01  # metres that a levelled kerb lies below the carriageway that crosses it
_OVERLAP = 0.6  # metres along the path that still count as beside it


@dataclass(frozen=True, slots=True)
class Profile:
    """A cross-section from left to right.

    Attributes:
        lateral: (P,) metres left of the path, falling.
        rise: (P,) metres above the terrain.
        reflectivity: (P - 1,) of each strip.
        left: lateral of the carriageway's left edge.
        right: lateral of its right edge.
    """

    lateral: Array
    rise: Array
    reflectivity: Array
    left: float
    right: float


@dataclass(frozen=True, slots=True)
class Road:
    """A path with a cross-section."""

    path: Path
    profile: Profile

    def covers(self, xy: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Return whether (N, 2) points lie on the carriageway, widened by `margin` metres."""
        _, lateral, rest = self.path.project(xy)
        beside = np.abs(rest) < _OVERLAP
        within = (lateral < self.profile.left + margin) & (lateral > self.profile.right - margin)
        return np.asarray(beside & within)

    def within(self, xy: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Return whether (N, 2) points lie anywhere on the cross-section, widened by `margin`."""
        _, lateral, rest = self.path.project(xy)
        low, high = self.profile.lateral[-1] - margin, self.profile.lateral[0] + margin
        beside = np.abs(rest) < _OVERLAP + max(margin, 0.0)
        return np.asarray(beside & (lateral < high) & (lateral > low))

    def rise(self, xy: Array) -> Array:
        """Return how high (N,) the cross-section is above the terrain at (N, 2) points."""
        _, lateral, _ = self.path.project(xy)
        return np.interp(-lateral, -self.profile.lateral, self.profile.rise)


def _profile(
    rows: list[tuple[float, float]], strips: list[float], left: float, right: float
) -> Profile:
    lateral, rise = np.array(rows).T
    return Profile(lateral, rise, np.array(strips), left, right)


def urban_profile(
    left: float = 7.2, right: float = -3.9, pavement: float = 2.6, kerb: float = 0.12
) -> Profile:
    """Two lanes with parking lanes, kerbs, pavements and a strip of verge behind them."""
    verge = 1.5
    half = [(pavement + verge, kerb - 0.05), (pavement, kerb), (0.0, kerb), (0.0, 0.0)]
    middle = (left + right) / 2
    rows = [(left + d, z) for d, z in half]
    rows += [(middle + 2.0, 0.03), (middle, 0.04), (middle - 2.0, 0.03)]
    rows += [(right - d, z) for d, z in reversed(half)]
    side = [GRASS, CONCRETE, CONCRETE]
    strips = [*side, *([ASPHALT] * 4), *reversed(side)]
    return _profile(rows, strips, left, right)


def rural_profile(
    left: float, right: float, *, shoulder: float = 1.5, ditch: float = 0.5, bank: float = 1.0
) -> Profile:
    """A carriageway with shoulders, a shallow ditch on either side and a bank behind it."""
    half = [
        (shoulder + 7.0, bank), (shoulder + 3.5, bank * 0.4), (shoulder + 2.0, -ditch),
        (shoulder + 0.2, -0.08), (shoulder, -0.02), (0.0, 0.0),
    ]  # fmt: skip
    rows = [(left + d, z) for d, z in half]
    rows += [(left + f * (right - left), 0.02) for f in (0.25, 0.5, 0.75)]
    rows += [(right - d, z) for d, z in reversed(half)]
    side = [GRASS, GRASS, GRASS, GRASS, ASPHALT]
    strips = [*side, *([ASPHALT] * 4), *reversed(side)]
    return _profile(rows, strips, left, right)


def road_mesh(road: Road, others: Sequence[Road], terrain: Terrain) -> Mesh:
    """Return the road's surface; kerbs and verges are levelled where another carriageway joins."""
    path, profile = road.path, road.profile
    count = max(int(np.ceil((path.end - path.start) / _SLICE)), 1)
    s = np.linspace(path.start, path.end, count + 1)
    across = np.broadcast_to(profile.lateral, (len(s), len(profile.lateral)))
    xy = path.point(np.repeat(s, across.shape[1]), across.ravel())
    z = (terrain.height(xy).reshape(across.shape) + profile.rise)[..., None]
    grid = np.concatenate([xy.reshape(*across.shape, 2), z], axis=2)
    keep = _open_cells(grid, road, others)
    strips = [
        from_grid(grid[:, i : i + 2], reflectivity, keep[:, i : i + 1])
        for i, reflectivity in enumerate(profile.reflectivity.tolist())
    ]
    level = grid - np.array([0, 0, 1]) * (profile.rise + _JOINT)[:, None]
    return merge([*strips, from_grid(level, ASPHALT, ~keep), _risers(grid, level, keep)])


def _risers(grid: Array, level: Array, keep: NDArray[np.bool_]) -> Mesh:
    """Return the upright faces where a levelled cell (keep is false) borders one that is not."""
    u, v = np.nonzero(keep[:, 1:] != keep[:, :-1])
    v = v + 1
    along = np.stack([grid[u, v], grid[u + 1, v], level[u + 1, v], level[u, v]], axis=1)
    u, v = np.nonzero(keep[1:] != keep[:-1])
    u = u + 1
    across = np.stack([grid[u, v], grid[u, v + 1], level[u, v + 1], level[u, v]], axis=1)
    return from_quads(np.concatenate([along, across]), CONCRETE)


def _open_cells(grid: Array, road: Road, others: Sequence[Road]) -> NDArray[np.bool_]:
    """Return which (U, V) cells to keep: the carriageway, and the rest where no other road is."""
    centres = (grid[:-1, :-1, :2] + grid[1:, :-1, :2] + grid[1:, 1:, :2] + grid[:-1, 1:, :2]) / 4
    middle = (road.profile.lateral[:-1] + road.profile.lateral[1:]) / 2
    carriageway = (middle < road.profile.left) & (middle > road.profile.right)
    blocked = np.zeros(centres.shape[:2], dtype=np.bool_)
    for other in others:
        if other is not road:
            blocked |= other.covers(centres.reshape(-1, 2), 0.3).reshape(blocked.shape)
    return np.asarray(carriageway | ~blocked)
