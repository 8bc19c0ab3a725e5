"""Where to start the optimisation of a whole graph.

Levenberg-Marquardt finds the nearest minimum, and poses that are chained along odometry may be far from
the best one. Rotations that are found first, by the chordal relaxation, which is linear, bring it near
(Carlone, Tron, Daniilidis and Dellaert, *Initialization techniques for 3D SLAM*, ICRA 2015).
"""

from collections.abc import Iterable, Mapping, Sequence

import gtsam
import networkx
import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import invert, log
from lifelong_slam.result import Edge, GraphSnapshot, Prior

Array = NDArray[np.float64]

_LOOP_WEIGHT = 1e9  # more than there are odometry edges: closures come in only where odometry ends
_WIDEST = 1e6  # variance in the chordal relaxation, relative to the least


def components(vertices: Iterable[int], ties: Iterable[tuple[int, int]]) -> list[set[int]]:
    """Return the sets of vertices that ties connect, by their lowest vertex."""
    structure: networkx.Graph[int] = networkx.Graph()
    structure.add_nodes_from(vertices)
    structure.add_edges_from(ties)
    return sorted(networkx.connected_components(structure), key=min)


def connected(graph: GraphSnapshot) -> list[set[int]]:
    """Return the sets of vertices that a graph's edges connect, by their lowest vertex."""
    return components(graph.poses, ((edge.source, edge.target) for edge in graph.edges))


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
    factors = gtsam.NonlinearFactorGraph()
    for edge, covariance in zip(graph.edges, _conditioned(graph.edges), strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
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


def _conditioned(edges: list[Edge]) -> Array:
    """Return (N, 6, 6) covariances for the relaxation, of which only the ratios matter.

    More information than GTSAM gives its anchor, which is the identity, would make the system
    ill-conditioned, and so would edges that know hardly anything of some direction.
    """
    variances, V = np.linalg.eigh(np.array([edge.covariance for edge in edges]))
    bounded = np.minimum(variances / variances.min(), _WIDEST)
    covariances: Array = (V * bounded[:, None]) @ np.swapaxes(V, 1, 2)
    return covariances


def best_start(graph: GraphSnapshot) -> dict[int, Array]:
    """Return the graph's own poses or those of the chordal relaxation, whichever fit better.

    What they have to fit is trusted: odometry and priors. Fixed vertices stay where they are, and parts
    with priors are also tried where these put them.
    """
    candidates = (graph.poses, anchored(graph, graph.poses), anchored(graph, chordal(graph)))
    return min(candidates, key=lambda poses: _misfit(graph, poses))


def anchored(graph: GraphSnapshot, poses: dict[int, Array]) -> dict[int, Array]:
    """Return poses (4, 4) by vertex, each connected part moved to its fixed vertices and priors.

    Parts are moved as they are, to where they fit best, but fixed vertices are then put exactly where the
    graph has them. A part that has neither stays.
    """
    anchors = {prior.vertex: prior.T_map_vertex for prior in graph.priors}
    anchors |= {vertex: graph.poses[vertex] for vertex in graph.fixed}
    if not anchors:
        return poses
    moved = dict(poses)
    for part in connected(graph):
        held = sorted(part & anchors.keys())
        if held:
            shift = _best_shift([poses[v] for v in held], [anchors[v] for v in held])
            moved |= {vertex: shift @ poses[vertex] for vertex in part}
    return moved | {vertex: graph.poses[vertex] for vertex in graph.fixed}


def _best_shift(sources: list[Array], targets: list[Array]) -> Array:
    """Return the rigid motion (4, 4) that brings N poses nearest to N others, by least squares.

    What is compared are each pose's origin and the ends of its axes, one metre long (Kabsch 1976): with
    one pose its attitude counts, with many far apart their places do.
    """
    frame = np.column_stack([np.zeros(3), np.eye(3)])
    p, q = (
        np.concatenate([T[:3, :3] @ frame + T[:3, 3:] for T in poses], axis=1)
        for poses in (sources, targets)
    )
    p_mean, q_mean = p.mean(axis=1, keepdims=True), q.mean(axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd((q - q_mean) @ (p - p_mean).T)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    shift = np.eye(4)
    shift[:3, :3], shift[:3, 3:] = R, q_mean - R @ p_mean
    return shift


def _misfit(graph: GraphSnapshot, poses: Mapping[int, Array]) -> float:
    """Return the sum of squared Mahalanobis distances of odometry and priors."""
    odometry = [edge for edge in graph.edges if edge.kind == "odometry"]
    total = 0.0
    if odometry:
        sources = np.array([poses[edge.source] for edge in odometry])
        targets = np.array([poses[edge.target] for edge in odometry])
        total += _distances(odometry, invert(sources) @ targets)
    if graph.priors:
        total += _distances(graph.priors, np.array([poses[p.vertex] for p in graph.priors]))
    return total


def _distances(measurements: Sequence[Edge] | Sequence[Prior], expected: Array) -> float:
    """Return the summed squared Mahalanobis distances of N measurements from (N, 4, 4) poses."""
    measured = np.array(
        [m.T_source_target if isinstance(m, Edge) else m.T_map_vertex for m in measurements]
    )
    errors = log(invert(measured) @ expected)
    covariances = np.array([measurement.covariance for measurement in measurements])
    whitened = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return float(np.einsum("ij,ij->", errors, whitened))
