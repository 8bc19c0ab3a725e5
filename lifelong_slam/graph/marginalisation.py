"""Removing a vertex: what its edges said about its neighbours, said by edges among those.

In a vertex's own frame its edges are the arms of a star: arm i says where neighbour i is, with
information L_i. With S the sum of all, eliminating the vertex leaves the neighbours with the information
matrix whose block between i and j is -L_i S^-1 L_j (the Schur complement). Where the L_i commute that is
exactly the matrix of independent edges between all pairs, i to j with information L_i S^-1 L_j: the
star-mesh transform of electrical networks, in which every measurement is spent once. `StarMesh` builds on
it; `ChowLiu` and `Dense` are what the literature does.
"""

from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree

from lifelong_slam.geometry import adjoint, invert
from lifelong_slam.graph.edges import chain, chained_kind, fuse, outward, reverse
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.result import Edge

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MAX_COST = 1.5  # chi-square that a mesh may have at the optimum, over the star's
_MAX_ANGLE = (
    0.3  # rad; a larger error isn't of first order on SE(3), and forces aren't what they seem
)
_WEAK = 0.01  # share of an arm in what is known about the vertex
_LEAST_EIGENVALUE = 1e-2  # of a pair's information, relative to the greatest: keeps it invertible


class Marginalisation(Protocol):
    """Removes vertices from a graph and keeps what was measured through them.

    Attributes:
        leaves_edges: what it leaves are edges between two vertices.
    """

    leaves_edges: ClassVar[bool]

    def remove(self, graph: PoseGraph, vertex: int, lasting: Collection[int]) -> None:
        """Remove a vertex.

        Args:
            graph: changed in place.
            vertex: not a root of the graph.
            lasting: vertices that are going to stay; new edges had better end there.
        """
        ...


@dataclass(frozen=True, slots=True)
class StarMesh:
    """Edges among neighbours that spend each measurement once and stay few.

    The strongest arms become a mesh: all pairs of them, with the information of the Schur complement.
    Each weaker arm is chained to a strong one, whose uncertainty hardly counts beside its own. An edge
    between two that have one already is fused with it.

    An edge that any loop closure went into is composed, and the graph can outvote it as it can a
    closure. Odometry is also combined with odometry alone, so that the path of odometry through all
    vertices remains: it keeps the graph connected whatever is outvoted.

    A vertex that ends up with too many edges loses those that are worth least, but no odometry: those
    between vertices that a third one ties together more firmly than they do.

    Attributes:
        arms: how many of the strongest arms are meshed.
        max_edges: at a vertex.
    """

    leaves_edges: ClassVar[bool] = True
    arms: int = 6
    max_edges: int = 24

    def remove(self, graph: PoseGraph, vertex: int, lasting: Collection[int]) -> None:
        """Remove a vertex; see Marginalisation."""
        star = _Star.around(graph, vertex)
        graph.remove_vertex(vertex)
        strongest = np.argsort(-star.shares, kind="stable")[: self.arms].tolist()
        strong = [i for i in strongest if star.shares[i] >= _WEAK]
        edges = _mesh(star.subset(strong))
        edges += [star.chained(i, j) for i, j in _chains(star, strong, lasting)]
        for edge in edges:
            if edge.source != edge.target:
                _add_fused(graph, edge)
        for end in {arm.target for arm in star.arms}:
            _drop_least_worth(graph, end, self.max_edges)


@dataclass(frozen=True, slots=True)
class ChowLiu:
    """The tree among the neighbours that is nearest to the Schur complement.

    Kretzschmar and Stachniss, *Information-theoretic compression of pose graphs for laser-based SLAM*
    (IJRR 2012): of all trees, the one of most mutual information (Chow and Liu 1968); its edges have the
    relative covariances of the exact marginal, the optimum for a tree (Mazuran, Burgard and Tipaldi,
    *Nonlinear factor recovery for long-term SLAM*, IJRR 2016). An edge that comes of odometry alone
    remains odometry, all others are composed.
    """

    leaves_edges: ClassVar[bool] = True

    def remove(self, graph: PoseGraph, vertex: int, lasting: Collection[int]) -> None:
        """Remove a vertex; see Marginalisation."""
        star = _Star.around(graph, vertex)
        graph.remove_vertex(vertex)
        if len(star) < 2:
            return
        # Between the ends of two arms nothing but these arms says anything, so that the covariance
        # of the pair is their sum, and the most mutual information is the least of its determinant.
        covariances = star.covariances[:, None] + star.covariances[None]
        entropy = np.linalg.slogdet(covariances)[1]
        weights = np.triu(entropy - entropy.min() + 1.0, 1)
        tree = minimum_spanning_tree(weights).tocoo()
        for i, j in zip(tree.row.tolist(), tree.col.tolist(), strict=True):
            if star.arms[i].target != star.arms[j].target:
                _add_fused(graph, star.chained(i, j))


