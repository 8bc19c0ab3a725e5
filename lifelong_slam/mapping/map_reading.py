"""How rows of a map file become a map."""

import math
import sqlite3
from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import MapError
from lifelong_slam.geometry import exp
from lifelong_slam.graph.removal import Removal
from lifelong_slam.mapping import codec
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.mapping.saved_map import Array, Arrays, MapInfo, SavedMap, Scans, Session
from lifelong_slam.mapping.submap import Submap
from lifelong_slam.result import Edge

_Decoded = TypeVar("_Decoded")

_FARTHEST = 1e8  # metres
_SCANS: codec.Layout = {"stamps": ("<i8", ()), "xi": ("<f8", (6,))}
_SUPPORT: codec.Layout = {
    "neighbours": ("<i8", ()),
    "T_neighbour_vertex": ("<f8", (4, 4)),
    "gains": ("<f8", (6, 6)),
}
_VOXELS: codec.Layout = {
    "keys": ("<i8", ()),
    "means": ("<f4", (3,)),
    "weights": ("|u1", ()),
    "scores": ("|i1", ()),
}


def read_map(db: sqlite3.Connection) -> SavedMap:
    """Read all of a map, inside a transaction.

    Raises:
        MapError: a blob is damaged, or a row names one that isn't there; the message names table and row.
    """
    check_references(db)
    return SavedMap(
        info=read_info(db),
        sessions=list(_sessions(db)),
        keyframes={keyframe.id: keyframe for keyframe in _keyframes(db)},
        poses=_column(db, "vertices", "T_map", unpack_pose),
        edges=dict(_edges(db)),
        rejected=frozenset(i for (i,) in db.execute("SELECT id FROM edges WHERE rejected")),
        removals=list(_removals(db)),
        scans=list(_scans(db)),
        submaps=_column(db, "submaps", "voxels", unpack_voxels),
        places=_column(db, "places", "points", codec.unpack_points),
    )


def check_references(db: sqlite3.Connection) -> None:
    """Raise MapError if a row names an entry of another table that isn't there."""
    for table, row, referenced, _ in db.execute("PRAGMA foreign_key_check"):
        raise MapError(f"{table} {row} names an entry that is not in {referenced}")


def unpack_pose(blob: bytes) -> Array:
    """Read a (4, 4) pose; raises ValueError if it is damaged."""
    T = codec.unpack_matrix(blob, 4)
    if not (np.abs(T) < _FARTHEST).all():
        raise ValueError("it is not finite, or off the Earth")
    return T


def unpack_covariance(blob: bytes) -> Array:
    """Read a (6, 6) covariance; raises ValueError if it is damaged."""
    return codec.unpack_matrix(blob, 6)


def unpack_scans(blob: bytes) -> tuple[NDArray[np.int64], Array]:
    """Read (N,) stamps and (N, 4, 4) poses; raises ValueError if they are damaged."""
    arrays = codec.unpack(blob, _SCANS)
    stamps, xi = arrays["stamps"].astype(np.int64), arrays["xi"].astype(np.float64)
    if len(stamps) != len(xi):
        raise ValueError("stamps and poses differ in number")
    return stamps, exp(xi)


def unpack_voxels(blob: bytes) -> Arrays:
    """Read the arrays of a `Submap`; raises ValueError if they are damaged."""
    arrays = codec.unpack(blob, _VOXELS)
    Submap(**arrays)  # type: ignore[arg-type]
    if not (np.abs(arrays["means"]) < _FARTHEST).all():
        raise ValueError("a mean is not finite, or off the Earth")
    return arrays


def unpack_support(blob: bytes) -> tuple[NDArray[np.int64], Array, Array]:
    """Read (k,) neighbours, (k, 4, 4) poses and (k, 6, 6) gains; raises ValueError if damaged."""
    arrays = codec.unpack(blob, _SUPPORT)
    neighbours = arrays["neighbours"].astype(np.int64)
    poses = arrays["T_neighbour_vertex"].astype(np.float64)
    gains = arrays["gains"].astype(np.float64)
    k = len(neighbours)
    if k == 0 or poses.shape != (k, 4, 4) or gains.shape != (k, 6, 6):
        raise ValueError("it needs a pose and a gain for each of one or more neighbours")
    return neighbours, poses, gains


def read_info(db: sqlite3.Connection) -> MapInfo:
    """Read what holds for a map as a whole; raises MapError if it is damaged."""
    poses = [*_column(db, "map", "T_base_sensor", unpack_pose).values()]
    rows = db.execute("SELECT sensor, voxel_size, created, version FROM map").fetchall()
    if len(rows) != 1:
        raise MapError(f"table map has {len(rows)} rows instead of one")
    sensor, voxel_size, created, version = rows[0]
    if not 0 < voxel_size < math.inf:
        raise MapError(f"map 1: the edge of a voxel is {voxel_size} m")
    return MapInfo(sensor, poses[0], voxel_size, created, version)


def _sessions(db: sqlite3.Connection) -> Iterator[Session]:
    rows = db.execute(
        "SELECT id, started, source, config, finished, located FROM sessions ORDER BY id"
    )
    for id, started, source, config, finished, located in rows:
        yield Session(id, started, source, config, bool(finished), bool(located))


def _keyframes(db: sqlite3.Connection) -> Iterator[Keyframe]:
    T_odom = _column(db, "vertices", "T_odom", unpack_pose)
    covariance = _column(db, "vertices", "covariance", unpack_covariance)
    features = _column(db, "features", "points", codec.unpack_points)
    unsettled = _column(db, "unsettled", "points", codec.unpack_points)
    nothing = np.zeros((0, 3), np.float32)
    rows = db.execute(
        "SELECT id, session, stamp, travelled FROM vertices JOIN keyframes USING (id) ORDER BY id"
    )
    for id, session, stamp, travelled in rows:
        yield Keyframe(
            id=id,
            session=session,
            stamp=stamp,
            T_odom_sensor=T_odom[id],
            covariance=covariance[id],
            travelled=travelled,
            features=features.get(id, nothing),
            points=unsettled.get(id, nothing),
        )


def _edges(db: sqlite3.Connection) -> Iterator[tuple[int, Edge]]:
    T = _column(db, "edges", "T_source_target", unpack_pose)
    covariance = _column(db, "edges", "covariance", unpack_covariance)
    rows = db.execute("SELECT id, source, target, kind FROM edges ORDER BY id")
    for id, source, target, kind in rows:
        yield id, Edge(source, target, T[id], covariance[id], kind)


def _removals(db: sqlite3.Connection) -> Iterator[Removal]:
    support = _column(db, "removals", "support", unpack_support)
    for number, id in db.execute("SELECT number, id FROM removals ORDER BY number"):
        yield Removal(id, *support[number])


def _scans(db: sqlite3.Connection) -> Iterator[Scans]:
    poses = _column(db, "scans", "poses", unpack_scans)
    for id, session, anchor in db.execute("SELECT id, session, anchor FROM scans ORDER BY id"):
        yield Scans(session, anchor, *poses[id])


def _column(
    db: sqlite3.Connection, table: str, column: str, decode: Callable[[bytes], _Decoded]
) -> dict[int, _Decoded]:
    """Decode a column of blobs, by rowid and in its order."""
    decoded = {}
    for id, blob in db.execute(f"SELECT rowid, {column} FROM {table} ORDER BY rowid"):
        try:
            decoded[id] = decode(blob)
        except ValueError as error:
            raise MapError(f"{table} {id}, {column}: {error}") from error
    return decoded
