"""The least-squares problem that a choice of loop closures leaves, condensed to what closures touch.

Vertices that only link two trusted edges of a chain are eliminated by composing the two, to first order
(edges.py): a chain between two closures becomes one edge, whatever its length. Graphs whose vertices lie
in a plane are solved as such, with three degrees of freedom a vertex.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from lifelong_slam.geometry import exp, invert, log
from lifelong_slam.graph.edges import chain, outward, reverse
from lifelong_slam.graph.initialisation import chordal, components
from lifelong_slam.result import Edge, GraphSnapshot

Array = NDArray[np.float64]

_PLANAR = np.ix_([3, 4, 2], [3, 4, 2])  # x, y and yaw in the order of Pose3's tangent vector
_FREE_ROTATION = 10.0  # rad: what only closures tie to the rest may be turned any way,
_FREE_TRANSLATION = 10.0  # and be anywhere: extents of the map
_ANCHOR_SIGMA = 1e-6  # rad and m
_GLANCE = 5  # steps from a start
_ITERATIONS = 12  # of an optimisation at most; the search goes on from there
_DRAWS = 64  # that covariances are estimated from: to a sixth
_TOLERANCE = 1e-5  # relative change of the error at which an optimisation ends


@dataclass(frozen=True, slots=True)
class Trusted:
    """What a vote takes for granted.

    Attributes:
        edges: odometry, and what was measured otherwise without the chance to be wrong.
        anchors: vertices that stay where they are.
        factors: over Pose3 values, with the vertices that they concern: priors, dense marginals.
    """

    edges: Sequence[Edge]
    anchors: Collection[int]
    factors: Sequence[gtsam.NonlinearFactor] = field(default_factory=list)


class ClosureProblem:
    """Trusted edges, and closures that may be taken or left.

    Attributes:
        dof: degrees of freedom of a vertex, 3 or 6.
        measured: every closure is one measurement, none is composed of several.
    """

    def __init__(
        self,
        poses: Mapping[int, Array],
        trusted: Trusted,
        closures: Sequence[Edge],
        planar: bool,
    ) -> None:
        """Condense.

        Args:
            poses: (4, 4) T_map_vertex; only those of anchors, and of parts that closures alone tie to
                the rest, matter to the outcome.
            trusted: what is taken for granted.
            closures: in the order of all arrays over closures.
            planar: all poses lie in a plane, and only what lies in it is measured.
        """
        self.dof = 3 if planar else 6
        self.measured = all(edge.kind == "loop" for edge in closures)
        self._planar = planar and not trusted.factors
        self._width = 3 if self._planar else 6
        self._closures = closures
        self._ends = [(edge.source, edge.target) for edge in closures]
        needed = {vertex for ends in self._ends for vertex in ends} | set(trusted.anchors)
        needed |= {vertex for factor in trusted.factors for vertex in factor.keys()}  # noqa: SIM118
        self._chains = _condense(trusted.edges, needed)
        self._links = [
            way.link for way in self._chains if way.link and way.source != way.link.target
        ]
        self._factors = [self._between(edge) for edge in closures]
        self._trusted = gtsam.NonlinearFactorGraph()
        for factor in [*map(self._between, self._links), *trusted.factors]:
            self._trusted.push_back(factor)
        self.vertices = sorted(needed.union(*({link.source, link.target} for link in self._links)))
        self._held = sorted(trusted.anchors)
        self._hold(poses, trusted)

    def __len__(self) -> int:
        return len(self._closures)

    def values(self, poses: Mapping[int, Array]) -> gtsam.Values:
        """Return the given poses of the vertices that are left."""
        values = gtsam.Values()
        for vertex in self.vertices:
            values.insert(
                vertex, _pose2(poses[vertex]) if self._planar else gtsam.Pose3(poses[vertex])
            )
        return values

    def chained(self, poses: Mapping[int, Array]) -> gtsam.Values:
        """Return the poses that trusted edges lead to, from anchors, else from one vertex of each part.

        Args:
            poses: (4, 4) T_map_vertex of the vertices to begin with, and of those that no edge leads to.
        """
        ends: dict[int, list[Edge]] = {vertex: [] for vertex in self.vertices}
        for link in self._links:
            ends[link.source].append(link)
            ends[link.target].append(reverse(link))
        placed = {vertex: poses[vertex] for vertex in self._held}
        for first in [*self._held, *self.vertices]:
            placed.setdefault(first, poses[first])
            front = [first]
            while front:
                vertex = front.pop()
                for link in ends[vertex]:
                    if link.target not in placed:
                        placed[link.target] = placed[vertex] @ link.T_source_target
                        front.append(link.target)
        return self.values(placed)

    def relaxed(self, accepted: Iterable[int], values: gtsam.Values) -> gtsam.Values:
        """Return the poses of the chordal relaxation with some closures, by index, which needs no start.

        Args:
            accepted: closures.
            values: poses, of which each part's lowest vertex keeps its own.
        """
        edges = [*self._links, *(self._closures[k] for k in sorted(accepted))]
        return self.values(chordal(GraphSnapshot(self._at_ends(values), edges)))

    def _at_ends(self, values: gtsam.Values) -> dict[int, Array]:
        """Return the (4, 4) poses of the vertices that are left."""
        at = values.atPose2 if self._planar else values.atPose3
        return {vertex: _matrix(at(vertex)) for vertex in self.vertices}

    def poses(self, values: gtsam.Values) -> dict[int, Array]:
        """Return (4, 4) poses of all vertices that trusted edges or closures reach.

        What was measured along a chain is fitted between its ends, the error spread evenly.
        """
        poses = self._at_ends(values)
        for way in self._chains:
            poses |= way.between(poses)
        return poses

    def glance(self, accepted: Iterable[int], start: gtsam.Values) -> tuple[gtsam.Values, float]:
        """Return where a few undamped steps lead with some closures, and chi-square there.

        From a good start that is near the optimum already. Where the closures contradict each other it is
        nowhere, but an optimisation would take many times as long to tell.
        """
        params = gtsam.GaussNewtonParams()
        params.setMaxIterations(_GLANCE)
        optimiser = gtsam.GaussNewtonOptimizer(self._graph(accepted), start, params)
        try:
            values = optimiser.optimize()
        except RuntimeError:  # the system has become singular
            return start, 2 * float(self._graph(accepted).error(start))
        return values, 2 * float(optimiser.error())

    def solve(self, accepted: Iterable[int], start: gtsam.Values) -> tuple[gtsam.Values, float]:
        """Return the optimum with some closures, by index, and its chi-square."""
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(_ITERATIONS)
        params.setRelativeErrorTol(_TOLERANCE)
        optimiser = gtsam.LevenbergMarquardtOptimizer(self._graph(accepted), start, params)
        values = optimiser.optimize()
        return values, 2 * float(optimiser.error())

    def linearise(self, accepted: Iterable[int], values: gtsam.Values) -> "Linearised":
        """Return what small changes of the choice of closures would do at an optimum."""
        width = self._width
        free = ~np.isin(self.vertices, self._held)
        place = np.where(np.repeat(free, width), np.cumsum(np.repeat(free, width)) - 1, -1)
        rows, columns, entries = np.asarray(
            self._graph(accepted).linearize(values).sparseJacobian_()
        )
        rows, columns = rows.astype(int) - 1, columns.astype(int) - 1
        kept = columns < len(place)  # the last column is the residual
        kept[kept] = place[columns[kept]] >= 0
        J = scipy.sparse.csc_array(
            (entries[kept], (rows[kept], place[columns[kept]])),
            shape=(rows.max() + 1, np.count_nonzero(free) * width),
        )
        blocks = [factor.linearize(values).jacobian() for factor in self._factors]
        first = np.searchsorted(self.vertices, self._ends) * width
        return Linearised(
            J,
            A=np.array([A for A, _ in blocks]),
            b=np.array([b for _, b in blocks]),
            columns=place[first[:, :, None] + np.arange(width)].reshape(len(self), -1),
        )

    def _graph(self, accepted: Iterable[int]) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph(self._trusted)
        for k in sorted(accepted):
            graph.push_back(self._factors[k])
        return graph

    def _hold(self, poses: Mapping[int, Array], trusted: Trusted) -> None:
        """Hold the anchors, and loosely each part that nothing trusted ties to them."""
        extent = np.ptp([T[:3, 3] for T in poses.values()], axis=0).max()
        free = (_FREE_ROTATION, _FREE_TRANSLATION * max(float(extent), 1.0))
        for vertex in self._held:
            self._trusted.push_back(self._prior(vertex, poses[vertex], (_ANCHOR_SIGMA,) * 2))
        ties = [(link.source, link.target) for link in self._links]
        ties += [(f.keys()[0], v) for f in trusted.factors for v in f.keys()[1:]]
        tied = {v for f in trusted.factors for v in f.keys()[:1] if len(f.keys()) == 1}
        for part in components(self.vertices, ties):
            if not part & (set(self._held) | tied):
                vertex = min(part)
                self._trusted.push_back(self._prior(vertex, poses[vertex], free))

    def _between(self, edge: Edge) -> gtsam.NonlinearFactor:
        i, j, T = edge.source, edge.target, edge.T_source_target
        if self._planar:
            noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance[_PLANAR])
            return gtsam.BetweenFactorPose2(i, j, _pose2(T), noise)
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        return gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(T), noise)

    def _prior(self, vertex: int, T: Array, sigmas: tuple[float, float]) -> gtsam.NonlinearFactor:
        rotation, translation = sigmas
        if self._planar:
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([translation, translation, rotation]))
            return gtsam.PriorFactorPose2(vertex, _pose2(T), noise)
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([rotation, translation], 3))
        return gtsam.PriorFactorPose3(vertex, gtsam.Pose3(T), noise)


class Linearised:
    """A problem around an optimum: what one factorisation tells of all its closures.

    The prediction of a closure is what all that is in use says about it. Residuals and covariances are
    whitened by the closure's own covariance.

    Attributes:
        residuals: (K, d), by closure.
    """

    def __init__(
        self, J: scipy.sparse.csc_array, A: Array, b: Array, columns: NDArray[np.int64]
    ) -> None:
        """Factorise.

        Args:
            J: (R, C) whitened Jacobian of all that is in use.
            A: (K, d, 2d) whitened Jacobians of all closures, in use or not.
            b: (K, d) their residuals.
            columns: (K, 2d) of the system that the columns of A belong to; -1 for what is held.
        """
        self.residuals = b
        self._A, self._J = A, J
        self._columns = columns
        # Where all vertices are held there is nothing to solve for.
        self._lu = J.shape[1] and splu(
            scipy.sparse.csc_matrix(J.T @ J),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    @cached_property
    def sampled_spread(self) -> Array:
        """(K, d, d) covariances of all predictions, estimated from random draws: a quick look."""
        noise = np.random.default_rng(0).normal(size=(self._J.shape[0], _DRAWS))
        draws = self._predictions(np.arange(len(self._A)), self._solve(self._J.T @ noise))
        spread: Array = draws @ np.swapaxes(draws, 1, 2) / _DRAWS
        return spread

    def joint_spread(self, closures: NDArray[np.int64]) -> Array:
        """Return the (n, n, d, d) covariances among the predictions of closures."""
        n, d, _ = self._A[closures].shape
        right = np.zeros((self._J.shape[1] + 1, n, d))
        for i, k in enumerate(closures):
            right[self._columns[k], i] = self._A[k].T
        solved = self._solve(right[:-1].reshape(-1, n * d))
        return self._predictions(closures, solved).reshape(n, d, n, d).swapaxes(1, 2)

    def spread(self, closures: NDArray[np.int64]) -> Array:
        """Return the (n, d, d) covariances of the predictions of closures."""
        joint = self.joint_spread(closures)
        own: Array = joint[np.arange(len(joint)), np.arange(len(joint))]
        return own

    def _solve(self, right: Array) -> Array:
        """Return the (C, m) solutions for (C, m) right-hand sides."""
        solution: Array = self._lu.solve(right) if self._lu else right
        return solution

    def _predictions(self, closures: NDArray[np.int64], changes: Array) -> Array:
        """Return (n, d, m) whitened changes of closures' predictions with (C, m) changes of the poses."""
        held = np.zeros((1, changes.shape[1]))
        changed: Array = np.vstack([changes, held])[self._columns[closures]]
        return np.asarray(self._A[closures] @ changed)


