"""Pose graphs in g2o's text format, SE(3) and SE(2), the way GTSAM reads and writes it.

A vertex is ``VERTEX_SE3:QUAT id x y z qx qy qz qw``, an edge ``EDGE_SE3:QUAT source target`` with
the measured pose and the upper triangle of its information matrix, translation before rotation.
g2o itself takes the rotational error as the quaternion's vector part, half an angle. GTSAM reads
and writes the matrix unscaled, for the full angle, and so do we.

``VERTEX_SE2`` and ``EDGE_SE2`` have ``x y theta``. We hold such a graph in space: what lies out of the
plane (z, roll and pitch) is measured as zero, as well as x, y and theta are. Between planar poses it is
independent of what lies in the plane, also after chaining and marginalisation, so that it changes nothing
there; it is left out again when the graph is written.

The format has no place for an edge's kind. A comment, ``# odometry`` or ``# loop``, names it: on a line of
its own for all edges after it, or at the end of an edge's line for that edge. SE(3) files have the former.
SE(2) files have the latter, since GTSAM's reader of those stops, without a word, at a line of comment.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.files import atomic_write
from lifelong_slam.geometry import from_quaternion, to_quaternion
from lifelong_slam.graph.initialisation import chained
from lifelong_slam.result import Edge, EdgeKind, GraphSnapshot

Array = NDArray[np.float64]

_SINGULAR = 1e-12  # least eigenvalue of an information matrix, relative to its greatest
_OUT_OF_PLANE = [0, 1, 5]  # roll, pitch and z in GTSAM's order


@dataclass(frozen=True, slots=True)
class FileGraph(GraphSnapshot):
    """A pose graph as a file has it.

    Attributes:
        planar: it has SE(2) poses, here as SE(3) poses with z, roll and pitch zero.
    """

    planar: bool = False


@dataclass(frozen=True, slots=True)
class _Format:
    """How poses and edges of one kind are written.

    Attributes:
        vertex: tag of a vertex.
        edge: tag of an edge.
        numbers: that make a pose.
        order: of the rows of an information matrix, as indices into GTSAM's tangent vector.
    """

    vertex: str
    edge: str
    numbers: int
    order: tuple[int, ...]

    @property
    def planar(self) -> bool:
        """Whether these are SE(2)."""
        return len(self.order) == 3

    def pack(self, poses: Array) -> Array:
        """Return (N, numbers) rows of (N, 4, 4) poses."""
        if self.planar:
            heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
            return np.column_stack([poses[:, :2, 3], heading])
        return np.hstack([poses[:, :3, 3], to_quaternion(poses)])

    def unpack(self, values: Array) -> Array:
        """Return the (N, 4, 4) poses of (N, numbers) rows."""
        return (
            planar_poses(values) if self.planar else from_quaternion(values[:, :3], values[:, 3:])
        )

    def information(self, covariances: Array) -> Array:
        """Return the (N, n, n) information matrices in the file's order of (N, 6, 6) covariances."""
        rows, columns = np.ix_(self.order, self.order)
        information = np.linalg.inv(covariances[:, rows, columns])
        mean: Array = (information + np.swapaxes(information, 1, 2)) / 2
        return mean

    def covariance(self, information: Array) -> Array:
        """Return the (N, 6, 6) covariances of (N, n, n) information matrices in the file's order."""
        known = np.linalg.inv(information)
        covariances: Array = np.zeros((len(known), 6, 6))
        rows, columns = np.ix_(self.order, self.order)
        covariances[:, rows, columns] = known
        if self.planar:
            x, y, theta = np.diagonal(known, axis1=1, axis2=2).T
            covariances[:, _OUT_OF_PLANE, _OUT_OF_PLANE] = np.stack([theta, theta, (x + y) / 2], 1)
        return covariances


_SE3 = _Format("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", 7, (3, 4, 5, 0, 1, 2))
_SE2 = _Format("VERTEX_SE2", "EDGE_SE2", 3, (3, 4, 2))
_KINDS: dict[str, EdgeKind] = {"odometry": "odometry", "loop": "loop"}
_BY_TAG = {tag: form for form in (_SE3, _SE2) for tag in (form.vertex, form.edge)}


