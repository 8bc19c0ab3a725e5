"""What the tests of saved maps share: a sensor that drives through boxes, written keyframe by keyframe."""

import hashlib
import os
import signal
import sqlite3
from contextlib import closing
from dataclasses import fields, is_dataclass

import numpy as np

from lifelong_slam.geometry import exp
from lifelong_slam.graph.removal import Removal
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.mapping.saved_map import MapUpdate, Scans
from lifelong_slam.mapping.store import MapStore
from lifelong_slam.result import Edge

STEP = np.array([0.0, 0.01, 0.1, 2.0, 0.1, 0.02])
T_BASE_SENSOR = exp(np.array([0.02, 0.1, 0.3, 1.0, 0.2, 1.8]))
START = 1_700_000_000_123_456_789
PERIOD = 100_000_000
SCANS = 4  # for each keyframe


def covariance(rng, scale=1e-3):
    A = rng.normal(size=(6, 6)) * scale
    return A @ A.T + np.eye(6) * scale**2


def cloud(rng, count):
    return (rng.uniform(-1, 1, (count, 3)) * [60, 60, 5]).astype(np.float32)


def keyframe(i, session=0, points=300, seed=0):
    rng = np.random.default_rng([seed, session, i])
    return Keyframe(
        id=i,
        session=session,
        stamp=START + session * 10**13 + i * SCANS * PERIOD,
        T_odom_sensor=exp(i * STEP),
        covariance=covariance(rng),
        travelled=2.0 * i,
        features=cloud(rng, points // 5),
        points=cloud(rng, points),
    )


def edge(source, target, kind="odometry", seed=0):
    rng = np.random.default_rng([seed, source, target])
    return Edge(source, target, exp((target - source) * STEP), covariance(rng), kind)


def removal(i, *neighbours, seed=0):
    """That of keyframe i from a straight drive."""
    rng = np.random.default_rng([seed, i])
    gains = rng.normal(size=(len(neighbours), 6, 6))
    gains[-1] = np.eye(6) - gains[:-1].sum(axis=0)
    T = np.stack([exp((i - neighbour) * STEP) for neighbour in neighbours])
    return Removal(i, np.array(neighbours, dtype=np.int64), T, gains)


def scans(i, session=0):
    """Those that follow keyframe i."""
    stamps = START + session * 10**13 + (i * SCANS + np.arange(SCANS)) * PERIOD
    return Scans(session, i, stamps, exp(np.arange(SCANS)[:, None] / SCANS * STEP))


def drive(i, session=0, start=0, points=300, **changes):
    """All that the i-th keyframe of a straight drive adds to the map."""
    new = keyframe(i, session, points)
    edges = {} if i == start else {i: edge(i - 1, i)}
    return MapUpdate(
        keyframes=[new],
        poses={i: new.T_odom_sensor} | changes.pop("poses", {}),
        edges=edges | changes.pop("edges", {}),
        scans=[scans(i, session)],
        **changes,
    )


def voxels(rng, count=50):
    return {
        "keys": np.sort(rng.choice(2**62, count, replace=False)),
        "means": cloud(rng, count),
        "weights": rng.integers(1, 100, count).astype(np.uint8),
        "scores": rng.integers(-3, 8, count).astype(np.int8),
    }


def new_store(path):
    return MapStore.create(path, "hdl64", T_BASE_SENSOR, 0.2)


def new_map(path, count=5):
    """Write a map of one finished session."""
    with new_store(path) as store:
        session = store.begin_session("simulated", "seed: 1\n")
        for i in range(count):
            store.write(drive(i))
        store.end_session(session)


def make_older(path, version):
    """Turn a map into one of an older format.

    The second one had no generations; in the first one edges were odometry or loop closures.
    """
    with closing(sqlite3.connect(path)) as db:
        db.executescript(
            "ALTER TABLE map DROP COLUMN generation; ALTER TABLE map DROP COLUMN parent;"
            f"PRAGMA user_version = {version}"
        )
        if version == 1:
            (table,) = db.execute("SELECT sql FROM sqlite_master WHERE name = 'edges'").fetchone()
            old_table = table.replace(", 'composed'", "")
            db.executescript(
                "PRAGMA foreign_keys = OFF; CREATE TABLE kept AS SELECT * FROM edges;"
                f"DROP TABLE edges; {old_table};"
                "INSERT INTO edges SELECT * FROM kept; DROP TABLE kept;"
                "CREATE INDEX edges_of_source ON edges (source);"
                "CREATE INDEX edges_of_target ON edges (target)"
            )


def write_until_killed(path, pipe):
    """Add short sessions to a map, and a byte to the pipe after each keyframe that is written."""
    while True:
        with MapStore.open(path) as store:
            first = store.load().next_keyframe
            session = store.begin_session("short", "")
            vertices = []
            for i in range(first, first + 8):
                vertices.append(i)
                store.write(eventful(session, vertices))
                os.write(pipe, b".")


def write_and_die(path):
    """Add a session of one keyframe to a map of five, and end without closing it."""
    store = MapStore.open(path)
    store.write(drive(5, store.begin_session("short", ""), start=5))
    os.kill(os.getpid(), signal.SIGKILL)


def open_and_close(path):
    """Do nothing but switch the file between being written and at rest."""
    while True:
        MapStore.open(path).close()


def eventful(session, vertices):
    """What the newest of a session's vertices changes, and each third time the removal of another.

    An edge has the id of its target, save the one that joins the session to vertex 0.
    """
    first, i = vertices[0], vertices[-1]
    rng = np.random.default_rng(i)
    edges = {10**6 + i: edge(0, i, "loop")} if i == first else {}
    removed = []
    if i % 3 == 0 and len(vertices) > 4:
        gone = vertices.pop(-3)
        before, after = vertices[-3:-1]
        edges[after] = edge(before, after)
        removed.append(removal(gone, before, after))
    return drive(
        i,
        session,
        first,
        points=3000,
        poses={v: exp(v * STEP + rng.normal(size=6) * 1e-3) for v in vertices},
        edges=edges,
        removed=removed,
        removed_edges=[r.vertex for r in removed],
        submaps={i: voxels(rng)},
        places={i: cloud(rng, 200)},
    )


def load(path):
    with MapStore.open(path, read_only=True) as store:
        return store.load()


def contents(folder):
    """A hash of each file in a folder."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}


def lasting(folder):
    """The same without the index of SQLite's log, which any reader may make anew after a crash."""
    return {name: digest for name, digest in contents(folder).items() if not name.endswith("-shm")}


def assert_same(one, other):
    """Compare nested dataclasses, mappings and lists with arrays in them, to the last digit."""
    assert type(one) is type(other)
    if is_dataclass(one):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other
