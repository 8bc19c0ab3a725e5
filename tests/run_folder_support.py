"""A pose graph for the tests of the run folder."""

import numpy as np

from lifelong_slam.geometry import exp, invert
from lifelong_slam.result import Edge, GraphSnapshot

T_BASE_SENSOR = exp(np.array([0.1, -0.2, 0.7, 1.5, 0.3, 1.8]))


def some_covariance(rng):
    A = rng.normal(size=(6, 6))
    return A @ A.T * 1e-3 + np.diag([1e-4, 2e-4, 3e-4, 4e-2, 5e-2, 6e-2])


def some_graph(rng, count=8):
    """A chain with two loop closures, disturbed measurements and full covariances."""
    poses = {0: np.eye(4)}
    for i in range(1, count):
        poses[i] = poses[i - 1] @ exp(rng.normal(size=6) * [0.1, 0.1, 0.3, 1, 0.2, 0.1])
    pairs = [(i, i + 1, "odometry") for i in range(count - 1)]
    pairs[3:3] = [(3, 0, "loop")]
    pairs.append((count - 1, 1, "loop"))
    edges = [
        Edge(
            i,
            j,
            invert(poses[i]) @ poses[j] @ exp(rng.normal(size=6) * 0.02),
            some_covariance(rng),
            kind,
        )
        for i, j, kind in pairs
    ]
    return GraphSnapshot(poses, edges)
