"""Compares the vertices of two pose graphs, whatever order or format they came in."""

from collections.abc import Iterable, Mapping

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray

from eval.alignment import align

Array = NDArray[np.float64]


def vertex_distances(
    estimate: Mapping[int, Array],
    reference: Mapping[int, Array],
    vertices: Iterable[int],
    planar: bool = False,
) -> Array:
    """Return the (N,) distances in metres of vertices from where they should be, after alignment.

    Args:
        estimate: T_map_vertex (4, 4) by id.
        reference: the same, true or of another graph.
        vertices: N ids that both have; they alone are aligned.
        planar: align in the plane, where a rotation in space could mirror the map.
    """
    ids = list(vertices)
    ours, theirs = (_path([poses[i] for i in ids]) for poses in (estimate, reference))
    aligned = align(ours, theirs, "yaw" if planar else "se3").move(ours.positions_xyz)
    distances: Array = np.linalg.norm(aligned - theirs.positions_xyz, axis=1)
    return distances


def rmse(distances: Array) -> float:
    """Return the root mean square: the APE, of distances from the truth."""
    return float(np.sqrt(np.mean(distances**2)))


def _path(poses: list[Array]) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=poses, timestamps=np.arange(float(len(poses))))