@dataclass(frozen=True, slots=True)
class Dense:
    """The Schur complement as it is: one factor over all neighbours, linearised for good."""

    leaves_edges: ClassVar[bool] = False

    def remove(self, graph: PoseGraph, vertex: int, lasting: Collection[int]) -> None:
        """Remove a vertex; see Marginalisation."""
        graph.marginalise_densely(vertex)


class _Star:
    """The edges that meet in a vertex, outward, with their errors in its frame."""

    def __init__(self, arms: list[Edge], residuals: Array) -> None:
        self.arms = arms
        self.residuals = residuals  # (n, 6): arm i ends at Exp(r_i) T_vertex_neighbour
        A = np.array([adjoint(arm.T_source_target) for arm in arms]).reshape(-1, 6, 6)
        covariances = np.array([arm.covariance for arm in arms]).reshape(-1, 6, 6)
        self.covariances = A @ covariances @ np.swapaxes(A, 1, 2)
        self.information = np.linalg.inv(self.covariances)
        # Share of each arm in all that is known about the vertex; they sum to 1.
        total = self.information.sum(0)
        self.shares = np.trace(np.linalg.solve(total, self.information), axis1=1, axis2=2) / 6

    @classmethod
    def around(cls, graph: PoseGraph, vertex: int) -> "_Star":
        """Return the star of a vertex, edges to one neighbour fused, odometry apart from the others."""
        arms = _parallel_fused(graph.incident(vertex), vertex)
        T_vertex_map = gtsam.Pose3(invert(graph.pose(vertex)))
        residuals = np.zeros((len(arms), 6))
        for i, arm in enumerate(arms):
            expected = T_vertex_map.compose(gtsam.Pose3(graph.pose(arm.target)))
            measured = gtsam.Pose3(arm.T_source_target)
            residuals[i] = gtsam.Pose3.Logmap(expected.compose(measured.inverse()))
        return cls(arms, residuals)

    def __len__(self) -> int:
        return len(self.arms)

    def subset(self, indices: list[int]) -> "_Star":
        """Return the star of some of the arms."""
        return _Star([self.arms[i] for i in indices], self.residuals[indices])

    def chained(self, i: int, j: int) -> Edge:
        """Return the edge from one neighbour through the vertex to another, both arms in full."""
        return chain(reverse(self.arms[i]), self.arms[j])

    def edge(self, i: int, j: int, covariance: Array, shift: Array | None = None) -> Edge:
        """Return an edge between two neighbours.

        Args:
            i: arm to the first.
            j: arm to the second.
            covariance: (6, 6) in the vertex's frame.
            shift: (6,) of the second neighbour against what the two arms measured, likewise.
        """
        first, second = self.arms[i], self.arms[j]
        outward = gtsam.Pose3(second.T_source_target)
        A = outward.inverse().AdjointMap()
        C = A @ covariance @ A.T
        motion = gtsam.Pose3(first.T_source_target).between(outward)
        if shift is not None:
            motion = motion.compose(gtsam.Pose3.Expmap(A @ shift))
        kind = chained_kind(first, second)
        return Edge(first.target, second.target, motion.matrix(), (C + C.T) / 2, kind)


def _parallel_fused(edges: list[Edge], vertex: int) -> list[Edge]:
    """Return the edges outward from a vertex, fused by neighbour and by whether they are odometry."""
    groups: dict[tuple[int, bool], list[Edge]] = defaultdict(list)
    for edge in edges:
        arm = outward(edge, vertex)
        groups[arm.target, arm.kind == "odometry"].append(arm)
    return [fuse(group) for group in groups.values()]


def _mesh(star: _Star) -> list[Edge]:
    """Return the edges between all pairs that the Schur complement of the star amounts to.

    L_i S^-1 L_j is symmetric where the two commute, as they do with two arms; otherwise its symmetric
    part is taken, in the frame whitened by S, and held positive.
    """
    if len(star) <= 2:
        return [star.chained(0, 1)] if len(star) == 2 else []
    eigenvalues, V = np.linalg.eigh(star.information.sum(0))
    whiten = (V / np.sqrt(eigenvalues)) @ V.T
    shares = whiten @ star.information @ whiten
    pairs = list(combinations(range(len(star)), 2))
    i, j = np.array(pairs).T
    products = shares[i] @ shares[j]
    worth, U = np.linalg.eigh((products + np.swapaxes(products, 1, 2)) / 2)
    worth = np.maximum(worth, _LEAST_EIGENVALUE * np.abs(worth).max(axis=1, keepdims=True))
    root = whiten @ U
    covariances = (root / worth[:, None]) @ np.swapaxes(root, 1, 2)
    # As many as there are neighbours but one: the star's own information, no more and no less, on
    # the average over what the star says.
    relative = star.covariances[i] + star.covariances[j]
    spent = np.trace(np.linalg.solve(covariances, relative), axis1=1, axis2=2).sum()
    covariances *= spent / (6 * (len(star) - 1))
    shifts = _equal_forces(star, i, j, np.linalg.inv(covariances))
    return [star.edge(*pair, C, d) for pair, C, d in zip(pairs, covariances, shifts, strict=True)]