def write_g2o(path: Path, graph: GraphSnapshot, planar: bool = False) -> None:
    """Write a pose graph in full precision, vertices by id, edges in their order.

    Args:
        path: of the file, replaced only once the new one is complete.
        graph: its vertices and edges.
        planar: write the planar part of all poses and covariances, as SE(2).

    Raises:
        ValueError: an edge's covariance is singular.
    """
    form = _SE2 if planar else _SE3
    with atomic_write(path) as file:
        for line in [*_vertex_lines(graph, form), *_edge_lines(graph.edges, form)]:
            file.write(line.encode())


def read_g2o(path: Path) -> FileGraph:
    """Read the vertices and edges of a g2o file; comments, parameters and FIX are skipped.

    Edges without a comment that names their kind count as odometry where they lead to the vertex
    with the next id, and as loop closures elsewhere. In a file that has no vertices, poses are chained
    from the edges, odometry as far as it goes.

    Raises:
        SourceError: the file is missing; a line is malformed or of a type that isn't a pose or a motion;
            an information matrix isn't positive definite; a vertex is there twice or not at all; or
            vertices are left out and the edges don't connect them.
    """
    if not path.is_file():
        raise SourceError(f"no such pose graph: {path}")
    try:
        lines = _Lines(path.read_text().splitlines())
        return lines.graph()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is no text: expected a g2o file") from error
    except _LineError as error:
        raise SourceError(f"{path}, {error}") from error
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error


def planar_poses(values: Array) -> Array:
    """Return the (N, 4, 4) poses of (N, 3) rows x y theta."""
    zero, half = np.zeros(len(values)), values[:, 2] / 2
    quaternions = np.column_stack([zero, zero, np.sin(half), np.cos(half)])
    return from_quaternion(np.column_stack([values[:, :2], zero]), quaternions)


class _LineError(Exception):
    """A line that can't be used."""

    def __init__(self, number: int, text: str) -> None:
        super().__init__(f"line {number}: {text}")


@dataclass(frozen=True, slots=True)
class _Row:
    """One vertex or edge as it stands in the file."""

    line: int
    ids: tuple[int, ...]
    numbers: list[float]
    kind: EdgeKind | None = None


