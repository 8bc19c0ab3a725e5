"""A pose graph over keyframes, optimised by GTSAM, that no single loop closure can bend.

Odometry edges are trusted. Loop closures are put to the vote by graduated non-convexity (Yang et al.,
*Graduated non-convexity for robust spatial perception*, RA-L 2020): it starts from the convex problem, in
which a true closure may move the map by metres, and sharpens until each closure is either in or out.
That costs several ordinary optimisations, so it is done only when a closure disagrees with the current
estimate; one that agrees is simply added.
"""

import logging

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lifelong_slam.geometry import invert, log
from lifelong_slam.result import Edge, GraphSnapshot

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

INLIER_PROBABILITY = 0.999  # share of true closures whose error lies below the threshold
_THRESHOLD = float(chi2.ppf(INLIER_PROBABILITY, 6))
_GAUGE_SIGMA = 1e-6  # m and rad; the first vertex defines the map frame


class PoseGraph:
    """Vertices with poses, and the measured edges between them."""

    def __init__(self) -> None:
        self._values = gtsam.Values()
        self._ids: list[int] = []
        self._edges: list[Edge] = []
        self._factors: list[gtsam.NonlinearFactor] = []
        self._rejected: set[int] = set()  # indices into edges
        self._solved: set[int] = set()  # loop closures that the current poses are the optimum of

    def __len__(self) -> int:
        return len(self._ids)

    @property
    def edges(self) -> list[Edge]:
        """Edges in use: all odometry, and the loop closures that the last vote let in."""
        return [edge for i, edge in enumerate(self._edges) if i not in self._rejected]

    @property
    def edge_count(self) -> int:
        """Number of edges in use."""
        return len(self._edges) - len(self._rejected)

    @property
    def rejected(self) -> list[Edge]:
        """Loop closures that the last vote left out."""
        return [self._edges[i] for i in sorted(self._rejected)]

    def pose(self, vertex: int) -> Array:
        """Return the current (4, 4) T_map_vertex."""
        return np.asarray(self._values.atPose3(vertex).matrix())

    def poses(self) -> dict[int, Array]:
        """Return all current (4, 4) T_map_vertex by vertex."""
        return {vertex: self.pose(vertex) for vertex in self._ids}

    def snapshot(self) -> GraphSnapshot:
        """Return a copy of the graph as it stands."""
        return GraphSnapshot(self.poses(), self.edges)

    def add_vertex(self, vertex: int, T_map_vertex: Array) -> None:
        """Add a vertex with its first guess."""
        self._values.insert(vertex, gtsam.Pose3(T_map_vertex))
        self._ids.append(vertex)

    def add_edge(self, edge: Edge) -> None:
        """Add a measurement between two vertices that are there already."""
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        measurement = gtsam.Pose3(edge.T_source_target)
        self._edges.append(edge)
        self._factors.append(gtsam.BetweenFactorPose3(edge.source, edge.target, measurement, noise))

    def add_odometry(self, edge: Edge) -> None:
        """Add a vertex at the end of a measured motion from an existing one, and the motion."""
        self.add_vertex(edge.target, self.pose(edge.source) @ edge.T_source_target)
        self.add_edge(edge)

    def disagreement(self, edge: Edge) -> float:
        """Return the squared Mahalanobis distance of an edge from the current estimate."""
        expected = invert(self.pose(edge.source)) @ self.pose(edge.target)
        error = log(invert(edge.T_source_target) @ expected)
        return float(error @ np.linalg.solve(edge.covariance, error))

    def agrees(self, edge: Edge) -> bool:
        """Tell whether an edge is as near to the current estimate as true edges are."""
        return self.disagreement(edge) <= _THRESHOLD

    def optimise(self, reconsider: bool = False) -> None:
        """Find the poses that fit the edges best.

        Args:
            reconsider: put all loop closures to the vote again, those outvoted before included;
                otherwise they vote only if one of those in use disagrees with the optimum.
        """
        loops = {i for i, edge in enumerate(self._edges) if edge.kind == "loop"}
        before, solved = self._values, self._solved - self._rejected
        if not (reconsider and self._rejected):
            used = loops - self._rejected
            # What the new closures cost all edges together: a lone one that is wrong bends a long
            # chain of odometry without any single edge, itself included, standing out.
            rise = -self._cost(solved)
            self._solve(used)
            rise += self._cost(used)
            undisputed = all(self.agrees(self._edges[i]) for i in used)
            if undisputed and rise <= _THRESHOLD * max(len(used - solved), 1):
                return
        self._vote(loops)
        self._solve(loops - self._rejected)
        self._choose(loops, before, solved)

    def _choose(self, loops: set[int], before: gtsam.Values, solved: set[int]) -> None:
        """Go back to the closures from before the vote where all edges together fit better so.

        Non-convexity is graduated by each closure's own residual, which a long chain of odometry can
        absorb; the truncated squares that the vote means to minimise also count what that costs.
        """
        voted, values, rejected = loops - self._rejected, self._values, self._rejected
        objective = self._cost(voted) + _THRESHOLD * len(rejected)
        self._values = before
        self._solve(solved)
        if self._cost(solved) + _THRESHOLD * len(loops - solved) < objective:
            self._rejected = loops - solved
            logger.info("%d of %d loop closures are outvoted", len(self._rejected), len(loops))
        else:
            self._values, self._rejected, self._solved = values, rejected, voted

    def _cost(self, loops: set[int]) -> float:
        """Return the sum of squared Mahalanobis distances with the given loop closures."""
        return 2 * float(self._nonlinear_graph(loops).error(self._values))

    def _solve(self, loops: set[int]) -> None:
        """Run Levenberg-Marquardt with the given loop closures."""
        graph = self._nonlinear_graph(loops)
        self._values = gtsam.LevenbergMarquardtOptimizer(graph, self._values, _lm()).optimize()
        self._solved = set(loops)

    def _vote(self, loops: set[int]) -> None:
        """Decide which loop closures are in by graduated non-convexity."""
        params = gtsam.GncLMParams(_lm())
        params.setLossType(gtsam.GncLossType.TLS)
        # Factor 0 is the gauge, and factor i + 1 is edge i, as all edges take part.
        params.setKnownInliers([0, *(i + 1 for i in range(len(self._edges)) if i not in loops)])
        optimiser = gtsam.GncLMOptimizer(self._nonlinear_graph(loops), self._values, params)
        optimiser.setInlierCostThresholdsAtProbability(INLIER_PROBABILITY)
        self._values = optimiser.optimize()
        weights = np.asarray(optimiser.getWeights())[1:]
        self._rejected = {i for i in loops if weights[i] < 0.5}
        logger.info("%d of %d loop closures are outvoted", len(self._rejected), len(loops))

    def _nonlinear_graph(self, loops: set[int]) -> gtsam.NonlinearFactorGraph:
        """Collect the gauge, all odometry and the given loop closures."""
        graph = gtsam.NonlinearFactorGraph()
        first = self._ids[0]
        gauge = gtsam.noiseModel.Isotropic.Sigma(6, _GAUGE_SIGMA)
        graph.push_back(gtsam.PriorFactorPose3(first, self._values.atPose3(first), gauge))
        for i, factor in enumerate(self._factors):
            if i in loops or self._edges[i].kind == "odometry":
                graph.push_back(factor)
        return graph


def _lm() -> gtsam.LevenbergMarquardtParams:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(30)
    params.setRelativeErrorTol(1e-6)
    return params