def _equal_forces(star: _Star, i: Indices, j: Indices, information: Array) -> Array:
    """Return the (K, 6) shifts of edges i -> j with which they pull as the star does.

    At the optimum the arms' forces L_i r_i on the neighbours are in balance with the rest of the graph.
    Edges with residuals u_j - u_i exert the same where u solves sum_j W_ij (u_i - u_j) = L_i r_i; were
    the mesh exact, u would be r, and the mesh would cost what the star does. Where it is so far from
    exact that it would cost much more there is no shift: from one removal to the next such costs would
    grow without end.
    """
    count = len(star)
    r = star.residuals
    total = star.information.sum(0)
    r = r - np.linalg.solve(total, np.einsum("nij,nj->i", star.information, r))
    ends = np.eye(count)[i] - np.eye(count)[j]  # (K, n) +1 where an edge begins, -1 where it ends
    laplacian = np.tensordot(ends[:, :, None] * ends[:, None], information, (0, 0)).swapaxes(1, 2)
    forces = np.einsum("nij,nj->ni", star.information, r)
    u = np.zeros((count, 6))
    size = 6 * (count - 1)
    inner = laplacian[1:, :, 1:].reshape(size, size)
    u[1:] = np.linalg.solve(inner, forces[1:].ravel()).reshape(-1, 6)
    plain, pulled = r[j] - r[i], u[j] - u[i]
    cost = np.einsum("ki,kij,kj", pulled, information, pulled)
    most = _MAX_COST * np.einsum("ni,nij,nj", r, star.information, r)
    if cost > most or np.linalg.norm(pulled[:, :3], axis=1).max() > _MAX_ANGLE:
        return np.zeros_like(plain)
    shifts: Array = plain - pulled
    return shifts


def _chains(star: _Star, strong: list[int], lasting: Collection[int]) -> list[tuple[int, int]]:
    """Return each weak arm with the one that it is chained to.

    Odometry goes with odometry, any other arm with the strongest that ends at a lasting vertex.
    """
    stay = [i for i in strong if star.arms[i].target in lasting]
    hub = max(stay or strong, key=lambda i: float(star.shares[i]))
    odometry = [i for i, arm in enumerate(star.arms) if arm.kind == "odometry"]
    pairs = set()
    for i in set(range(len(star))) - set(strong):
        path = [j for j in odometry if j != i] if i in odometry else []
        pairs |= {(min(i, j), max(i, j)) for j in path or [hub]}
    return sorted(pairs)


def _add_fused(graph: PoseGraph, edge: Edge) -> None:
    """Add an edge, fused with what the graph has between the same vertices, odometry with odometry."""
    odometry = edge.kind == "odometry"
    between = graph.between(edge.source, edge.target)
    parallel = [e for e in between if (e.kind == "odometry") == odometry]
    for other in parallel:
        graph.remove_edge(other)
    graph.add_edge(fuse([*parallel, edge]), derived=True)


def _drop_least_worth(graph: PoseGraph, vertex: int, max_edges: int) -> None:
    """Drop loop closures and composed edges from a vertex that has too many edges.

    The worth of an edge is the variance of the best way round over a third vertex relative to its own.
    """
    edges = graph.incident(vertex)
    excess = len(edges) - max_edges
    if excess <= 0:
        return
    direct = _variances(edges, vertex)
    worth = []
    for edge in edges:
        end = edge.target if edge.source == vertex else edge.source
        onward = _variances(graph.incident(end), end)
        ways = [direct[k] + onward[k] for k in direct.keys() & onward.keys()]
        own = float(np.trace(edge.covariance[3:, 3:]))
        worth.append(np.inf if edge.kind == "odometry" else min(ways, default=np.inf) / own)
    for i in np.argsort(worth, kind="stable")[:excess]:
        if np.isfinite(worth[i]):
            graph.remove_edge(edges[i])


def _variances(edges: list[Edge], vertex: int) -> dict[int, float]:
    """Return the least variance of position, m^2, of the edges from a vertex by their other end."""
    variances: dict[int, float] = {}
    for edge in edges:
        end = edge.target if edge.source == vertex else edge.source
        variance = float(np.trace(edge.covariance[3:, 3:]))
        variances[end] = min(variance, variances.get(end, np.inf))
    return variances
