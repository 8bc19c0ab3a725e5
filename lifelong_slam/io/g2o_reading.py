"""Gathers the lines of a g2o file, and makes the graph that they describe."""

import logging
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import adjoint, invert
from lifelong_slam.graph.initialisation import chained
from lifelong_slam.graph.topology import edge_kinds
from lifelong_slam.io.g2o_format import (
    SE2,
    SE3,
    Format,
    made_definite,
    symmetric,
    without_information,
)
from lifelong_slam.result import Edge, EdgeKind, GraphSnapshot, Prior

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

_LARGEST = 1e30  # beyond it, products overflow
_MOST_ID = 2**63 - 1  # of a vertex
_LANDMARKS = ("XY", "XYZ", "PLANE", "POINT", "LINE", "BEARING", "LANDMARK", "PROJECT", "CAM")


class LineError(Exception):
    """A line that can't be used."""

    def __init__(self, number: int, text: str) -> None:
        super().__init__(f"line {number}: {text}")


class _Role(Enum):
    VERTEX = "vertex"
    EDGE = "edge"
    PRIOR = "prior"
    POSITION = "position"  # a prior of the position alone
    OFFSET = "offset"


@dataclass(frozen=True, slots=True)
class _Record:
    """What a line with some tag holds: so many ids, then so many numbers."""

    role: _Role
    form: Format
    ids: int
    numbers: int


@dataclass(frozen=True, slots=True)
class _Row:
    """A line as it stands in the file."""

    line: int
    ids: tuple[int, ...]
    numbers: list[float]
    kind: EdgeKind | None = None


_KINDS: dict[str, EdgeKind] = {"odometry": "odometry", "loop": "loop", "composed": "composed"}
_RECORDS = {
    SE3.vertex: _Record(_Role.VERTEX, SE3, 1, 7),
    SE2.vertex: _Record(_Role.VERTEX, SE2, 1, 3),
    SE3.edge: _Record(_Role.EDGE, SE3, 2, 28),
    SE2.edge: _Record(_Role.EDGE, SE2, 2, 9),
    SE3.prior: _Record(_Role.PRIOR, SE3, 2, 28),  # ids of vertex and offset
    SE2.prior: _Record(_Role.PRIOR, SE2, 1, 9),
    "EDGE_PRIOR_SE2_XY": _Record(_Role.POSITION, SE2, 1, 5),  # g2o
    "EDGE_SE3_XYZPRIOR": _Record(_Role.POSITION, SE3, 2, 9),  # g2o; it doesn't use the offset
    "EDGE_SE3_PRIORXYZ": _Record(_Role.POSITION, SE3, 1, 9),  # hdl_graph_slam
    "EDGE_POINTXYZ_PRIOR": _Record(_Role.POSITION, SE3, 1, 9),  # RTAB-Map
    "PARAMS_SE3OFFSET": _Record(_Role.OFFSET, SE3, 1, 7),
}
_POSES = (SE3.vertex, SE3.edge, SE2.vertex, SE2.edge)


