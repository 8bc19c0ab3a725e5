"""How an update becomes rows of a map file."""

import sqlite3
from collections.abc import Iterable

from lifelong_slam.geometry import log
from lifelong_slam.graph.removal import Removal
from lifelong_slam.mapping import codec
from lifelong_slam.mapping.saved_map import MapUpdate, Scans


def write_update(db: sqlite3.Connection, update: MapUpdate) -> None:
    """Write an update, inside a transaction.

    Raises:
        ValueError: a pose is given for what is not a vertex, or a cloud can't be stored.
        sqlite3.IntegrityError: the update names what the map doesn't hold.
    """
    _write_keyframes(db, update)
    _write_graph(db, update)
    _write_clouds(db, update)
    _set_flag(db, "sessions", "located", update.located)


def _write_keyframes(db: sqlite3.Connection, update: MapUpdate) -> None:
    pack = codec.pack_matrix
    added = {keyframe.id for keyframe in update.keyframes}
    db.executemany(
        "INSERT INTO keyframes VALUES (?, ?, ?, ?)",
        ((k.id, k.session, k.stamp, k.travelled) for k in update.keyframes),
    )
    db.executemany(
        "INSERT INTO vertices VALUES (?, ?, ?, ?)",
        (
            (k.id, pack(update.poses[k.id]), pack(k.T_odom_sensor), pack(k.covariance))
            for k in update.keyframes
        ),
    )
    moved = [(pack(T), vertex) for vertex, T in update.poses.items() if vertex not in added]
    rows = db.executemany("UPDATE vertices SET T_map = ? WHERE id = ?", moved).rowcount
    if moved and rows != len(moved):
        raise ValueError("a pose is given for what is not a vertex")
    _delete(db, "vertices", (removal.vertex for removal in update.removed))
    db.executemany(
        "INSERT INTO removals (id, support) VALUES (?, ?)",
        ((removal.vertex, _pack_support(removal)) for removal in update.removed),
    )


def _write_graph(db: sqlite3.Connection, update: MapUpdate) -> None:
    pack = codec.pack_matrix
    _delete(db, "edges", update.removed_edges)
    db.executemany(
        "INSERT INTO edges VALUES (?, ?, ?, ?, FALSE, ?, ?) ON CONFLICT (id) DO UPDATE SET"
        " (source, target, kind, T_source_target, covariance)"
        " = (excluded.source, excluded.target, excluded.kind,"
        " excluded.T_source_target, excluded.covariance)",
        (
            (i, e.source, e.target, e.kind, pack(e.T_source_target), pack(e.covariance))
            for i, e in update.edges.items()
        ),
    )
    if update.rejected is not None:
        db.execute("UPDATE edges SET rejected = FALSE WHERE rejected")
        _set_flag(db, "edges", "rejected", update.rejected)


def _write_clouds(db: sqlite3.Connection, update: MapUpdate) -> None:
    features = ((k.id, codec.pack_points(k.features)) for k in update.keyframes)
    unsettled = ((k.id, codec.pack_points(k.points)) for k in update.keyframes if len(k.points))
    submaps = ((owner, codec.pack(arrays)) for owner, arrays in update.submaps.items())
    places = ((i, codec.pack_points(points)) for i, points in update.places.items())
    scans = ((s.session, s.anchor, _pack_scans(s)) for s in update.scans if len(s.stamps))
    _delete(db, "places", update.removed_places)
    for table, rows in (
        ("features", features),
        ("unsettled", unsettled),
        ("submaps", submaps),
        ("places", places),
    ):
        db.executemany(f"REPLACE INTO {table} VALUES (?, ?)", rows)
    _delete(db, "unsettled", update.settled)
    db.executemany("INSERT INTO scans (session, anchor, poses) VALUES (?, ?, ?)", scans)


def _pack_scans(scans: Scans) -> bytes:
    return codec.pack({"stamps": scans.stamps, "xi": log(scans.T_anchor_scan)})


def _pack_support(removal: Removal) -> bytes:
    return codec.pack(
        {
            "neighbours": removal.neighbours,
            "T_neighbour_vertex": removal.T_neighbour_vertex,
            "gains": removal.gains,
        }
    )


def _delete(db: sqlite3.Connection, table: str, ids: Iterable[int]) -> None:
    db.executemany(f"DELETE FROM {table} WHERE id = ?", ((i,) for i in ids))


def _set_flag(db: sqlite3.Connection, table: str, flag: str, ids: Iterable[int]) -> None:
    db.executemany(f"UPDATE {table} SET {flag} = TRUE WHERE id = ?", ((i,) for i in ids))
