"""The floor plan of a building of corridors and rooms, and the ways through it.

Three long corridors are joined by three cross corridors, 276 m in all; rooms with doors line both sides of
the long ones.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path

from lifelong_slam.simulation.seeds import generator

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LONG_CORRIDORS = (0.0, 16.0, 32.0)  # y in metres
CROSS_CORRIDORS = (0.0, 30.0, 60.0)  # x in metres
CORRIDOR_WIDTH = 2.4
ROOM_WIDTHS = (4.0, 6.0, 8.5)  # of the kinds of room, along the corridor
ROOM_DEPTH = 5.6
CORRIDOR = 0  # kind of area; rooms are 1 and more
_HALF = CORRIDOR_WIDTH / 2
_MARGIN = 1.0  # between a wall and where the robot goes


@dataclass(frozen=True, slots=True)
class Building:
    """A floor plan and the ways through it.

    Attributes:
        areas: (A, 4) x and y of the lower, then of the upper corner of each corridor and room, metres.
            What lies in one area sees each other.
        kinds: (A,) 0 for corridors, else the kind of room; areas of a kind look alike.
        rooms: (R,) indices of the rooms into `areas`.
        entries: (R,) indices into `nodes` of the points behind the rooms' doors.
        nodes: (V, 2) points that ways lead through, metres.
        ways: (W, 2) pairs of nodes with a straight way between them.
    """

    areas: Array
    kinds: Indices
    rooms: Indices
    entries: Indices
    nodes: Array
    ways: Indices

    def contains(self, positions: Array) -> NDArray[np.bool_]:
        """Return (N, A) which of the areas each of (N, 2) positions lies in."""
        lower = (positions[:, None] >= self.areas[:, :2]).all(axis=2)
        upper = (positions[:, None] <= self.areas[:, 2:]).all(axis=2)
        return np.logical_and(lower, upper)

    def route(self, length: float, rng: np.random.Generator) -> Array:
        """Return (N, 2) corners of a way between randomly drawn rooms, at least `length` metres."""
        came_from = self._came_from()
        room = int(rng.integers(len(self.rooms)))
        corners, driven = [self._goal(room, rng)], 0.0
        while driven < length:
            goal = int((room + rng.integers(1, len(self.rooms))) % len(self.rooms))
            way = [int(self.entries[goal])]
            while way[-1] != self.entries[room]:
                way.append(int(came_from[self.entries[room], way[-1]]))
            leg = np.vstack([self.nodes[way[::-1]], self._goal(goal, rng)])
            driven += float(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum())
            corners.append(leg)
            room = goal
        return np.vstack(corners)

    def _goal(self, room: int, rng: np.random.Generator) -> Array:
        lower, upper = np.split(self.areas[self.rooms[room]], 2)
        goal: Array = rng.uniform(lower + _MARGIN, upper - _MARGIN)
        return goal

    def _came_from(self) -> Indices:
        """Return (V, V) the last node before the column's on the shortest way from the row's."""
        lengths = np.linalg.norm(self.nodes[self.ways[:, 0]] - self.nodes[self.ways[:, 1]], axis=1)
        shape = (len(self.nodes), len(self.nodes))
        network = coo_array((lengths, (self.ways[:, 0], self.ways[:, 1])), shape=shape)
        _, before = shortest_path(network.tocsr(), directed=False, return_predecessors=True)
        return np.asarray(before, dtype=np.int64)


def draw_building(seed: int) -> Building:
    """Draw a floor plan; equal seeds give equal plans."""
    rng = generator(seed, "building")
    plan = _Plan()
    first, last = CROSS_CORRIDORS[0], CROSS_CORRIDORS[-1]
    for y in LONG_CORRIDORS:
        plan.add_area(CORRIDOR, (first - _HALF, y - _HALF), (last + _HALF, y + _HALF))
    for x in CROSS_CORRIDORS:
        low, high = LONG_CORRIDORS[0] - _HALF, LONG_CORRIDORS[-1] + _HALF
        plan.add_area(CORRIDOR, (x - _HALF, low), (x + _HALF, high))
    for y in LONG_CORRIDORS:
        doors = [door for side in (-1, 1) for door in plan.add_rooms(rng, y, side)]
        plan.add_way([(x, y) for x in sorted([*CROSS_CORRIDORS, *doors])])
    for x in CROSS_CORRIDORS:
        plan.add_way([(x, y) for y in LONG_CORRIDORS])
    return plan.building()


@dataclass
class _Plan:
    """A floor plan in the making; its fields are those of Building."""

    areas: list[tuple[float, float, float, float]] = field(default_factory=list)
    kinds: list[int] = field(default_factory=list)
    entries: list[int] = field(default_factory=list)
    nodes: dict[tuple[float, float], int] = field(default_factory=dict)
    ways: list[tuple[int, int]] = field(default_factory=list)

    def building(self) -> Building:
        kinds = np.array(self.kinds)
        return Building(
            areas=np.array(self.areas),
            kinds=kinds,
            rooms=np.flatnonzero(kinds != CORRIDOR),
            entries=np.array(self.entries),
            nodes=np.array(list(self.nodes)),
            ways=np.array(self.ways),
        )

    def add_area(self, kind: int, lower: tuple[float, float], upper: tuple[float, float]) -> None:
        self.areas.append((*lower, *upper))
        self.kinds.append(kind)

    def add_rooms(self, rng: np.random.Generator, y: float, side: int) -> Iterator[float]:
        """Line one side of a long corridor with rooms, and yield the x of their doors."""
        wall = y + side * _HALF
        back = wall + side * ROOM_DEPTH
        for kind, left, right in _rooms_along(rng):
            self.add_area(kind, (left, min(wall, back)), (right, max(wall, back)))
            door = float(rng.uniform(left + _MARGIN, right - _MARGIN))
            self.add_way([(door, y), (door, wall + side * _MARGIN)])
            self.entries.append(self._node((door, wall + side * _MARGIN)))
            yield door

    def add_way(self, points: list[tuple[float, float]]) -> None:
        """Join points by straight ways, one after the other."""
        nodes = [self._node(point) for point in points]
        self.ways += pairwise(nodes)

    def _node(self, point: tuple[float, float]) -> int:
        return self.nodes.setdefault(point, len(self.nodes))


def _rooms_along(rng: np.random.Generator) -> Iterator[tuple[int, float, float]]:
    """Yield kind, lower and upper x of the rooms along a long corridor, between the cross corridors."""
    for before, after in pairwise(CROSS_CORRIDORS):
        left, end = before + _HALF, after - _HALF
        while end - left >= min(ROOM_WIDTHS):
            fitting = [i for i, width in enumerate(ROOM_WIDTHS) if width <= end - left]
            kind = int(rng.choice(fitting))
            yield kind + 1, left, left + ROOM_WIDTHS[kind]
            left += ROOM_WIDTHS[kind]
