"""What the tests of the pose graph share: edges, and a drive of several laps."""

import gtsam
import numpy as np
from slam_support import SIGMAS, error_of, planar

from lifelong_slam.geometry import exp, invert
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.result import Edge

COVARIANCE = np.diag(SIGMAS**2)
NO_BIAS = np.zeros(6)


def edge(i, j, T, kind="odometry", covariance=COVARIANCE):
    return Edge(i, j, T, covariance, kind)


def graph_of(edges, count):
    """Build a graph whose first edges are the odometry 0 -> 1 -> ... -> count - 1."""
    graph = PoseGraph()
    graph.add_vertex(0, np.eye(4))
    for e in edges:
        graph.add_odometry(e) if e.kind == "odometry" else graph.add_edge(e)
    assert len(graph) == count
    return graph


def noise(rng, scale=1.0, sigmas=SIGMAS):
    return exp(rng.normal(size=6) * sigmas * scale)


def laps(seed, count=60, lap=30, sigmas=SIGMAS, bias=NO_BIAS):
    """Return true poses on a circle driven more than once, and odometry with noise and bias."""
    rng = np.random.default_rng(seed)
    step = planar(2.0, 0.0, 2 * np.pi / lap)
    truth = [np.eye(4)]
    for _ in range(count - 1):
        truth.append(truth[-1] @ step)
    covariance = np.diag(sigmas**2 + bias**2)
    odometry = [
        edge(i, i + 1, step @ exp(bias) @ noise(rng, 1.0, sigmas), covariance=covariance)
        for i in range(count - 1)
    ]
    return truth, odometry, rng


def closure(truth, i, j, rng, wrong=None):
    T = invert(truth[i]) @ truth[j] @ noise(rng)
    return edge(i, j, T if wrong is None else T @ wrong, "loop")


def largest_error(graph, reference):
    return max(error_of(graph.pose(i), T)[0] for i, T in enumerate(reference))


def full_covariance(rng):
    A = rng.normal(size=(6, 6)) * 0.5
    return np.diag(SIGMAS) @ (A @ A.T + np.eye(6)) @ np.diag(SIGMAS)


def disagreement(e, poses):
    """Return the squared Mahalanobis distance of an edge from poses, by GTSAM."""
    values = gtsam.Values()
    for i in (e.source, e.target):
        values.insert(i, gtsam.Pose3(poses[i]))
    model = gtsam.noiseModel.Gaussian.Covariance(e.covariance)
    measured = gtsam.Pose3(e.T_source_target)
    return 2 * gtsam.BetweenFactorPose3(e.source, e.target, measured, model).error(values)


def gtsam_graph(edges):
    """Return GTSAM's factors for edges, the first vertex held at the origin."""
    graph = gtsam.NonlinearFactorGraph()
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    graph.push_back(gtsam.PriorFactorPose3(0, gtsam.Pose3(), held))
    for e in edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(e.covariance)
        motion = gtsam.Pose3(e.T_source_target)
        graph.push_back(gtsam.BetweenFactorPose3(e.source, e.target, motion, noise))
    return graph


def chained(odometry):
    """Return the poses (4, 4) by vertex that odometry from the origin leads to."""
    poses = {0: np.eye(4)}
    for e in odometry:
        poses[e.target] = poses[e.source] @ e.T_source_target
    return poses


def gtsam_values(poses):
    """Return poses (4, 4) by vertex as GTSAM's values."""
    values = gtsam.Values()
    for vertex, T in poses.items():
        values.insert(vertex, gtsam.Pose3(T))
    return values
