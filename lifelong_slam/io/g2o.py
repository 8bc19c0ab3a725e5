"""SE(3) pose graphs in g2o's text format, the way GTSAM reads and writes it.

A vertex is ``VERTEX_SE3:QUAT id x y z qx qy qz qw``, an edge ``EDGE_SE3:QUAT source target`` with
the measured pose and the upper triangle of its information matrix, translation before rotation.
g2o itself takes the rotational error as the quaternion's vector part, half an angle. GTSAM reads
and writes the matrix unscaled, for the full angle, and so do we.

The format has no place for an edge's kind: a comment line, ``# odometry`` or ``# loop``, names that
of the edges after it.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.files import atomic_write
from lifelong_slam.geometry import from_quaternion, to_quaternion
from lifelong_slam.result import Edge, EdgeKind, GraphSnapshot

_VERTEX = "VERTEX_SE3:QUAT"
_EDGE = "EDGE_SE3:QUAT"
_UPPER = np.triu_indices(6)
# From GTSAM's order (rotation, translation) to g2o's and, being its own inverse, back.
_SWAP = np.array([3, 4, 5, 0, 1, 2])


def write_g2o(path: Path, graph: GraphSnapshot) -> None:
    """Write a pose graph in full precision, vertices by id, edges in their order.

    Raises:
        ValueError: an edge's covariance is singular.
    """
    with atomic_write(path) as file:
        for line in [*_vertex_lines(graph), *_edge_lines(graph.edges)]:
            file.write(line.encode())


def read_g2o(path: Path) -> GraphSnapshot:
    """Read the SE(3) vertices and edges of a g2o file; other lines are skipped.

    Edges without a comment that names their kind count as odometry where they lead to the vertex
    with the next id, and as loop closures elsewhere.

    Raises:
        SourceError: the file is missing, or a vertex or edge is malformed.
    """
    if not path.is_file():
        raise SourceError(f"no such pose graph: {path}")
    poses: dict[int, NDArray[np.float64]] = {}
    rows: list[tuple[list[str], EdgeKind | None]] = []
    kind: EdgeKind | None = None
    for number, line in enumerate(path.read_text().splitlines(), 1):
        tag, *fields = line.split() or [""]
        try:
            if tag == _VERTEX:
                poses[int(fields[0])] = _pose(fields[1:8])
            elif tag == _EDGE:
                rows.append((fields, kind))
            elif tag == "#":
                kind = _kind(fields) or kind
        except (ValueError, IndexError) as error:
            raise SourceError(f"{path}, line {number}: not a valid {tag}") from error
    return GraphSnapshot(poses, _edges(path, rows, sorted(poses)))


def _vertex_lines(graph: GraphSnapshot) -> list[str]:
    ids = sorted(graph.poses)
    if not ids:
        return []
    values = _pose_values(np.stack([graph.poses[i] for i in ids]))
    return [f"{_VERTEX} {i} {_join(row)}\n" for i, row in zip(ids, values, strict=True)]


def _edge_lines(edges: list[Edge]) -> list[str]:
    if not edges:
        return []
    poses = _pose_values(np.stack([edge.T_source_target for edge in edges]))
    try:
        information = np.linalg.inv(np.stack([edge.covariance for edge in edges]))
    except np.linalg.LinAlgError as error:
        raise ValueError("an edge's covariance is singular") from error
    information = (information + np.swapaxes(information, 1, 2)) / 2
    upper = information[:, _SWAP][:, :, _SWAP][:, *_UPPER]
    lines: list[str] = []
    kind = None
    for edge, pose, row in zip(edges, poses, upper, strict=True):
        if edge.kind != kind:
            kind = edge.kind
            lines.append(f"# {kind}\n")
        lines.append(f"{_EDGE} {edge.source} {edge.target} {_join(pose)} {_join(row)}\n")
    return lines


def _edges(path: Path, rows: list[tuple[list[str], EdgeKind | None]], ids: list[int]) -> list[Edge]:
    """Turn the fields of edge lines into edges."""
    following = dict(pairwise(ids))
    edges = []
    for fields, kind in rows:
        try:
            source, target = int(fields[0]), int(fields[1])
            information = np.zeros((6, 6))
            information[_UPPER] = [float(field) for field in fields[9:30]]
            information += np.triu(information, 1).T
            covariance = np.linalg.inv(information[_SWAP][:, _SWAP])
            pose = _pose(fields[2:9])
        except (ValueError, IndexError, np.linalg.LinAlgError) as error:
            raise SourceError(f"{path}: not a valid {_EDGE} {' '.join(fields[:2])}") from error
        chained = following.get(source, source + 1) == target
        edges.append(
            Edge(source, target, pose, covariance, kind or ("odometry" if chained else "loop"))
        )
    return edges


def _kind(fields: list[str]) -> EdgeKind | None:
    """Return the kind that a comment names, if it does."""
    if fields == ["odometry"]:
        return "odometry"
    return "loop" if fields == ["loop"] else None


def _pose_values(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 7) rows x y z qx qy qz qw of (N, 4, 4) poses."""
    return np.hstack([poses[:, :3, 3], to_quaternion(poses)])


def _pose(fields: list[str]) -> NDArray[np.float64]:
    values = np.array([float(field) for field in fields])
    if len(values) != 7:
        raise ValueError("a pose needs 7 numbers")
    return from_quaternion(values[:3], values[3:])


def _join(row: NDArray[np.float64]) -> str:
    return " ".join(map(repr, row.tolist()))
