"""Reduces a whole pose graph at once: what it was, what it becomes, and what that changed."""

import logging
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import ConfigError
from lifelong_slam.graph.initialisation import best_start
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.pruning import Pruning
from lifelong_slam.graph.removal import Removal, recover
from lifelong_slam.result import GraphSnapshot

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class State:
    """A pose graph at one moment of its reduction.

    Attributes:
        poses: T_map_vertex (4, 4) of all vertices that the graph ever had, by id.
        vertices: that it has, lowest first.
        edges: in use.
        loops: those of them that are loop closures.
        composed: those of them that are made of several measurements, closures among them.
        rejected: loop closures and composed edges that are rejected.
        chi_square: sum of squared Mahalanobis distances of the edges in use.
        seconds: wall time that it took to come here from the state before.
    """

    poses: dict[int, Array]
    vertices: list[int]
    edges: int
    loops: int
    composed: int
    rejected: int
    chi_square: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Reduction:
    """The states of a graph that is optimised, pruned and optimised again.

    Attributes:
        read: as it was given.
        optimum: of all its vertices.
        pruned: the optimum of those that stay; the others follow them.
        graph: what is left.
        complete: whether `graph` holds all that is known: it has no place for factors over many vertices.
    """

    read: State
    optimum: State
    pruned: State
    graph: GraphSnapshot
    complete: bool


def reduce(
    snapshot: GraphSnapshot,
    pruning: Pruning,
    keep: float,
    robust: bool = True,
) -> Reduction:
    """Optimise a graph, remove vertices, and optimise what is left.

    Args:
        snapshot: not changed; its edges need no particular start.
        pruning: the method.
        keep: share of the vertices that stay, if no more are needed to hold the graph together.
        robust: let loop closures vote, and leave out those that don't fit; else all count.

    Raises:
        ConfigError: the share isn't one, or the graph has no edges.
    """
    if not 0 < keep <= 1:
        raise ConfigError(f"keep is a share of the vertices, above 0 and at most 1, not {keep:g}")
    if not snapshot.edges:
        raise ConfigError("the pose graph has no edges: there is nothing to reduce")
    logger.info(
        "%d vertices (%d fixed), %d edges, %d priors; optimising ...",
        len(snapshot.poses),
        len(snapshot.fixed),
        len(snapshot.edges),
        len(snapshot.priors),
    )
    watch = _Watch()
    graph = loaded(snapshot, robust)
    read = watch.state(graph, [])
    graph = loaded(replace(snapshot, poses=best_start(snapshot)), robust)
    graph.optimise(reconsider=True)
    optimum = watch.state(graph, [])
    if robust and (doubt := graph.doubt):
        logger.warning("warning: %s (robust=false trusts them all)", doubt)
    left = max(round(keep * len(graph)), 1)
    logger.info("Optimised in %.1f s; down to %d vertices ...", optimum.seconds, left)
    removals = pruning.reduce(graph, left)
    graph.optimise()
    pruned = watch.state(graph, removals)
    return Reduction(
        read, optimum, pruned, graph.snapshot(), complete=graph.edge_count == len(graph.edges)
    )


def loaded(snapshot: GraphSnapshot, robust: bool = True) -> PoseGraph:
    """Return a pose graph that is there as a whole, and didn't grow from its root.

    Vertices keep the poses that they are given; what holds a connected part are its fixed vertices and
    priors, or its lowest vertex.

    Args:
        snapshot: not changed.
        robust: let loop closures vote; else all count.
    """
    graph = PoseGraph(snapshot.planar, trust_closures=not robust)
    graph.restore(
        snapshot.poses,
        dict(enumerate(snapshot.edges)),
        solved=False,
        fixed=snapshot.fixed,
        priors=snapshot.priors,
    )
    return graph


class _Watch:
    """Takes down states and the time between them."""

    def __init__(self) -> None:
        self._last = time.perf_counter()

    def state(self, graph: PoseGraph, removals: list[Removal]) -> State:
        """Take down how a graph stands."""
        now = time.perf_counter()
        edges = graph.edges
        state = State(
            poses=recover(graph.poses(), removals),
            vertices=sorted(graph.vertices),
            edges=graph.edge_count,
            loops=sum(edge.kind == "loop" for edge in edges),
            composed=sum(edge.kind == "composed" for edge in edges),
            rejected=len(graph.rejected),
            chi_square=graph.chi_square(),
            seconds=now - self._last,
        )
        self._last = time.perf_counter()
        return state
