"""Pruning: the graph grows with the place and not with time.

Kurz, Holoch and Biber, *Geometry-based graph pruning for lifelong SLAM* (IROS 2021): vertices are chosen by
geometry and marginalised. The newest are left alone until loop closures have had their say about them;
after that each is settled: it goes, or it stays until others make up for it. What stays has to stay
where it is, within its covariance (bound.py): a vertex that can't go without moving it isn't removed.
"""

from collections import Counter
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Protocol

import networkx
import numpy as np
from numpy.typing import NDArray

from lifelong_slam.graph.bound import Bound
from lifelong_slam.graph.marginalisation import Marginalisation
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.removal import Removal, removal_of
from lifelong_slam.graph.selection import Selection

Array = NDArray[np.float64]

CHECKED = "removals checked"  # batches of them
UNDONE = "removals undone"
REFUSED = "removals refused"  # of single vertices
_PATIENCE = 100  # batches undone in one go


class Pruning(Protocol):
    """Keeps a growing graph small.

    Attributes:
        leaves_edges: what it leaves are edges between two vertices, which files can hold.
    """

    leaves_edges: bool

    @property
    def counts(self) -> Mapping[str, int]:
        """What has happened so far, by name."""
        ...

    def settle(self, graph: PoseGraph, vertices: Collection[int]) -> list[Removal]:
        """Remove what the graph can do without among vertices that left the window of the newest.

        Args:
            graph: at its optimum; changed in place.
            vertices: those that left the window since the last call, of one component.
        """
        ...

    def adopt(
        self, vertices: Collection[int], poses: Mapping[int, Array], hosts: Mapping[int, int]
    ) -> None:
        """Take over what was settled in earlier sessions.

        Args:
            vertices: those that stayed, of one component.
            poses: (4, 4) T_map_vertex of all that there have ever been.
            hosts: the vertex that each of them is or hangs on, of those that are still there in
                this component.
        """
        ...

    def reduce(self, graph: PoseGraph, keep: int) -> list[Removal]:
        """Remove vertices, once and for all, until `keep` are left or only protected ones."""
        ...


class NoPruning:
    """Leaves the graph as it is."""

    leaves_edges = True
    counts: Mapping[str, int] = MappingProxyType({})  # nothing happens

    def settle(self, graph: PoseGraph, vertices: Collection[int]) -> list[Removal]:
        """Remove nothing."""
        return []

    def adopt(
        self, vertices: Collection[int], poses: Mapping[int, Array], hosts: Mapping[int, int]
    ) -> None:
        """Do nothing."""

    def reduce(self, graph: PoseGraph, keep: int) -> list[Removal]:
        """Remove nothing."""
        return []


class Pruner:
    """Chooses vertices by one rule and marginalises them by another.

    They are removed in one batch. Where that moves what stays by too much it is undone, and each half is
    tried by itself, and so on. A vertex that can't be removed even alone is refused: it stays. So does,
    when much has been tried already, a batch that can't be removed as a whole.
    """

    def __init__(self, selection: Selection, marginalisation: Marginalisation) -> None:
        """Set up.

        Args:
            selection: which vertices go.
            marginalisation: what becomes of their edges.
        """
        self._selection = selection
        self._marginalisation = marginalisation
        self._kept: set[int] = set()
        self.leaves_edges = marginalisation.leaves_edges
        self.counts: Counter[str] = Counter(dict.fromkeys((CHECKED, UNDONE, REFUSED), 0))

    def settle(self, graph: PoseGraph, vertices: Collection[int]) -> list[Removal]:
        """Choose among the given vertices and those that stayed before. See Pruning."""
        if not vertices:
            return []
        connected = graph.component(next(iter(vertices)))  # poses of others are in another frame
        older = self._kept & connected
        poses = {vertex: graph.pose(vertex) for vertex in (*sorted(older), *vertices)}
        fixed = protected(graph)
        chosen = self._selection.settle(poses, set(vertices) - fixed, older - fixed)
        self._kept = (self._kept | set(vertices)) - set(chosen)
        removals = self._remove(graph, chosen, self._kept)
        self._kept |= {vertex for vertex in chosen if vertex in graph}
        return removals

    def adopt(
        self, vertices: Collection[int], poses: Mapping[int, Array], hosts: Mapping[int, int]
    ) -> None:
        """Count vertices among those that stayed before. See Pruning."""
        self._kept |= set(vertices)
        self._selection.adopt(poses, hosts)

    def reduce(self, graph: PoseGraph, keep: int) -> list[Removal]:
        """Remove down to a number of vertices. See Pruning."""
        removable = set(graph.vertices) - protected(graph)
        removed = self._selection.reduce(graph.poses(), removable, len(graph) - keep)
        return self._remove(graph, removed, set(graph.vertices) - set(removed))

    def _remove(
        self, graph: PoseGraph, vertices: list[int], lasting: Collection[int]
    ) -> list[Removal]:
        """Remove vertices, but for those without which the others don't stay where they are."""
        if not vertices:
            return []
        graph.relax()  # marginals are of first order, and right at the optimum only
        bound = Bound(graph)
        removals: list[Removal] = []
        batches, patience = [vertices], _PATIENCE
        while batches:
            batch = batches.pop()
            before = graph.checkpoint()
            made = [self._marginalise(graph, vertex, lasting) for vertex in batch]
            graph.relax()
            self.counts[CHECKED] += 1
            if bound.allows(graph, [*removals, *made]):
                removals += made
                continue
            graph.rollback(before)
            patience -= 1
            self.counts[UNDONE] += 1
            if len(batch) > 1 and patience > 0:
                half = len(batch) // 2
                batches += batch[half:], batch[:half]
            else:
                self.counts[REFUSED] += len(batch)
        return removals

    def _marginalise(self, graph: PoseGraph, vertex: int, lasting: Collection[int]) -> Removal:
        removal = removal_of(graph, vertex)
        self._marginalisation.remove(graph, vertex, lasting)
        return removal


def protected(graph: PoseGraph) -> set[int]:
    """Return the vertices that hold a graph together.

    These are the vertices that hold a part in its frame (roots, fixed vertices, those with priors, one of a
    part that only outvoted edges lead to), and the articulation vertices in which more than two edges
    meet: the joints of loops and of sessions. One with two edges is a link of a chain, which
    marginalisation replaces exactly.
    """
    structure = networkx.Graph((e.source, e.target) for e in graph.edges)
    joints = networkx.articulation_points(structure)
    return graph.held | {vertex for vertex in joints if structure.degree(vertex) > 2}
