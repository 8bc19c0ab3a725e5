"""True poses of a pose graph's vertices, from the kinds of files in which they come."""

import logging
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lifelong_slam.errors import SourceError
from lifelong_slam.graph.initialisation import chained
from lifelong_slam.graph.topology import edge_kinds
from lifelong_slam.io.g2o import read_g2o
from lifelong_slam.io.g2o_format import planar_poses
from lifelong_slam.result import Edge
from lifelong_slam.trajectory import read_tum

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

_TORO = {"EDGE2": 3, "EDGE3": 6}  # numbers of a motion: x y theta, x y z roll pitch yaw


def read_truth(path: Path, vertices: Collection[int]) -> dict[int, Array]:
    """Return the true poses (4, 4) of some vertices, and warn of those that the file lacks.

    Args:
        path: a g2o file, whose vertices are taken or, if it has none, chained from its edges; edges between
            true poses as TORO writes them, ``EDGE2`` or ``EDGE3``; or a TUM trajectory with a row
            for each vertex, by id.
        vertices: ids.

    Raises:
        SourceError: the file is missing or malformed, or has none of the vertices.
    """
    if not path.is_file():
        raise SourceError(f"no such file with true poses: {path}")
    ids = sorted(vertices)
    kind = _first_word(path)
    if kind in _TORO:
        poses = _read_toro(path)
    elif kind.startswith(("VERTEX", "EDGE", "FIX", "PARAMS")):
        poses = read_g2o(path).poses
    else:
        rows = read_tum(path).poses
        if len(rows) != len(ids):
            raise SourceError(f"{path} has {len(rows)} rows for {len(ids)} vertices")
        poses = dict(zip(ids, rows, strict=True))
    missing = set(ids) - set(poses)
    if missing:
        lack = f"{path} lacks {len(missing)} of {len(ids)} vertices, such as {min(missing)}"
        if len(missing) == len(ids):
            raise SourceError(lack)
        logger.warning("%s: the other %d are judged", lack, len(ids) - len(missing))
    return {vertex: poses[vertex] for vertex in ids if vertex in poses}


def _first_word(path: Path) -> str:
    """Return the first word of a text file that isn't part of a comment."""
    try:
        for line in path.read_text().splitlines():
            if line.strip() and not line.startswith("#"):
                return line.split()[0]
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is no text: expected true poses") from error
    raise SourceError(f"{path} is empty: expected true poses")


def _read_toro(path: Path) -> dict[int, Array]:
    motions: list[tuple[int, int, Array]] = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        tag, *fields = line.split() or [""]
        if tag in _TORO:
            try:
                motion = _motion(np.array([float(f) for f in fields[2 : 2 + _TORO[tag]]]))
                motions.append((int(fields[0]), int(fields[1]), motion))
            except (ValueError, IndexError) as error:
                raise SourceError(f"{path}, line {number}: not a valid {tag}") from error
    ends = [(source, target) for source, target, _ in motions]
    kinds = edge_kinds(ends, list(dict.fromkeys(vertex for pair in ends for vertex in pair)))
    nothing = np.zeros((6, 6))  # between true poses there is no error
    try:
        return chained([Edge(*m, nothing, kind) for m, kind in zip(motions, kinds, strict=True)])
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error


def _motion(values: Array) -> Array:
    """Return the (4, 4) pose of x y theta or of x y z roll pitch yaw."""
    if len(values) == 3:
        T: Array = planar_poses(values[None])[0]
        return T
    if len(values) != 6:
        raise ValueError("too few numbers")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", values[:2:-1]).as_matrix()
    T[:3, 3] = values[:3]
    return T
