"""A site being built: roads, terrain, what has been put on it, and where there is still room."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.simulation.mesh import Array, Mesh, from_grid, merge, planar
from lifelong_slam.simulation.roads import GRASS, Road, road_mesh
from lifelong_slam.simulation.terrain import Terrain

_CELL = 0.5  # metres, of the raster that keeps things from standing in each other
_GROUND_STEP = 2.0  # metres between the points of the open ground
_SINK = 0.04  # metres that open ground lies below a verge, so that it never covers one
_OVERLAP = 0.4  # metres that open ground reaches under a road's edge at least
_ROUGHNESS = 0.03  # metres, standard deviation of open ground's height


@dataclass(frozen=True, slots=True)
class Part:
    """Something that stands on a site.

    Attributes:
        mesh: in the world's frame.
        T_world_part: (4, 4) where it was put.
        kind: `car` and `tree` for what looks different on another visit, None for all else.
    """

    mesh: Mesh
    T_world_part: Array
    kind: Literal["car", "tree"] | None = None


class Site:
    """Collects the static parts of a world without letting them overlap.

    Args:
        roads: the first one is the route's.
        terrain: the height of the land.
        margin: metres of open ground beyond the roads.
        rng: for all that is placed.
        edge_rise: how high open ground lies at the roads' edges, metres above the terrain.
    """

    def __init__(
        self,
        roads: Sequence[Road],
        terrain: Terrain,
        *,
        margin: float,
        rng: np.random.Generator,
        edge_rise: float,
    ) -> None:
        self.roads, self.terrain, self.rng = roads, terrain, rng
        self.parts: list[Part] = []
        corners = np.concatenate([_corridor(road, 4.0) for road in roads])
        self._low, self._high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
        shape = np.ceil((self._high - self._low) / _CELL).astype(int) + 1
        self._taken = np.zeros(shape, dtype=np.bool_)
        self._edge_rise = edge_rise
        for road in roads:
            self.claim(_corridor(road, _CELL * 0.7))

    def add(
        self, mesh: Mesh, T: Array | None = None, kind: Literal["car", "tree"] | None = None
    ) -> None:
        """Add a mesh, moved by the pose T (4, 4) if given; see `Part` for its kind."""
        moved = Part(mesh, np.eye(4), kind) if T is None else Part(mesh.moved(T), T, kind)
        self.parts.append(moved)

    def build(self) -> Mesh:
        """Return all there is: parts, road surfaces and open ground."""
        surfaces = [road_mesh(road, self.roads, self.terrain) for road in self.roads]
        return merge([self._ground(), *surfaces, *(part.mesh for part in self.parts)])

    def pose(self, road: Road, s: float, lateral: float, turn: float = 0.0) -> Array:
        """Return the upright (4, 4) pose on the land beside a road, x along it plus `turn`."""
        xy = road.path.point(np.array([s]), lateral)
        heading = float(road.path.heading(np.array([s]))[0])
        z = float(self.terrain.height(xy)[0])
        return planar(float(xy[0, 0]), float(xy[0, 1]), z, heading + turn)

    def pose_at(self, xy: Array, turn: float) -> Array:
        """Return the upright (4, 4) pose on the land at a point (2,)."""
        z = float(self.terrain.height(xy[None])[0])
        return planar(float(xy[0]), float(xy[1]), z, turn)

    def clear_of_others(self, road: Road, T: Array, margin: float) -> bool:
        """Return whether the pose T is `margin` metres off every other carriageway."""
        xy = T[None, :2, 3]
        return not any(bool(o.covers(xy, margin)[0]) for o in self.roads if o is not road)

    def free(self, xy: Array) -> bool:
        """Return whether all (N, 2) points are on the site and nothing stands there."""
        index = self._index(xy)
        inside = np.all((index >= 0) & (index < self._taken.shape))
        return bool(inside and not self._taken[index[:, 0], index[:, 1]].any())

    def claim(self, xy: Array) -> None:
        """Take the ground at (N, 2) points."""
        index = self._index(xy)
        index = index[np.all((index >= 0) & (index < self._taken.shape), axis=1)]
        self._taken[index[:, 0], index[:, 1]] = True

    def take(self, T: Array, length: float, width: float) -> bool:
        """Claim a rectangle of x by y metres about the pose T if it is free; return whether."""
        xy = footprint(T, length, width)
        if not self.free(xy):
            return False
        self.claim(xy)
        return True

    def random_point(self) -> Array:
        """Return a random (2,) point of the site."""
        return np.asarray(self.rng.uniform(self._low + 5, self._high - 5))

    def _index(self, xy: Array) -> NDArray[np.intp]:
        return np.asarray(np.floor((xy - self._low) / _CELL), dtype=np.intp)

    def _ground(self) -> Mesh:
        """Return the open ground: a rough grid with the roads' corridors cut out."""
        axes = [np.arange(self._low[i], self._high[i], _GROUND_STEP) for i in range(2)]
        xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        flat = xy.reshape(-1, 2)
        rise = self._edge_rise - np.abs(self.rng.normal(0, _ROUGHNESS, len(flat)))
        covered = np.zeros(len(flat), dtype=np.bool_)
        for road in self.roads:
            covered |= road.within(flat, -_OVERLAP)
            below = road.within(flat)
            rise[below] = np.minimum(rise[below], road.rise(flat[below]))
        z = self.terrain.height(flat) + rise - _SINK
        under = covered.reshape(xy.shape[:2])
        # Cells that are partly covered stay, just below the road's edge: no gap opens there.
        keep = ~(under[:-1, :-1] & under[1:, :-1] & under[1:, 1:] & under[:-1, 1:])
        grid = np.concatenate([xy, z.reshape(*xy.shape[:2], 1)], axis=2)
        return from_grid(grid, GRASS, keep)


def footprint(T: Array, length: float, width: float) -> Array:
    """Return (N, 2) points that fill a rectangle of x by y metres about the pose T."""
    axes = [np.linspace(-d / 2, d / 2, max(int(np.ceil(d / 0.4)), 1) + 1) for d in (length, width)]
    local = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    moved: Array = local @ T[:2, :2].T + T[:2, 3]
    return moved


def _corridor(road: Road, step: float) -> Array:
    """Return (N, 2) points that fill a road's cross-section."""
    s = np.arange(road.path.start, road.path.end + step, step)
    d = np.arange(road.profile.lateral[-1], road.profile.lateral[0] + step, step)
    grid = np.meshgrid(s, d)
    return road.path.point(grid[0].ravel(), grid[1].ravel())
