"""What is lost when a vertex is removed, and how much of it would a better fit of the edges keep?

    python benchmarks/factor_recovery.py [--hours 2] [--seed 0] [--every 5]

A robot drives through the building of `scripts/ablate_pruning.py`, pruned by `geometry`. At every fifth
removal, what the vertex's edges say about its neighbours is put in three ways:

- mesh: the edges of `StarMesh`, a closed form;
- recovered: nonlinear factor recovery (Mazuran, Burgard and Tipaldi, IJRR 2016). Between the same pairs of
  neighbours, those edges are sought whose information is nearest to the exact marginal in Kullback-Leibler
  divergence; a convex problem, solved by L-BFGS from the mesh;
- tree: `ChowLiu`.

Each is compared with the exact marginal, the Schur complement at the current estimate. The divergence is
that of the Gaussian with the exact information from the one with the edges', one neighbour being held, in
nats for each dimension. The spread is the standard deviation that the edges claim relative to the exact
one, root mean square over all directions: below 1, they claim to know too much. A star is parted if its
edges leave some neighbours without a tie to the others: in the graph these have other ties, but what the
star said of this one is lost. Parted stars are counted; the other columns are about the rest.
"""

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import minimize
from throughput import facts, markdown

from lifelong_slam.geometry import invert
from lifelong_slam.graph.ablation import drive
from lifelong_slam.graph.edges import fuse, outward
from lifelong_slam.graph.marginalisation import ChowLiu, Marginalisation, StarMesh
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.pruning import Pruner
from lifelong_slam.graph.selection import Geometry
from lifelong_slam.result import Edge
from lifelong_slam.simulation.building_run import BuildingRun

Array = NDArray[np.float64]

SPACING = 4.0  # metres between vertices
MANY = 1000
GROUPS = ((2, 2), (3, 3), (4, 4), (5, 6), (7, MANY))  # numbers of neighbours, from and to
METHODS = ("mesh", "recovered", "tree")
_PARTED = 1e-9  # information relative to the exact one, in the direction of which least is left


@dataclass(frozen=True, slots=True)
class Loss:
    """What one method makes of one removal.

    Attributes:
        divergence: nats for each dimension; infinite for a star that is parted.
        spread: relative to the exact one; infinite likewise.
        ms: wall time.
    """

    divergence: float
    spread: float
    ms: float


class Star:
    """A vertex and its neighbours, apart from the rest of a graph and with measurements as estimated.

    The neighbours are 0, 1, ..., n - 1 and the vertex is n. Information is about the neighbours 1, 2, ...
    in their own frames, (6 n - 6, 6 n - 6); neighbour 0 is held.
    """

    def __init__(self, graph: PoseGraph, vertex: int, lasting: Collection[int]) -> None:
        edges = [outward(edge, vertex) for edge in graph.incident(vertex)]
        neighbours = sorted({edge.target for edge in edges})
        self.vertex = len(neighbours)
        self.lasting = {i for i, neighbour in enumerate(neighbours) if neighbour in lasting}
        self._poses = {i: graph.pose(v) for i, v in enumerate((*neighbours, vertex))}
        self._values = gtsam.Values()
        for i, T in self._poses.items():
            self._values.insert(i, gtsam.Pose3(T))
        numbers = [neighbours.index(edge.target) for edge in edges]
        self._edges = [
            Edge(self.vertex, i, self._relative(self.vertex, i), edge.covariance, edge.kind)
            for i, edge in zip(numbers, edges, strict=True)
        ]
        H = self._information(self._edges, self.vertex + 1)
        to_vertex = H[:-6, -6:]
        self.exact = (H[:-6, :-6] - to_vertex @ np.linalg.solve(H[-6:, -6:], to_vertex.T))[6:, 6:]

    def left_by(self, method: Marginalisation) -> list[Edge]:
        """Return the edges that remain when a method has removed the vertex."""
        graph = PoseGraph()
        graph.restore(self._poses, dict(enumerate(self._edges)))
        method.remove(graph, self.vertex, self.lasting)
        return graph.edges

    def said_by(self, edges: Sequence[Edge]) -> Array:
        """Return the information that edges between neighbours hold."""
        return self._information(edges, self.vertex)[6:, 6:]

    def recovered(self, edges: Sequence[Edge]) -> Array:
        """Return the information of the best edges between the same pairs as the given ones.

        An edge with information W and the Jacobian J adds J^T W J to Q. The divergence is
        1/2 (tr(Q C) - log det(Q C) - d), with C the exact covariance; W = L L^T stays positive.
        """
        between = defaultdict(list)
        for edge in edges:
            between[min(edge.source, edge.target), max(edge.source, edge.target)].append(edge)
        fused = [fuse(group) for group in between.values()]
        # Whitened by the edges as they are, so that the search begins at W = I in all units alike.
        J = np.array([self._jacobian(edge) for edge in fused])
        wanted = J @ np.linalg.inv(self.exact) @ np.swapaxes(J, 1, 2)
        lower = np.tril_indices(6)

        def factors(x: Array) -> Array:
            L = np.zeros((len(J), 6, 6))
            L[:, *lower] = x.reshape(len(J), -1)
            return L

        def information(L: Array) -> Array:
            rows = (np.swapaxes(L, 1, 2) @ J).reshape(-1, J.shape[2])
            return np.asarray(rows.T @ rows)

        def divergence(x: Array) -> tuple[float, Array]:
            L = factors(x)
            Q = information(L)
            if np.linalg.cond(Q) > 1e14:  # a step too far
                return np.inf, np.zeros_like(x)
            claimed = J @ np.linalg.solve(Q, np.swapaxes(J, 1, 2))
            value = np.sum(wanted * (L @ np.swapaxes(L, 1, 2))) - np.linalg.slogdet(Q)[1]
            return float(value), (2 * (wanted - claimed) @ L)[:, *lower].ravel()

        start = np.tile(np.eye(6)[lower], len(J))
        best = minimize(divergence, start, jac=True, method="L-BFGS-B", options={"maxiter": 1000})
        return information(factors(best.x))

    def _relative(self, source: int, target: int) -> Array:
        return invert(self._poses[source]) @ self._poses[target]

    def _information(self, edges: Sequence[Edge], count: int) -> Array:
        """Return the (6 count, 6 count) information of edges between vertices 0, 1, ..., count - 1."""
        ordering = gtsam.Ordering()
        for i in range(count):
            ordering.push_back(i)
        factors = gtsam.NonlinearFactorGraph()
        for edge in edges:
            factors.push_back(self._factor(edge))
        return np.asarray(factors.linearize(self._values).hessian(ordering)[0])

    def _jacobian(self, edge: Edge) -> Array:
        """Return the (6, 6 n - 6) whitened Jacobian of an edge between neighbours."""
        J = np.zeros((6, 6 * self.vertex))
        factor = self._factor(edge).linearize(self._values)
        for i, columns in zip(
            factor.keys(), np.split(factor.jacobian()[0], 2, axis=1), strict=True
        ):
            J[:, 6 * i : 6 * i + 6] = columns
        return J[:, 6:]

    def _factor(self, edge: Edge) -> gtsam.BetweenFactorPose3:
        motion = gtsam.Pose3(self._relative(edge.source, edge.target))
        model = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        return gtsam.BetweenFactorPose3(edge.source, edge.target, motion, model)


