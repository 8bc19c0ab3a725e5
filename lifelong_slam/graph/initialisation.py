"""Where to start the optimisation of a whole graph.

Levenberg-Marquardt finds the nearest minimum, and poses that are chained along odometry may be far from
the best one. Rotations that are found first, by the chordal relaxation, which is linear, bring it near
(Carlone, Tron, Daniilidis and Dellaert, *Initialization techniques for 3D SLAM*, ICRA 2015).
"""

import gtsam
import networkx
import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import invert
from lifelong_slam.result import Edge, GraphSnapshot

Array = NDArray[np.float64]

_LOOP_WEIGHT = 1e9  # more than there are odometry edges: closures come in only where odometry ends


def connected(graph: GraphSnapshot) -> list[set[int]]:
    """Return the sets of vertices that edges connect, by their lowest vertex."""
    structure = networkx.Graph((edge.source, edge.target) for edge in graph.edges)
    structure.add_nodes_from(graph.poses)
    return sorted(networkx.connected_components(structure), key=min)


def chained(edges: list[Edge]) -> dict[int, Array]:
    """Return poses (4, 4) by vertex, chained along edges from the lowest vertex at the origin.

    Raises:
        ValueError: the edges don't connect all vertices.
    """
    structure: networkx.Graph[int] = networkx.Graph()
    for edge in sorted(edges, key=lambda edge: edge.kind == "odometry"):
        weight = 1.0 if edge.kind == "odometry" else _LOOP_WEIGHT
        structure.add_edge(edge.source, edge.target, weight=weight, edge=edge)
    first = min(structure)
    tree = networkx.minimum_spanning_tree(structure)
    poses = {first: np.eye(4)}
    for known, new in networkx.bfs_edges(tree, first):
        edge = tree.edges[known, new]["edge"]
        T = edge.T_source_target
        poses[new] = poses[known] @ (T if edge.source == known else invert(T))
    apart = set(structure) - set(poses)
    if apart:
        raise ValueError(
            f"no edges lead from vertex {first} to {len(apart)} others, such as {min(apart)}:"
            " where the file has no vertices, its edges must connect them all"
        )
    return dict(sorted(poses.items()))


def chordal(graph: GraphSnapshot) -> dict[int, Array]:
    """Return poses (4, 4) by vertex by the chordal relaxation, which needs no start.

    The lowest vertex of each connected part keeps its pose.
    """
    # Only the ratios of the covariances matter; more information than GTSAM gives its anchor, which is
    # the identity, would make the system ill-conditioned.
    covariances = np.array([edge.covariance for edge in graph.edges])
    scale = 1 / np.linalg.eigvalsh(covariances).min()
    factors = gtsam.NonlinearFactorGraph()
    for edge in graph.edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(scale * edge.covariance)
        measured = gtsam.Pose3(edge.T_source_target)
        factors.push_back(gtsam.BetweenFactorPose3(edge.source, edge.target, measured, noise))
    parts = connected(graph)
    for part in parts:
        held = gtsam.noiseModel.Unit.Create(6)
        factors.push_back(gtsam.PriorFactorPose3(min(part), gtsam.Pose3(), held))
    values = gtsam.InitializePose3.initialize(factors)
    poses = {vertex: np.asarray(values.atPose3(vertex).matrix()) for vertex in graph.poses}
    for part in parts:
        shift = graph.poses[min(part)] @ invert(poses[min(part)])
        poses |= {vertex: shift @ poses[vertex] for vertex in part}
    return poses