@dataclass(frozen=True, slots=True)
class _Chain:
    """Successive trusted edges.

    Attributes:
        source: where it begins.
        link: what it says about its ends; None if it leads to no vertex that matters.
        passed: the vertices on its way with their (4, 4) T_source_vertex.
    """

    source: int
    link: Edge | None
    passed: list[tuple[int, Array]]

    def between(self, poses: Mapping[int, Array]) -> dict[int, Array]:
        """Return the (4, 4) poses of the vertices on its way, given those of its ends."""
        if not self.passed:
            return {}
        vertices, T_source_vertex = zip(*self.passed, strict=True)
        T = poses[self.source] @ np.array(T_source_vertex)
        if self.link is not None:
            reached = poses[self.source] @ self.link.T_source_target
            miss = log(poses[self.link.target] @ invert(reached))
            share = np.arange(1, len(T) + 1) / (len(T) + 1)
            T = exp(share[:, None] * miss) @ T
        return dict(zip(vertices, T, strict=True))


def _condense(edges: Sequence[Edge], needed: Collection[int]) -> list[_Chain]:
    """Return the chains between needed vertices and joints, and those that lead from there to an end."""
    at: dict[int, list[Edge]] = {}
    for edge in edges:
        at.setdefault(edge.source, []).append(edge)
        at.setdefault(edge.target, []).append(edge)
    kept = set(needed) | {vertex for vertex, meeting in at.items() if len(meeting) > 2}
    walked: set[int] = set()  # edges, by identity
    chains = []
    for vertex in sorted(kept & at.keys()):
        for edge in at[vertex]:
            if id(edge) not in walked:
                chains.append(_follow(vertex, edge, at, kept, walked))
    return chains


def _follow(
    vertex: int, edge: Edge, at: Mapping[int, list[Edge]], kept: Collection[int], walked: set[int]
) -> _Chain:
    """Return the chain that begins with an edge of a vertex."""
    walked.add(id(edge))
    link, passed = outward(edge, vertex), []
    while link.target not in kept:
        passed.append((link.target, link.T_source_target))
        onward = [e for e in at[link.target] if id(e) not in walked]
        if not onward:
            return _Chain(vertex, None, passed)
        walked.add(id(onward[0]))
        link = chain(link, outward(onward[0], link.target))
    return _Chain(vertex, link, passed)


def _pose2(T: Array) -> gtsam.Pose2:
    return gtsam.Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))


def _matrix(pose: gtsam.Pose2 | gtsam.Pose3) -> Array:
    """Return a pose as (4, 4)."""
    if isinstance(pose, gtsam.Pose3):
        return np.asarray(pose.matrix())
    T = np.eye(4)
    T[:2, :2] = pose.rotation().matrix()
    T[:2, 3] = pose.x(), pose.y()
    return T
