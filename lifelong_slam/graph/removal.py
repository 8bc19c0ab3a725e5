"""Removed vertices, and how their poses come back.

A vertex that is marginalised leaves the graph but not the trajectory. Given its neighbours, its most
probable pose is the mean of what its edges say, weighted by their information: the back-substitution
that ends every elimination. Kept as such a mean over those of its neighbours that it depends on most,
and not frozen to one of them, a removed pose goes on improving with the graph, as it would have in the
unpruned one.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import adjoint, exp, invert, log
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.memory import GrowingArray

Array = NDArray[np.float64]

_NEIGHBOURS = 6  # that a removed pose hangs on; more of them gain little


@dataclass(frozen=True, slots=True)
class Removal:
    """What is left of a removed vertex.

    Attributes:
        vertex: its id.
        neighbours: (k,) ids of the vertices it hangs on; they may be removed later themselves.
        T_neighbour_vertex: (k, 4, 4) its pose in the frame of each, when it was removed.
        gains: (k, 6, 6) weights, in the vertex's frame, that sum to the identity.
    """

    vertex: int
    neighbours: NDArray[np.int64]
    T_neighbour_vertex: Array
    gains: Array


class RemovalLog:
    """All removals of a run, in the order in which they were made."""

    def __init__(self) -> None:
        """Start empty."""
        self._vertices = GrowingArray(np.zeros(0, np.int64))
        self._ends = GrowingArray(np.zeros(0, np.int64))  # of each vertex's rows in what follows
        self._neighbours = GrowingArray(np.zeros(0, np.int64))
        self._T_neighbour_vertex = GrowingArray(np.zeros((0, 4, 4)))
        # They weigh shifts of metres at most, which single precision gives to a micrometre.
        self._gains = GrowingArray(np.zeros((0, 6, 6), np.float32))

    def extend(self, removals: Iterable[Removal]) -> None:
        """Take in copies of removals."""
        for removal in removals:
            self._neighbours.extend(removal.neighbours)
            self._T_neighbour_vertex.extend(removal.T_neighbour_vertex)
            self._gains.extend(removal.gains)
            self._vertices.append(removal.vertex)
            self._ends.append(len(self._neighbours))

    def __len__(self) -> int:
        return len(self._vertices)

    def __iter__(self) -> Iterator[Removal]:
        start = 0
        for vertex, end in zip(self._vertices.rows.tolist(), self._ends.rows.tolist(), strict=True):
            yield Removal(
                vertex,
                self._neighbours.rows[start:end],
                self._T_neighbour_vertex.rows[start:end],
                self._gains.rows[start:end],
            )
            start = end


def removal_of(graph: PoseGraph, vertex: int) -> Removal:
    """Return what must be kept of a vertex that is about to be removed from an optimised graph."""
    neighbours, gains = graph.conditional(vertex)
    T = invert(np.array([graph.pose(i) for i in neighbours])) @ graph.pose(vertex)
    # A neighbour that moves by Exp(d) takes the vertex along by Exp(Ad(T^-1) d).
    gains = gains @ adjoint(T)
    strongest = np.argsort(-np.trace(gains, axis1=1, axis2=2), kind="stable")[:_NEIGHBOURS]
    gains = gains[strongest]
    return Removal(
        vertex,
        np.array(neighbours, dtype=np.int64)[strongest],
        T[strongest],
        np.linalg.solve(gains.sum(0), gains),
    )


def recover(poses: Mapping[int, Array], removals: Iterable[Removal]) -> dict[int, Array]:
    """Return the poses (4, 4) of a graph's vertices and of all that were removed from it.

    Args:
        poses: T_map_vertex of the vertices that the graph has.
        removals: in the order in which they were made.

    Raises:
        LookupError: one hangs on what is neither a vertex nor removed later.
    """
    removals = list(removals)
    levels = _levels(poses, removals)

    def level(removal: Removal) -> int:
        return levels[removal.vertex]

    every = dict(poses)
    for _, group in groupby(sorted(removals, key=level), level):
        alike = list(group)
        every |= zip([removal.vertex for removal in alike], _means(alike, every), strict=True)
    return every


def _levels(vertices: Iterable[int], removals: Sequence[Removal]) -> dict[int, int]:
    """Return by id how many recoveries must come one after the other: 0 for a vertex of the graph."""
    levels = dict.fromkeys(vertices, 0)
    for removal in reversed(removals):
        neighbours = removal.neighbours.tolist()
        try:
            levels[removal.vertex] = 1 + max([levels[i] for i in neighbours])
        except KeyError as error:
            raise LookupError(
                f"keyframe {removal.vertex} hangs on {error},"
                " which is neither a vertex nor removed later"
            ) from error
    return levels


def _means(removals: Sequence[Removal], poses: Mapping[int, Array]) -> Array:
    """Return the most probable (N, 4, 4) poses of removed vertices, given all their neighbours'."""
    counts = [len(removal.neighbours) for removal in removals]
    first = np.cumsum([0, *counts[:-1]])
    neighbours = np.concatenate([removal.neighbours for removal in removals]).tolist()
    T = np.concatenate([removal.T_neighbour_vertex for removal in removals])
    gains = np.concatenate([removal.gains for removal in removals])
    means = np.array([poses[i] for i in neighbours]) @ T
    shifts = log(invert(np.repeat(means[first], counts, axis=0)) @ means)
    weighted = (gains @ shifts[..., None])[..., 0]
    mean: Array = means[first] @ exp(np.add.reduceat(weighted, first))
    return mean