class Lines:
    """What a file has, line by line."""

    def __init__(self, name: str, lines: Iterable[str]) -> None:
        """Gather.

        Args:
            name: of the file, for warnings.
            lines: of its text.

        Raises:
            LineError: one is malformed, or of a type that can't be used.
        """
        self._name = name
        self._form: Format | None = None
        self._rows: dict[_Role, list[_Row]] = {role: [] for role in _Role}
        self._vertices: dict[int, _Row] = {}
        self._fixed: dict[int, int] = {}  # lines by vertex
        self._unread: Counter[str] = Counter()
        kind: EdgeKind | None = None
        for number, line in enumerate(lines, 1):
            content, _, comment = line.partition("#")
            tag, *fields = content.split() or [""]
            named = _KINDS.get(comment.strip(), kind)
            if not tag:
                kind = named
            elif tag in _RECORDS:
                self._add(number, tag, fields, named)
            elif tag == "FIX":
                self._fixed |= dict.fromkeys(_ids(number, tag, fields), number)
            elif "PRIOR" in tag:
                self._unread[tag] += 1
            elif tag.startswith(("VERTEX", "EDGE")):
                raise _unreadable(number, tag)

    def graph(self) -> GraphSnapshot:
        """Return the graph, poses by id.

        Raises:
            LineError: a line refers to a vertex that isn't there, or has no direction.
            ValueError: there are no vertices, and the edges don't connect all of theirs.
        """
        if self._form is None:
            return GraphSnapshot({}, [])
        for tag, count in self._unread.items():
            self._warn("%d lines %s are left out: such a prior can't be used", count, tag)
        self._check_ends()
        edges = self._edges(self._form)
        poses = self._poses(self._form) if self._vertices else chained(edges) if edges else {}
        self._check_held(poses)
        priors = self._priors(self._form) + self._positions(self._form, poses)
        return GraphSnapshot(poses, edges, self._held(), tuple(priors), planar=self._form.planar)

    def _add(self, number: int, tag: str, fields: list[str], kind: EdgeKind | None) -> None:
        record = _RECORDS[tag]
        row = _row(number, tag, fields, record, kind)
        if record.role is not _Role.OFFSET:  # which planar graphs may have, without a use
            if self._form not in (None, record.form):
                raise LineError(number, f"{tag} in a graph of another dimension")
            self._form = record.form
        if record.role is not _Role.VERTEX:
            self._rows[record.role].append(row)
        elif row.ids[0] in self._vertices:
            first = self._vertices[row.ids[0]].line
            raise LineError(number, f"vertex {row.ids[0]} is in line {first} already")
        else:
            self._vertices[row.ids[0]] = row

    def _check_ends(self) -> None:
        for row in self._rows[_Role.EDGE]:
            if row.ids[0] == row.ids[1]:
                raise LineError(row.line, f"an edge from vertex {row.ids[0]} to itself")
            missing = [i for i in row.ids if self._vertices and i not in self._vertices]
            if missing:
                raise LineError(row.line, f"there is no vertex {missing[0]}")

    def _check_held(self, poses: dict[int, Array]) -> None:
        rows = [*self._rows[_Role.PRIOR], *self._rows[_Role.POSITION]]
        for vertex, line in ({row.ids[0]: row.line for row in rows} | self._fixed).items():
            if vertex not in poses:
                raise LineError(line, f"there is no vertex {vertex}")

    def _poses(self, form: Format) -> dict[int, Array]:
        rows = [self._vertices[i] for i in sorted(self._vertices)]
        return dict(zip(sorted(self._vertices), _unpacked(form, rows), strict=True))

    def _held(self) -> tuple[int, ...]:
        if self._fixed and not self._vertices:
            self._warn("FIX isn't used: the file has no vertices, hence no poses to hold them at")
            return ()
        return tuple(sorted(self._fixed))

    def _edges(self, form: Format) -> list[Edge]:
        rows, information = self._informed(self._rows[_Role.EDGE], form, "edges")
        if not rows:
            return []
        ids = list(self._vertices) or list(dict.fromkeys(i for row in rows for i in row.ids))
        unnamed = [(row.ids[0], row.ids[1]) for row in rows if row.kind is None]
        told = iter(edge_kinds(unnamed, ids))
        kinds = [next(told) if row.kind is None else row.kind for row in rows]
        measured = zip(_unpacked(form, rows), form.covariance(information), kinds, strict=True)
        return [
            Edge(row.ids[0], row.ids[1], *rest) for row, rest in zip(rows, measured, strict=True)
        ]

    def _priors(self, form: Format) -> list[Prior]:
        rows, information = self._informed(self._rows[_Role.PRIOR], form, "priors")
        if not rows:
            return []
        # The offset is the sensor's pose on the vertex; the prior is about the sensor.
        offsets = np.eye(4)[None] if form.planar else self._offsets(rows)
        A = adjoint(offsets)
        T = _unpacked(form, rows) @ invert(offsets)
        C = A @ form.covariance(information) @ np.swapaxes(A, 1, 2)
        return [Prior(row.ids[0], *prior) for row, *prior in zip(rows, T, C, strict=True)]

    def _positions(self, form: Format, poses: dict[int, Array]) -> list[Prior]:
        rows, known = self._informed(self._rows[_Role.POSITION], form, "priors", form.axes)
        if not rows:
            return []
        n = form.axes
        T = np.array([poses[row.ids[0]] for row in rows])
        T[:, :n, 3] = [row.numbers[:n] for row in rows]
        # A prior's errors are in its own frame, here the vertex's at the start.
        R = T[:, :n, :n]
        information = np.zeros((len(rows), len(form.order), len(form.order)))
        information[:, :n, :n] = np.swapaxes(R, 1, 2) @ known @ R
        C = form.covariance(made_definite(information, n)[0])
        return [Prior(row.ids[0], *prior) for row, *prior in zip(rows, T, C, strict=True)]

    def _informed(
        self, rows: list[_Row], form: Format, what: str, size: int | None = None
    ) -> tuple[list[_Row], Array]:
        """Return the rows that have information, and their positive definite (N, size, size) matrices."""
        size = size or len(form.order)
        if not rows:
            return [], np.zeros((0, size, size))
        upper = [row.numbers[-size * (size + 1) // 2 :] for row in rows]
        information = symmetric(np.array(upper), size)
        nothing = without_information(information)
        kept = [row for row, empty in zip(rows, nothing, strict=True) if not empty]
        if len(kept) < len(rows):
            first = rows[int(nothing.argmax())].line
            text = "%d of %d %s, the first in line %d, have no information and are left out"
            self._warn(text, len(rows) - len(kept), len(rows), what, first)
        definite, bad = made_definite(information[~nothing], form.axes)
        if bad.any():
            text = (
                "the information of %d of %d %s, the first in line %d, isn't positive definite:"
                " the nearest that is takes its place, and what it doesn't know hardly counts"
            )
            self._warn(text, bad.sum(), len(rows), what, kept[int(bad.argmax())].line)
        return kept, definite

    def _offsets(self, rows: list[_Row]) -> Array:
        """Return the (N, 4, 4) sensor's poses on the vertex, by the second id of each row."""
        defined = self._rows[_Role.OFFSET]
        poses = _unpacked(SE3, defined) if defined else ()
        known = {row.ids[0]: T for row, T in zip(defined, poses, strict=True)}
        missing = {row.ids[1] for row in rows} - known.keys()
        if missing:
            text = "PARAMS_SE3OFFSET %d is missing (%d in all): these priors count as of the vertex"
            self._warn(text, min(missing), len(missing))
        return np.array([known.get(row.ids[1], np.eye(4)) for row in rows])

    def _warn(self, text: str, *values: object) -> None:
        logger.warning("%s: " + text, self._name, *values)


def _row(line: int, tag: str, fields: list[str], record: _Record, kind: EdgeKind | None) -> _Row:
    """Read the fields of a line."""
    count = record.ids + record.numbers
    if len(fields) != count:
        raise LineError(line, f"{tag} needs {count} fields, not {len(fields)}")
    ids = _ids(line, tag, fields[: record.ids])
    try:
        numbers = [float(field) for field in fields[record.ids :]]
    except ValueError as error:
        raise _no_number(line, tag, fields, error) from error
    if not (np.abs(numbers) < _LARGEST).all():
        raise LineError(line, f"not a valid {tag}: numbers must be finite, and below {_LARGEST:g}")
    return _Row(line, ids, numbers, kind)


def _ids(line: int, tag: str, fields: list[str]) -> tuple[int, ...]:
    try:
        ids = tuple(int(field) for field in fields)
    except ValueError as error:
        raise _no_number(line, tag, fields, error) from error
    if not ids or min(ids) < 0 or max(ids) > _MOST_ID:
        raise LineError(line, f"not a valid {tag}: ids count from 0 and are below 2^63")
    return ids


def _no_number(line: int, tag: str, fields: list[str], error: ValueError) -> LineError:
    with_comma = [field for field in fields if "," in field]
    if with_comma:
        return LineError(
            line, f"{tag} has a decimal comma ({with_comma[0]}): numbers must have decimal points"
        )
    return LineError(line, f"not a valid {tag}: {error}")


def _unreadable(line: int, tag: str) -> LineError:
    if any(word in tag for word in _LANDMARKS):
        return LineError(
            line,
            f"{tag} belongs to a graph with landmarks, and only poses and motions between them can be used:"
            " marginalise the landmarks, or leave them and the edges to them out",
        )
    return LineError(line, f"{tag} can't be read; known are {', '.join(_POSES)}")


def _unpacked(form: Format, rows: list[_Row]) -> Array:
    """Return the (N, 4, 4) poses of rows."""
    values = np.array([row.numbers[: form.numbers] for row in rows])
    if not form.planar:
        bad = np.flatnonzero(~values[:, 3:].any(axis=1))
        if bad.size:
            raise LineError(rows[bad[0]].line, "a quaternion must not be zero")
    return form.unpack(values)
