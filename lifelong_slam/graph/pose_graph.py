"""A pose graph over keyframes, optimised by GTSAM, that no wrong loop closure bends.

Odometry edges are trusted, loop closures are not. A new one that fits comes in at once; when one doesn't,
it is decided by a vote which of all closures are true (robust.py), those rejected before among them.

Vertices can be removed: what their edges said is then put in by whoever removes them (marginalisation.py).
A graph may have several components, one for each session that hasn't been located in the map; each is
held by its root, the vertex that was added without an edge. In graphs from files, fixed vertices and
priors hold theirs instead.
"""

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from copy import copy
from typing import Self

import gtsam
import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import invert
from lifelong_slam.graph.closure_problem import ClosureProblem, Trusted
from lifelong_slam.graph.robust import Start, doubt_about, fitted, objective, threshold, vote
from lifelong_slam.result import Edge, GraphSnapshot, Prior

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

_NEWS = 0.2  # metres; less doesn't mislead the search for loop closures
_GAUGE_SIGMA = 1e-6  # m and rad; the root defines the frame


class PoseGraph:
    """Vertices with poses, and what was measured between them."""

    def __init__(self, planar: bool = False, trust_closures: bool = False) -> None:
        """Start empty.

        Args:
            planar: all poses lie in a plane, and only what lies in it is measured.
            trust_closures: no loop closure is ever rejected.
        """
        self._planar = planar
        self._trust_closures = trust_closures
        self._values = gtsam.Values()
        self._roots: list[int] = []
        self._fixed: list[int] = []
        self._priors: dict[int, Prior] = {}  # by the key of their factor
        self._parted = False  # loop closures hold components together, which may fall apart
        self._incident: dict[int, set[int]] = {}  # keys of factors by vertex
        self._factors: dict[int, gtsam.NonlinearFactor] = {}
        self._edges: dict[int, Edge] = {}  # keys as above; factors over many vertices aren't edges
        self._loops: set[int] = set()
        self._rejected: set[int] = set()
        self._new: set[int] = set()  # loop closures since the last optimisation
        self._is_optimal = True  # as far as the edges in use go
        self._next_key = 0

    def __len__(self) -> int:
        return len(self._incident)

    def __contains__(self, vertex: int) -> bool:
        return vertex in self._incident

    @property
    def vertices(self) -> list[int]:
        """Vertices in the order in which they were added."""
        return list(self._incident)

    @property
    def roots(self) -> list[int]:
        """Vertices that hold a component in place, oldest first."""
        return list(self._roots)

    @property
    def held(self) -> set[int]:
        """Vertices that hold the others in place: gauges, fixed ones, and those that have priors."""
        return {*self._gauges(), *self._roots, *(prior.vertex for prior in self._priors.values())}

    @property
    def edges(self) -> list[Edge]:
        """Edges in use: all odometry, and the loop closures that the last vote let in."""
        return [edge for key, edge in self._edges.items() if key not in self._rejected]

    def keyed_edges(self) -> dict[int, Edge]:
        """Return all edges by a key that stays theirs, rejected ones among them."""
        return dict(self._edges)

    @property
    def rejected_keys(self) -> frozenset[int]:
        """Keys of the loop closures that are rejected."""
        return frozenset(self._rejected)

    @property
    def edge_count(self) -> int:
        """Number of edges in use, factors over many vertices included."""
        return len(self._factors) - len(self._priors) - len(self._rejected)

    @property
    def rejected(self) -> list[Edge]:
        """Loop closures that the last vote left out."""
        return [self._edges[key] for key in sorted(self._rejected)]

    @property
    def doubt(self) -> str | None:
        """What to say of a vote that left out more than half of the closures."""
        return doubt_about(len(self._rejected), len(self._loops))

    def pose(self, vertex: int) -> Array:
        """Return the current (4, 4) T_map_vertex."""
        return np.asarray(self._values.atPose3(vertex).matrix())

    def poses(self) -> dict[int, Array]:
        """Return all current (4, 4) T_map_vertex by vertex."""
        return {vertex: self.pose(vertex) for vertex in self._incident}

    def snapshot(self) -> GraphSnapshot:
        """Return a copy of the graph as it stands."""
        priors = tuple(self._priors.values())
        fixed = tuple(self._fixed)
        return GraphSnapshot(self.poses(), self.edges, fixed, priors, self._planar)

    def restore(
        self,
        poses: Mapping[int, Array],
        edges: Mapping[int, Edge],
        rejected: Collection[int] = (),
        solved: bool = True,
        fixed: Iterable[int] = (),
        priors: Iterable[Prior] = (),
    ) -> None:
        """Fill an empty graph with a whole one.

        A component hangs on its fixed vertices and priors; one that has neither hangs on its lowest vertex.

        Args:
            poses: (4, 4) T_map_vertex.
            edges: by key, rejected ones among them.
            rejected: keys of the loop closures that are rejected.
            solved: the poses are the optimum of the others; else closures have yet to be accepted.
            fixed: vertices that keep their poses.
            priors: of vertices; trusted as odometry is.
        """
        for vertex in sorted(poses):
            self._insert(vertex, poses[vertex])
        for key in sorted(edges):
            self._next_key = key
            self.add_edge(edges[key], derived=solved)
        self._fixed = list(fixed)
        for prior in priors:
            self._add_prior(prior)
        self._rejected = set(rejected)
        self._parted = True
        self._roots = self._gauges()

    def incident(self, vertex: int) -> list[Edge]:
        """Return the edges in use that meet in a vertex, in the order in which they were added."""
        keys = sorted(self._incident[vertex] - self._rejected)
        return [self._edges[key] for key in keys if key in self._edges]

    def between(self, first: int, second: int) -> list[Edge]:
        """Return the edges in use between two vertices."""
        keys = sorted((self._incident[first] & self._incident[second]) - self._rejected)
        return [self._edges[key] for key in keys if key in self._edges]

    def add_vertex(self, vertex: int, T_map_vertex: Array) -> None:
        """Add a vertex that no edge leads to: the first of a session, where its frame begins."""
        self._insert(vertex, T_map_vertex)
        self._roots.append(vertex)

    def add_odometry(self, edge: Edge) -> None:
        """Add a vertex at the end of a measured motion from an existing one, and the motion."""
        self._insert(edge.target, self.pose(edge.source) @ edge.T_source_target)
        self.add_edge(edge)

    def add_edge(self, edge: Edge, derived: bool = False) -> None:
        """Add a measurement between two vertices that are there already.

        Args:
            edge: the measurement.
            derived: it says what edges that were in use said, and isn't news to the poses.
        """
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        measurement = gtsam.Pose3(edge.T_source_target)
        key = self._add(
            gtsam.BetweenFactorPose3(edge.source, edge.target, measurement, noise),
            (edge.source, edge.target),
        )
        self._edges[key] = edge
        if edge.kind != "odometry":
            self._loops.add(key)
            if not derived:
                self._new.add(key)

    def remove_edge(self, edge: Edge) -> None:
        """Forget a measurement."""
        for key in self._incident[edge.source] & self._incident[edge.target]:
            if self._edges.get(key) is edge:
                self._forget(key)
                return
        raise KeyError(f"no such edge: {edge.source} -> {edge.target}")

    def remove_vertex(self, vertex: int) -> list[Edge]:
        """Forget a vertex and all edges that meet in it, and return those.

        Raises:
            ValueError: the vertex is a root, is fixed or has a prior: without it others have no place.
        """
        if vertex in self._roots or vertex in self._fixed or self._has_prior(vertex):
            raise ValueError(f"vertex {vertex} holds its component in place")
        edges = [self._edges[key] for key in sorted(self._incident[vertex]) if key in self._edges]
        for key in list(self._incident[vertex]):
            self._forget(key)
        del self._incident[vertex]
        self._values.erase(vertex)
        return edges

    def conditional(self, vertex: int) -> tuple[list[int], Array]:
        """Return how a vertex follows its neighbours, to first order at the current estimate.

        Returns:
            The k neighbours, and (k, 6, 6) gains: where these move by Exp(d_i) on their right, the
            optimum of the vertex moves by Exp(sum over i of gain_i d_i).
        """
        local = gtsam.NonlinearFactorGraph()
        for key in sorted(self._incident[vertex] - self._rejected):
            local.push_back(self._factors[key])
        neighbours = [v for v in sorted(local.keyVector()) if v != vertex]
        ordering = gtsam.Ordering()
        for v in (vertex, *neighbours):
            ordering.push_back(v)
        H, _ = local.linearize(self._values).hessian(ordering)
        gains = -np.linalg.solve(H[:6, :6], H[:6, 6:]).astype(np.float64)
        return neighbours, gains.reshape(6, -1, 6).swapaxes(0, 1)

    def marginalise_densely(self, vertex: int) -> None:
        """Remove a vertex; its Schur complement stays as one factor over all its neighbours.

        The factor is linearised at the current estimate, for good.
        """
        local = gtsam.NonlinearFactorGraph()
        keys = sorted(self._incident[vertex] - self._rejected)
        for key in keys:
            local.push_back(self._factors[key])
        ordering = gtsam.Ordering()
        ordering.push_back(vertex)
        _, marginal = local.linearize(self._values).eliminatePartialSequential(ordering)
        around = {v for key in keys for v in _vertices(self._factors[key])} - {vertex}
        factors = [
            gtsam.LinearContainerFactor(marginal.at(i), self._values)
            for i in range(marginal.size())
        ]
        self.remove_vertex(vertex)
        for factor in factors:
            self._add(factor, around)

    def component(self, vertex: int) -> Set[int]:
        """Return all vertices that edges in use connect with a vertex, itself included."""
        if len(self._roots) == 1 and not self._parted:
            return self._incident.keys()
        seen, front = {vertex}, [vertex]
        while front:
            for key in self._incident[front.pop()] - self._rejected:
                for other in _vertices(self._factors[key]):
                    if other not in seen:
                        seen.add(other)
                        front.append(other)
        return seen

    def join(self, edge: Edge) -> None:
        """Add the loop closure that locates one component in the other.

        The one with the younger root is moved, as a whole, to where the closure puts it.
        """
        moved = self.component(edge.target)
        shift = self.pose(edge.source) @ edge.T_source_target @ invert(self.pose(edge.target))
        other = self.component(edge.source)
        if self._age(moved) < self._age(other):
            moved, shift = other, invert(shift)
        self._move(moved, shift)
        self._roots = [root for root in self._roots if root not in moved]
        self._parted = True
        self.add_edge(edge)

    def _move(self, component: Set[int], shift: Array) -> None:
        """Move vertices as a whole."""
        if not np.allclose(shift, np.eye(4), rtol=0, atol=1e-12):
            for vertex in component:
                self._values.update(vertex, gtsam.Pose3(shift @ self.pose(vertex)))

    def _age(self, component: Set[int]) -> int:
        """Return the rank of a component's root among the roots, the oldest first."""
        ranks = (i for i, root in enumerate(self._roots) if root in component)
        return next(ranks, len(self._roots))

    def is_news(self, edge: Edge) -> bool:
        """Tell whether a measurement misses the current estimate by so much that it can't wait."""
        expected = invert(self.pose(edge.source)) @ self.pose(edge.target)
        return bool(np.linalg.norm((expected - edge.T_source_target)[:3, 3]) > _NEWS)

    def chi_square(self, poses: Mapping[int, Array] | None = None) -> float:
        """Return the sum of squared Mahalanobis distances of all edges in use.

        Args:
            poses: (4, 4) T_map_vertex of all vertices, if not the current ones.
        """
        if poses is None:
            return self._cost(self._loops - self._rejected)
        values = gtsam.Values()
        for vertex in self._incident:
            values.insert(vertex, gtsam.Pose3(poses[vertex]))
        return 2 * float(self._nonlinear_graph(self._loops - self._rejected).error(values))

    def marginal_information(self, vertices: Sequence[int]) -> Array:
        """Return the (n, 6, 6) inverse marginal covariances of vertices, relative to their roots.

        They are of the perturbation on the right of T_map_vertex, at the current estimate.
        """
        graph = self._nonlinear_graph(self._loops - self._rejected)
        marginals = gtsam.Marginals(graph, self._values)
        information = [marginals.marginalInformation(vertex) for vertex in vertices]
        return np.array(information).reshape(-1, 6, 6)

    def checkpoint(self) -> Self:
        """Return a copy, which what happens to this graph leaves as it is."""
        twin = copy(self)
        twin._values = gtsam.Values(self._values)
        twin._incident = {vertex: set(keys) for vertex, keys in self._incident.items()}
        for name in ("_roots", "_factors", "_edges", "_loops", "_rejected", "_new"):
            setattr(twin, name, copy(getattr(self, name)))
        return twin

    def rollback(self, checkpoint: Self) -> None:
        """Become again what a copy of this graph has kept."""
        self.__dict__.update(checkpoint.checkpoint().__dict__)

    def relax(self) -> None:
        """Find the poses that fit the edges in use best; none is put to the vote."""
        if self._is_optimal:
            return
        graph = self._nonlinear_graph(self._loops - self._rejected)
        self._values = gtsam.LevenbergMarquardtOptimizer(graph, self._values, _lm()).optimize()
        self._is_optimal = True

    def optimise(self, reconsider: bool = False) -> None:
        """Find the poses that fit the edges best, and which loop closures are true.

        Args:
            reconsider: vote on all loop closures if any is rejected; otherwise they vote only when a
                new one doesn't fit.
        """
        new = self._new - self._rejected
        established = self._loops - self._rejected - new
        before = self._values
        if not (reconsider and self._rejected) and self._accept(new, established):
            return
        self._values = before
        self._vote(established, thorough=reconsider or not established)

    def _accept(self, new: set[int], established: set[int]) -> bool:
        """Solve with new loop closures, and tell whether all of them fit."""
        # What the new closures cost all edges together: a lone one that is wrong bends a long chain
        # of odometry without any single edge, itself included, standing out.
        used = established | new
        if not new:
            self._solve(used)
            return True
        if not established:
            return False
        before = self._cost(established)
        after = self._solve(used)
        limit = threshold(self._dof)
        fits = all(2 * self._factors[key].error(self._values) <= limit for key in used)
        return (
            fits
            and after - before <= threshold(self._dof * len(new))
            and self._gains(before, after, len(established), len(new))
        )

    def _gains(self, before: float, after: float, established: int, new: int) -> bool:
        """Tell whether the vote's objective is less with new closures than without."""
        scaled = all(self._edges[key].kind == "loop" for key in self._loops)
        accepted = np.array([established, established + new])
        rejected = len(self._rejected) + np.array([new, 0])
        without, with_new = objective(
            np.array([before, after]), accepted, rejected, self._dof, scaled
        )
        return bool(with_new < without)

    @property
    def _dof(self) -> int:
        return 3 if self._planar else 6

    def _insert(self, vertex: int, T_map_vertex: Array) -> None:
        self._values.insert(vertex, gtsam.Pose3(T_map_vertex))
        self._incident[vertex] = set()

    def _add(self, factor: gtsam.NonlinearFactor, vertices: Iterable[int]) -> int:
        key = self._next_key
        self._next_key += 1
        self._is_optimal = False
        self._factors[key] = factor
        for vertex in vertices:
            self._incident[vertex].add(key)
        return key

    def _add_prior(self, prior: Prior) -> None:
        noise = gtsam.noiseModel.Gaussian.Covariance(prior.covariance)
        measured = gtsam.Pose3(prior.T_map_vertex)
        factor = gtsam.PriorFactorPose3(prior.vertex, measured, noise)
        self._priors[self._add(factor, (prior.vertex,))] = prior

    def _has_prior(self, vertex: int) -> bool:
        return any(prior.vertex == vertex for prior in self._priors.values())

    def _forget(self, key: int) -> None:
        self._is_optimal = False
        for vertex in _vertices(self._factors.pop(key)):
            self._incident[vertex].discard(key)
        self._edges.pop(key, None)
        for keys in (self._loops, self._rejected, self._new):
            keys.discard(key)

    def _vote(self, established: set[int], thorough: bool) -> None:
        """Decide which loop closures are in, and solve with them.

        Args:
            established: those that are in now.
            thorough: don't only go on from these, but also from none and from all of them.
        """
        keys = sorted(self._loops)
        poses = self.poses()
        problem = ClosureProblem(
            poses,
            Trusted(
                [edge for key, edge in self._edges.items() if key not in self._loops],
                self._roots,
                [factor for key, factor in self._factors.items() if key not in self._edges],
            ),
            [self._edges[key] for key in keys],
            self._planar,
        )
        now = problem.values(poses)
        in_use = [i for i, key in enumerate(keys) if key in established]
        starts: list[Start] = [(in_use, now)]
        if thorough or self._trust_closures:
            every = range(len(keys))
            everything: list[Start] = [(every, now), (every, problem.relaxed(every, now))]
            starts = [((), problem.chained(poses)), *starts, *everything]
        choice = fitted(problem, everything) if self._trust_closures else vote(problem, starts)
        for vertex, T in problem.poses(choice.values).items():
            self._values.update(vertex, gtsam.Pose3(T))
        loops = {keys[i] for i in choice.accepted}
        self._rejected = self._loops - loops
        for root in self._gauges():
            self._move(self.component(root), poses[root] @ invert(self.pose(root)))
        self._solve(loops)
        logger.info("%d of %d loop closures are rejected", len(self._rejected), len(self._loops))

    def _cost(self, loops: set[int]) -> float:
        """Return the sum of squared Mahalanobis distances with the given loop closures."""
        return 2 * float(self._nonlinear_graph(loops).error(self._values))

    def _solve(self, loops: set[int]) -> float:
        """Run Levenberg-Marquardt with the given loop closures; return what they cost then."""
        graph = self._nonlinear_graph(loops)
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, self._values, _lm())
        self._values = optimiser.optimize()
        self._is_optimal = True
        self._new -= loops
        return 2 * float(optimiser.error())

    def _nonlinear_graph(self, loops: set[int]) -> gtsam.NonlinearFactorGraph:
        """Collect the gauges, all that is trusted and the given loop closures."""
        graph = gtsam.NonlinearFactorGraph()
        for root in self._gauges():
            gauge = gtsam.noiseModel.Isotropic.Sigma(6, _GAUGE_SIGMA)
            graph.push_back(gtsam.PriorFactorPose3(root, self._values.atPose3(root), gauge))
        for key, factor in self._factors.items():
            if key in loops or key not in self._loops:
                graph.push_back(factor)
        return graph

    def _gauges(self) -> list[int]:
        """Return the fixed vertices, and of each part without any or a prior what else holds it.

        That is the oldest root, or the oldest vertex where rejected closures have cut the part off.
        """
        if len(self._roots) == 1 and not self._parted:
            return self._roots
        gauges = list(self._fixed)
        placed: set[int] = set()
        for vertex in (*self._fixed, *(prior.vertex for prior in self._priors.values())):
            if vertex not in placed:
                placed |= self.component(vertex)
        for vertex in (*self._roots, *self._incident):
            if vertex not in placed:
                gauges.append(vertex)
                placed |= self.component(vertex)
        return gauges


def _vertices(factor: gtsam.NonlinearFactor) -> list[int]:
    vertices: list[int] = factor.keys()
    return vertices


def _lm() -> gtsam.LevenbergMarquardtParams:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(30)
    params.setRelativeErrorTol(1e-6)
    return params
