"""Whether a map file holds together: what SQLite can tell, and what only SLAM knows."""

import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import MapError
from lifelong_slam.graph.initialisation import connected
from lifelong_slam.graph.removal import Removal
from lifelong_slam.mapping import codec, map_file
from lifelong_slam.mapping.map_reading import (
    unpack_covariance,
    unpack_pose,
    unpack_scans,
    unpack_support,
    unpack_voxels,
)
from lifelong_slam.mapping.saved_map import Array, SavedMap
from lifelong_slam.mapping.store import MapStore

_RIGID = 1e-6  # largest entry of R^T R - I; that of optimised poses is below 1e-12
_WHOLE = 1e-6  # largest entry of a sum of gains less the identity
_BLOBS: dict[str, dict[str, Callable[[bytes], Any]]] = {
    "map": {"T_base_sensor": unpack_pose},
    "vertices": {"T_map": unpack_pose, "T_odom": unpack_pose, "covariance": unpack_covariance},
    "removals": {"support": unpack_support},
    "edges": {"T_source_target": unpack_pose, "covariance": unpack_covariance},
    "features": {"points": codec.unpack_points},
    "unsettled": {"points": codec.unpack_points},
    "submaps": {"voxels": unpack_voxels},
    "scans": {"poses": unpack_scans},
    "places": {"points": codec.unpack_points},
}


def check_map(path: Path) -> list[str]:
    """Return what is wrong with a map, in words; the file stays as it is.

    Deeper problems are looked for only where those below them are absent: first SQLite's pages and
    references, then each blob, then poses, covariances and removals, then how all hangs together.

    Raises:
        MapError: it is not a map that this version reads, or a writer has it open.
    """
    connection = map_file.connect_to_check(path)
    with MapStore(path, connection) as store, map_file.errors_of(path):
        return (
            list(_database(connection))
            or list(_blobs(connection))
            or list(_keyframes(connection))
            or _slam(store.load())
        )


def _database(db: sqlite3.Connection) -> Iterator[str]:
    for (verdict,) in db.execute("PRAGMA integrity_check"):
        if verdict != "ok":
            yield from verdict.splitlines()
    for table, row, referenced, _ in db.execute("PRAGMA foreign_key_check"):
        yield f"{table} {row} names an entry that is not in {referenced}"


def _blobs(db: sqlite3.Connection) -> Iterator[str]:
    for table, columns in _BLOBS.items():
        for column, decode in columns.items():
            for row, blob in db.execute(f"SELECT rowid, {column} FROM {table}"):
                try:
                    decode(blob)
                except ValueError as error:
                    yield f"{table} {row}, {column}: {error}"


def _keyframes(db: sqlite3.Connection) -> Iterator[str]:
    """Check that each keyframe is either a vertex with features or removed."""
    (count,) = db.execute("SELECT count(*) FROM map").fetchone()
    if count != 1:
        yield f"table map has {count} rows instead of one"
    vertices, removed = "(SELECT id FROM vertices)", "(SELECT id FROM removals)"
    query = f"SELECT id FROM keyframes WHERE (id IN {vertices}) = (id IN {removed})"
    for (i,) in db.execute(query):
        yield f"keyframe {i} must be either a vertex or removed"
    for (i,) in db.execute("SELECT id FROM vertices EXCEPT SELECT id FROM features"):
        yield f"vertex {i} has no features"


def _slam(saved: SavedMap) -> list[str]:
    return list(_content(saved)) or [*_recovery(saved), *_sessions(saved)]


def _content(saved: SavedMap) -> Iterator[str]:
    keyframes, edges = saved.keyframes, saved.edges
    yield from _not_rigid("sensor on base", {0: saved.info.T_base_sensor})
    yield from _not_rigid("pose of vertex", saved.poses)
    yield from _not_rigid("odometry of vertex", {i: k.T_odom_sensor for i, k in keyframes.items()})
    yield from _not_rigid("measurement of edge", {i: e.T_source_target for i, e in edges.items()})
    # That of a session's first keyframe, which defines its odometry, is zero.
    yield from _no_covariance("vertex", {i: k.covariance for i, k in keyframes.items()}, True)
    yield from _no_covariance("edge", {i: e.covariance for i, e in edges.items()}, False)
    for i, scans in enumerate(saved.scans):
        if scans.T_anchor_scan.shape != (len(scans.stamps), 4, 4):
            yield f"scans {i}: stamps and poses differ in number"
        elif not np.isfinite(scans.T_anchor_scan).all():
            yield f"scans {i}: a pose is not finite"
    yield from _removals(saved.removals)