class _Lines:
    """Vertices and edges gathered line by line, and the graph that they make."""

    def __init__(self, lines: Iterable[str]) -> None:
        self._form: _Format | None = None
        self._vertices: dict[int, _Row] = {}
        self._edges: list[_Row] = []
        kind: EdgeKind | None = None
        for number, line in enumerate(lines, 1):
            content, _, comment = line.partition("#")
            tag, *fields = content.split() or [""]
            named = _KINDS.get(comment.strip(), kind)
            if not tag:
                kind = named
            elif tag in _BY_TAG:
                self._add(number, tag, fields, named)
            elif tag.startswith(("VERTEX", "EDGE")):
                raise _LineError(number, f"{tag} can't be read; known are {', '.join(_BY_TAG)}")

    def graph(self) -> FileGraph:
        """Return the graph, poses by id."""
        if self._form is None:
            return FileGraph({}, [])
        self._check_ends()
        edges = self._measurements(self._form)
        if self._vertices:
            rows = [self._vertices[i] for i in sorted(self._vertices)]
            poses = dict(zip(sorted(self._vertices), _unpacked(self._form, rows), strict=True))
        else:
            poses = chained(edges)
        return FileGraph(poses, edges, planar=self._form.planar)

    def _add(self, number: int, tag: str, fields: list[str], kind: EdgeKind | None) -> None:
        form = _BY_TAG[tag]
        if self._form not in (None, form):
            raise _LineError(number, f"{tag} in a graph of another dimension")
        self._form = form
        n = len(form.order)
        ends, count = (1, 0) if tag == form.vertex else (2, n * (n + 1) // 2)
        row = _row(number, tag, fields, ends, form.numbers + count, kind)
        if tag == form.edge:
            self._edges.append(row)
        elif row.ids[0] in self._vertices:
            first = self._vertices[row.ids[0]].line
            raise _LineError(number, f"vertex {row.ids[0]} is in line {first} already")
        else:
            self._vertices[row.ids[0]] = row

    def _check_ends(self) -> None:
        for row in self._edges:
            if row.ids[0] == row.ids[1]:
                raise _LineError(row.line, f"an edge from vertex {row.ids[0]} to itself")
            missing = [i for i in row.ids if self._vertices and i not in self._vertices]
            if missing:
                raise _LineError(row.line, f"there is no vertex {missing[0]}")

    def _measurements(self, form: _Format) -> list[Edge]:
        if not self._edges:
            return []
        n = len(form.order)
        upper = np.array([row.numbers[form.numbers :] for row in self._edges])
        information = np.zeros((len(upper), n, n))
        information[:, *np.triu_indices(n)] = upper
        information += np.swapaxes(np.triu(information, 1), 1, 2)
        eigenvalues = np.linalg.eigvalsh(information)
        bad = np.flatnonzero(eigenvalues[:, 0] <= _SINGULAR * eigenvalues[:, -1])
        if bad.size:
            raise _LineError(
                self._edges[bad[0]].line, "the information matrix must be positive definite"
            )
        covariances = form.covariance(information)
        motions = _unpacked(form, self._edges)
        ids = self._vertices or {i for row in self._edges for i in row.ids}
        following = dict(pairwise(sorted(ids)))
        return [
            Edge(row.ids[0], row.ids[1], T, C, row.kind or _usual_kind(row, following))
            for row, T, C in zip(self._edges, motions, covariances, strict=True)
        ]


def _row(
    line: int, tag: str, fields: list[str], ends: int, count: int, kind: EdgeKind | None
) -> _Row:
    """Read the fields of a line: that many ids, then that many numbers."""
    if len(fields) != ends + count:
        raise _LineError(line, f"{tag} needs {ends + count} fields, not {len(fields)}")
    try:
        ids = tuple(int(field) for field in fields[:ends])
        numbers = [float(field) for field in fields[ends:]]
    except ValueError as error:
        raise _LineError(line, f"not a valid {tag}: {error}") from error
    if min(ids) < 0 or not np.isfinite(numbers).all():
        raise _LineError(line, f"not a valid {tag}: ids count from 0, numbers must be finite")
    return _Row(line, ids, numbers, kind)


def _unpacked(form: _Format, rows: list[_Row]) -> Array:
    """Return the (N, 4, 4) poses of rows."""
    values = np.array([row.numbers[: form.numbers] for row in rows])
    if not form.planar:
        bad = np.flatnonzero(~values[:, 3:].any(axis=1))
        if bad.size:
            raise _LineError(rows[bad[0]].line, "a quaternion must not be zero")
    return form.unpack(values)


def _usual_kind(row: _Row, following: dict[int, int]) -> EdgeKind:
    source, target = row.ids
    return "odometry" if following.get(source) == target else "loop"


def _vertex_lines(graph: GraphSnapshot, form: _Format) -> list[str]:
    ids = sorted(graph.poses)
    if not ids:
        return []
    values = form.pack(np.stack([graph.poses[i] for i in ids]))
    return [f"{form.vertex} {i} {_join(row)}\n" for i, row in zip(ids, values, strict=True)]


def _edge_lines(edges: list[Edge], form: _Format) -> list[str]:
    if not edges:
        return []
    poses = form.pack(np.stack([edge.T_source_target for edge in edges]))
    try:
        information = form.information(np.stack([edge.covariance for edge in edges]))
    except np.linalg.LinAlgError as error:
        raise ValueError("an edge's covariance is singular") from error
    upper = information[:, *np.triu_indices(len(form.order))]
    lines: list[str] = []
    kind = None
    for edge, pose, row in zip(edges, poses, upper, strict=True):
        line = f"{form.edge} {edge.source} {edge.target} {_join(pose)} {_join(row)}"
        if not form.planar and edge.kind != kind:
            kind = edge.kind
            lines.append(f"# {kind}\n")
        lines.append(f"{line} # {edge.kind}\n" if form.planar else f"{line}\n")
    return lines


def _join(row: Array) -> str:
    return " ".join(map(repr, row.tolist()))
