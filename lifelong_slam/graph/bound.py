"""How far pruning may move what stays.

What is left of a graph may have another optimum than the graph had: it says less, and what it says was made
by formulas of first order. How far that is tolerable the graph itself tells, by its covariance P: each
vertex, moved by d, has the squared Mahalanobis distance d^T P^-1 d from where it was. That is a bound in
metres and radians, whatever the edges claim, once P is scaled by the variance factor

    s^2 = chi-square of the edges / number of redundant degrees of freedom,

the variance that residuals show over the one that they were given (the reference variance in Ghilani,
*Adjustment Computations*, 2017). The optimum doesn't change when all covariances are multiplied by one
number; neither does the bound.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import invert, log
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.removal import Removal, recover
from lifelong_slam.graph.robust import threshold

Array = NDArray[np.float64]

_DEGREES = 6  # of freedom of a vertex
MAX_DISTANCE = threshold(_DEGREES)  # squared Mahalanobis distance of one vertex, in units of s^2
_LEAST_VARIANCE = 1e-4  # of the factor: by a hundredth of a standard deviation anything may move
_WATCHED = 100  # vertices whose own distances are looked at, at most


class Bound:
    """Judges what is left of a graph by the optimum that it had.

    Two distances are bounded. Of all vertices together it is the rise of the former graph's chi-square,
    which may be as much for each degree of freedom that is gone as it was for each that was redundant.
    No vertex's own distance exceeds the joint one; only where that is too much for one vertex are theirs
    looked at. In a large graph they are those of some vertices, evenly spread: a move that these
    don't show is local, so that the joint distance shows it. Removed vertices count as those that stay.

    Attributes:
        variance: the factor s^2, at most 1.
    """

    def __init__(self, graph: PoseGraph) -> None:
        """Keep a graph as it is now, at its optimum."""
        self._former = graph.checkpoint()
        self._chi_square = graph.chi_square()
        redundant = _DEGREES * (graph.edge_count - len(graph) + len(graph.roots))
        factor = self._chi_square / redundant if redundant > 0 else 1.0
        self.variance = float(np.clip(factor, _LEAST_VARIANCE, 1.0))
        self._watched = graph.vertices[:: len(graph) // _WATCHED + 1]
        self._information: Array | None = None

    def allows(self, graph: PoseGraph, removals: Sequence[Removal]) -> bool:
        """Tell whether vertices are where they may be, or where the former graph would rather have them.

        Args:
            graph: what is left, at its optimum.
            removals: all that were made.
        """
        poses = recover(graph.poses(), removals)
        rise = self._former.chi_square(poses) - self._chi_square
        if not rise <= _DEGREES * len(removals) * self.variance:
            return False
        most = MAX_DISTANCE * self.variance
        return rise <= most or bool(self._distances(poses).max() <= most)

    def _distances(self, poses: Mapping[int, Array]) -> Array:
        """Return the (n,) squared Mahalanobis distances that the watched vertices have moved."""
        if self._information is None:
            self._information = self._former.marginal_information(self._watched)
        before = np.array([self._former.pose(i) for i in self._watched])
        moved = log(invert(before) @ np.array([poses[i] for i in self._watched]))
        distances: Array = np.einsum("ni,nij,nj->n", moved, self._information, moved)
        return distances
