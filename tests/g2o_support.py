"""What the tests of pose graphs from files share: a robot that goes round a circle several times."""

import gtsam
import numpy as np

from lifelong_slam.geometry import exp, invert
from lifelong_slam.io.g2o_format import planar_poses
from lifelong_slam.result import Edge, GraphSnapshot

PER_LAP = 20
SIGMAS = np.array([0.004, 0.005, 0.006, 0.02, 0.03, 0.04])  # rad, m
IN_PLANE = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])


def laps(count=3, planar=False, seed=0, wrong=0):
    """Return a graph, not optimised, and its true poses.

    Args:
        count: laps of 20 vertices; each vertex closes a loop with the one a lap before.
        planar: in the plane.
        seed: of the noise.
        wrong: further loop closures, which claim that two vertices are in one place.
    """
    rng = np.random.default_rng(seed)
    noisy = SIGMAS * (IN_PLANE if planar else 1.0)
    turn = 2 * np.pi / PER_LAP
    step = exp(np.array([0.0, 0.0 if planar else 0.05, turn, 2.0, 0.0, 0.0 if planar else 0.02]))
    truth = [np.eye(4)]
    for _ in range(count * PER_LAP - 1):
        truth.append(truth[-1] @ step)
    covariance = np.diag(planar_variances() if planar else SIGMAS**2)

    def edge(i, j, kind):
        measured = invert(truth[i]) @ truth[j] @ exp(noisy * rng.normal(size=6))
        return Edge(i, j, measured, covariance, kind)

    edges = [edge(i, i + 1, "odometry") for i in range(len(truth) - 1)]
    edges += [edge(i, i + PER_LAP, "loop") for i in range(len(truth) - PER_LAP)]
    for _ in range(wrong):
        i, j = (int(v) for v in rng.choice(len(truth), 2, replace=False))
        heading = planar_poses(np.array([[0.0, 0.0, rng.uniform(-np.pi, np.pi)]]))[0]
        edges.append(Edge(i, j, heading, covariance, "loop"))
    poses = {0: np.eye(4)}
    for e in edges[: len(truth) - 1]:
        poses[e.target] = poses[e.source] @ e.T_source_target
    return GraphSnapshot(poses, edges, planar=planar), dict(enumerate(truth))


def planar_variances():
    """Variances in the plane as above, and out of it as the reader of planar files puts them."""
    variances = SIGMAS**2
    variances[[0, 1]] = variances[2]
    variances[5] = (variances[3] + variances[4]) / 2
    return variances


def gtsam_optimum(path, spatial):
    """Return GTSAM's own Levenberg-Marquardt on a g2o file: half chi-square and (4, 4) poses by vertex.

    Planar files are read as Pose2: an implementation that has no third dimension.
    """
    graph, start = gtsam.readG2o(str(path), spatial)
    first = min(start.keys())
    if spatial:
        prior = gtsam.PriorFactorPose3(
            first, start.atPose3(first), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
        )
    else:
        prior = gtsam.PriorFactorPose2(
            first, start.atPose2(first), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
        )
    held = gtsam.NonlinearFactorGraph(graph)
    held.push_back(prior)
    values = gtsam.LevenbergMarquardtOptimizer(held, start).optimize()
    if spatial:
        poses = {i: values.atPose3(i).matrix() for i in values.keys()}  # noqa: SIM118 - no mapping
    else:
        rows = {i: values.atPose2(i) for i in values.keys()}  # noqa: SIM118
        poses = {i: planar_poses(np.array([[p.x(), p.y(), p.theta()]]))[0] for i, p in rows.items()}
    return graph.error(values), poses
