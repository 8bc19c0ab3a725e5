"""Pose graphs in g2o's text format, SE(3) and SE(2), the way GTSAM reads and writes it.

A vertex is ``VERTEX_SE3:QUAT id x y z qx qy qz qw``, an edge ``EDGE_SE3:QUAT source target`` with
the measured pose and the upper triangle of its information matrix, translation before rotation.
g2o itself takes the rotational error as the quaternion's vector part, half an angle. GTSAM reads
and writes the matrix unscaled, for the full angle, and so do we.

``VERTEX_SE2`` and ``EDGE_SE2`` have ``x y theta``. We hold such a graph in space: what lies out of the
plane (z, roll and pitch) is measured as zero, as well as x, y and theta are. Between planar poses it is
independent of what lies in the plane, also after chaining and marginalisation, so that it changes nothing
there; it is left out again when the graph is written.

``FIX id ...`` holds vertices at the poses that the file gives them. ``EDGE_SE3_PRIOR id offset`` and
``EDGE_PRIOR_SE2 id``, each with a pose and its information, are measured poses in the map frame, that of
SE(3) of a sensor whose pose on the vertex is ``PARAMS_SE3OFFSET offset``. Priors of a position alone
(``EDGE_PRIOR_SE2_XY``, ``EDGE_SE3_XYZPRIOR``, hdl_graph_slam's ``EDGE_SE3_PRIORXYZ`` and RTAB-Map's
``EDGE_POINTXYZ_PRIOR``) become such ones that know nothing of the attitude.

The format has no place for an edge's kind. A comment, ``# odometry``, ``# loop`` or ``# composed``,
names it: on a line of its own for all edges after it, or at the end of an edge's line for that edge. SE(3)
files have the former. SE(2) files have the latter, since GTSAM's reader of those stops, without a word,
at a line of comment. Edges that nothing names are told apart by topology.py.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.files import atomic_write
from lifelong_slam.io.g2o_format import SE2, SE3, Format
from lifelong_slam.io.g2o_reading import LineError, Lines
from lifelong_slam.result import Edge, GraphSnapshot, Prior

Array = NDArray[np.float64]

_NO_OFFSET = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n"


def write_g2o(path: Path, graph: GraphSnapshot) -> None:
    """Write a pose graph in full precision: vertices by id, edges in their order, priors, FIX lines.

    Args:
        path: of the file, replaced only once the new one is complete.
        graph: what to write.

    Raises:
        ValueError: a covariance is singular.
    """
    form = SE2 if graph.planar else SE3
    lines = [
        *_vertex_lines(graph, form),
        *_edge_lines(graph.edges, form),
        *_prior_lines(graph.priors, form),
        *(f"FIX {vertex}\n" for vertex in graph.fixed),  # where GTSAM's reader of SE(2) stops
    ]
    with atomic_write(path) as file:
        for line in lines:
            file.write(line.encode())


def read_g2o(path: Path) -> GraphSnapshot:
    """Read the vertices, edges, priors and fixed vertices of a g2o file.

    In a file that has no vertices, poses are chained from the edges, odometry as far as it goes.
    Information that isn't positive definite is made so (see g2o_format.py), edges without any are left
    out; a warning counts either.

    Raises:
        SourceError: the file is missing; a line is malformed or of a type that isn't a pose or a motion;
            a vertex is there twice or not at all; or vertices are left out and the edges don't connect
            them.
    """
    if not path.is_file():
        raise SourceError(f"no such pose graph: {path}")
    try:
        return Lines(str(path), path.read_text().splitlines()).graph()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is no text: expected a g2o file") from error
    except LineError as error:
        raise SourceError(f"{path}, {error}") from error
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error


def _vertex_lines(graph: GraphSnapshot, form: Format) -> list[str]:
    ids = sorted(graph.poses)
    if not ids:
        return []
    values = form.pack(np.stack([graph.poses[i] for i in ids]))
    return [f"{form.vertex} {i} {_join(row)}\n" for i, row in zip(ids, values, strict=True)]


def _edge_lines(edges: list[Edge], form: Format) -> list[str]:
    if not edges:
        return []
    poses = np.stack([edge.T_source_target for edge in edges])
    numbers = _measurements(poses, np.stack([edge.covariance for edge in edges]), form)
    lines: list[str] = []
    kind = None
    for edge, measured in zip(edges, numbers, strict=True):
        line = f"{form.edge} {edge.source} {edge.target} {measured}"
        if not form.planar and edge.kind != kind:
            kind = edge.kind
            lines.append(f"# {kind}\n")
        lines.append(f"{line} # {edge.kind}\n" if form.planar else f"{line}\n")
    return lines


def _prior_lines(priors: tuple[Prior, ...], form: Format) -> list[str]:
    if not priors:
        return []
    poses = np.stack([prior.T_map_vertex for prior in priors])
    numbers = _measurements(poses, np.stack([prior.covariance for prior in priors]), form)
    head, offset = ([], "") if form.planar else ([_NO_OFFSET], " 0")
    lines = zip(priors, numbers, strict=True)
    return head + [f"{form.prior} {prior.vertex}{offset} {row}\n" for prior, row in lines]


def _measurements(poses: Array, covariances: Array, form: Format) -> list[str]:
    """Return the numbers of (N, 4, 4) measured poses and the information of (N, 6, 6) covariances."""
    try:
        information = form.information(covariances)
    except np.linalg.LinAlgError as error:
        raise ValueError("the covariance of an edge or prior is singular") from error
    upper = information[:, *np.triu_indices(len(form.order))]
    return [_join(row) for row in np.hstack([form.pack(poses), upper])]


def _join(row: Array) -> str:
    return " ".join(map(repr, row.tolist()))