@dataclass
class Watched:
    """Star-mesh marginalisation that compares itself now and then with its alternatives.

    Attributes:
        every: removals from one comparison to the next.
        losses: by method, for each star that was compared.
        neighbours: of each of these stars.
    """

    leaves_edges: ClassVar[bool] = True
    every: int
    losses: dict[str, list[Loss]] = field(default_factory=lambda: defaultdict(list))
    neighbours: list[int] = field(default_factory=list)
    _removed: int = 0

    def remove(self, graph: PoseGraph, vertex: int, lasting: Collection[int]) -> None:
        """Remove a vertex; see Marginalisation."""
        if self._removed % self.every == 0:
            star = Star(graph, vertex, lasting)
            if star.vertex > 1:  # neighbours
                self.neighbours.append(star.vertex)
                for method, one in zip(METHODS, compare(star), strict=True):
                    self.losses[method].append(one)
        self._removed += 1
        StarMesh().remove(graph, vertex, lasting)


def compare(star: Star) -> Iterator[Loss]:
    """Yield what the methods, in the order of METHODS, make of a star."""
    start = time.perf_counter()
    mesh = star.left_by(StarMesh())
    meshed = time.perf_counter() - start
    yield loss(star.exact, star.said_by(mesh), meshed)
    start = time.perf_counter()
    best = star.recovered(mesh)
    yield loss(star.exact, best, meshed + time.perf_counter() - start)
    start = time.perf_counter()
    tree = star.left_by(ChowLiu())
    yield loss(star.exact, star.said_by(tree), time.perf_counter() - start)


def loss(exact: Array, claimed: Array, seconds: float) -> Loss:
    """Compare the information of edges with the exact one."""
    ratios = eigh(claimed, exact, eigvals_only=True)
    if ratios[0] < _PARTED:
        return Loss(np.inf, np.inf, 1e3 * seconds)
    divergence = np.mean(ratios - 1 - np.log(ratios)) / 2
    return Loss(float(divergence), float(np.sqrt(np.mean(1 / ratios))), 1e3 * seconds)


def table(watched: Watched) -> str:
    """Lay out medians by number of neighbours."""
    counts = np.array(watched.neighbours)
    rows = []
    for low, high in GROUPS:
        chosen = np.flatnonzero((counts >= low) & (counts <= high))
        name = (
            str(low) if low == high else f"{low} and more" if high == MANY else f"{low} to {high}"
        )
        for method in METHODS if len(chosen) else ():
            losses = [watched.losses[method][i] for i in chosen]
            figures = np.array([(one.divergence, one.spread, one.ms) for one in losses])
            whole = figures[np.isfinite(figures[:, 0])]
            nats, spread, ms = np.median(whole, axis=0)
            worse = np.quantile(whole[:, 0], 0.9)
            numbers = (f"{nats:.4f}", f"{worse:.4f}", f"{spread:.3f}", f"{ms:.1f}")
            rows.append([name, str(len(chosen)), method, str(len(figures) - len(whole)), *numbers])
    head = [
        "neighbours",
        "removals",
        "method",
        "parted",
        "divergence",
        "90th percentile",
        "spread",
        "ms",
    ]
    return markdown(head, rows)


def main() -> None:
    """Drive, compare and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=int, default=5)
    options = parser.parse_args()
    watched = Watched(options.every)
    for _ in drive(BuildingRun(options.hours, options.seed), Pruner(Geometry(SPACING), watched)):
        pass
    print(facts("factor_recovery.py", sys.argv[1:]))
    print(table(watched))


if __name__ == "__main__":
    main()
