"""Algebra of measured edges: turned round, chained, and put together.

An edge's error sits on the target's side, ``T_source_target = Z Exp(xi)`` with ``xi ~ N(0, C)``, so
that with Ad the adjoint, to first order in xi:

- turned round, ``T^-1 = Z^-1 Exp(-Ad(Z) xi)`` has the covariance ``Ad(Z) C Ad(Z)^T``;
- chained, ``Z1 Exp(x1) Z2 Exp(x2)`` has ``Ad(Z2^-1) C1 Ad(Z2^-1)^T + C2``.
"""

from functools import reduce

import gtsam
import numpy as np
from numpy.typing import NDArray

from lifelong_slam.result import Edge, EdgeKind

Array = NDArray[np.float64]


def reverse(edge: Edge) -> Edge:
    """Return the same measurement from the target to the source."""
    motion = gtsam.Pose3(edge.T_source_target)
    A = motion.AdjointMap()
    return Edge(
        edge.target,
        edge.source,
        motion.inverse().matrix(),
        _symmetric(A @ edge.covariance @ A.T),
        edge.kind,
    )


def outward(edge: Edge, vertex: int) -> Edge:
    """Return the measurement with the given one of its vertices as source."""
    return edge if edge.source == vertex else reverse(edge)


def chain(first: Edge, second: Edge) -> Edge:
    """Return the motion first a -> b, then b -> c: odometry if both are, else composed."""
    A = gtsam.Pose3(second.T_source_target).inverse().AdjointMap()
    return Edge(
        first.source,
        second.target,
        first.T_source_target @ second.T_source_target,
        _symmetric(A @ first.covariance @ A.T + second.covariance),
        chained_kind(first, second),
    )


def chained_kind(first: Edge, second: Edge) -> EdgeKind:
    """Return the kind of an edge that leads through a vertex, which no closure by itself does."""
    return "odometry" if first.kind == second.kind == "odometry" else "composed"


def fuse(edges: list[Edge]) -> Edge:
    """Return the mean, by information, of independent measurements of one pair of vertices.

    Of one kind it keeps that: closures of one pair are together still a closure of it. Otherwise it is
    composed.
    """
    return reduce(_fuse_two, edges)


def _fuse_two(first: Edge, second: Edge) -> Edge:
    second = outward(second, first.source)
    motion = gtsam.Pose3(first.T_source_target)
    # The parallel sum A (A + B)^-1 B, which stays positive where A - gain A would not.
    gain = np.linalg.solve(first.covariance + second.covariance, first.covariance).T
    shift = gtsam.Pose3.Logmap(motion.between(gtsam.Pose3(second.T_source_target)))
    mean = motion.compose(gtsam.Pose3.Expmap(gain @ shift)).matrix()
    covariance = _symmetric(gain @ second.covariance)
    kind = first.kind if first.kind == second.kind else "composed"
    return Edge(first.source, first.target, mean, covariance, kind)


def _symmetric(C: Array) -> Array:
    mean: Array = (C + C.T) / 2
    return mean