def _not_rigid(name: str, poses: dict[int, Array]) -> Iterator[str]:
    if not poses:
        return
    for i, rigid in zip(poses, _rigid(np.stack(list(poses.values()))), strict=True):
        if not rigid:
            yield f"{name} {i}: not a rigid motion"


def _rigid(T: Array) -> NDArray[np.bool_]:
    """Tell which of (N, 4, 4) matrices are poses."""
    T = np.where(np.isfinite(T).all(axis=(1, 2), keepdims=True), T, 0.0)
    R = T[:, :3, :3]
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    last_row = np.all(T[:, 3] == [0, 0, 0, 1], axis=1)
    rigid: NDArray[np.bool_] = (error < _RIGID) & (np.linalg.det(R) > 0) & last_row
    return rigid


def _no_covariance(name: str, covariances: dict[int, Array], singular: bool) -> Iterator[str]:
    """Check covariances, which may be singular or must be definite."""
    if not covariances:
        return
    C = np.stack(list(covariances.values()))
    finite = np.isfinite(C).all(axis=(1, 2))
    C[~finite] = 0.0
    symmetric = np.isclose(C, np.swapaxes(C, 1, 2), rtol=1e-6, atol=0).all(axis=(1, 2))
    eigenvalues = np.linalg.eigvalsh(C)
    least, rounding = eigenvalues[:, 0], 1e-12 * eigenvalues[:, -1]
    fine = finite & symmetric & (least >= -rounding if singular else least > 0)
    for i in np.array(list(covariances))[~fine].tolist():
        yield f"covariance of {name} {i}: not symmetric and positive {'semi' if singular else ''}definite"


def _removals(removals: list[Removal]) -> Iterator[str]:
    """Check by which poses and gains removed keyframes hang on others."""
    if not removals:
        return
    rigid = _rigid(np.concatenate([removal.T_neighbour_vertex for removal in removals]))
    first = np.cumsum([0, *(len(removal.neighbours) for removal in removals[:-1])])
    all_rigid = np.logical_and.reduceat(rigid, first)
    sums = np.stack([removal.gains.sum(axis=0) for removal in removals])
    off = np.abs(sums - np.eye(6)).max(axis=(1, 2))
    for removal, fine, error in zip(removals, all_rigid, off, strict=True):
        if not fine:
            yield f"keyframe {removal.vertex}: its pose by a neighbour is not a rigid motion"
        if not error < _WHOLE:
            yield f"keyframe {removal.vertex}: its gains don't sum to the identity"


def _recovery(saved: SavedMap) -> Iterator[str]:
    """Check that removed keyframes hang on what is there or was removed later."""
    try:
        saved.keyframe_poses()
    except MapError as error:
        yield str(error)


def _sessions(saved: SavedMap) -> Iterator[str]:
    """Check that each session hangs together, and with an earlier one if it is said to be located."""
    part = _parts(saved)
    known: set[int] = set()
    for session in saved.sessions:
        own = {part[i] for i, keyframe in saved.keyframes.items() if keyframe.session == session.id}
        if len(own) > 1:
            yield f"session {session.id}: its vertices fall into {len(own)} unconnected parts"
        elif session.located and own and known and not own <= known:
            yield f"session {session.id} counts as located, but no edges join it to earlier ones"
        known |= own


def _parts(saved: SavedMap) -> dict[int, int]:
    """Return the number of the connected part of the graph that each vertex is in."""
    parts = connected(saved.graph())
    return {vertex: number for number, part in enumerate(parts) for vertex in part}
