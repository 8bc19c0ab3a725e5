"""The map file: what is written is read, a kill costs one keyframe, what is no map is left alone."""

import hashlib
import multiprocessing
import os
import random
import re
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from map_support import (
    START,
    STEP,
    T_BASE_SENSOR,
    cloud,
    drive,
    edge,
    keyframe,
    new_map,
    new_store,
    open_and_close,
    removal,
    scans,
    voxels,
    write_and_die,
    write_until_killed,
)
from scipy.spatial import cKDTree

from lifelong_slam import __version__
from lifelong_slam.errors import MapError
from lifelong_slam.geometry import exp
from lifelong_slam.mapping import codec
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.mapping.saved_map import MapUpdate, Scans
from lifelong_slam.mapping.store import MapStore


@pytest.fixture
def path(tmp_path):
    return tmp_path / "place.map"


def load(path):
    with MapStore.open(path, read_only=True) as store:
        return store.load()


def contents(folder):
    """A hash of each file in a folder."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}


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


# --- blobs


@given(
    hnp.arrays(
        dtype=st.one_of(
            hnp.integer_dtypes(), hnp.floating_dtypes(sizes=(32, 64)), hnp.boolean_dtypes()
        ),
        shape=hnp.array_shapes(min_dims=0, min_side=0, max_side=5),
    )
)
def test_arrays_come_back_as_they_were(array):
    (name, unpacked), *more = codec.unpack(codec.pack({"a": array})).items()
    assert (name, more) == ("a", [])
    assert unpacked.dtype == array.dtype.newbyteorder("<")
    np.testing.assert_array_equal(unpacked, array)


def test_arrays_keep_their_names_apart():
    arrays = voxels(np.random.default_rng(1))
    unpacked = codec.unpack(codec.pack(arrays))
    assert_same(unpacked, arrays)
    assert all(array.flags.writeable for array in unpacked.values())


@settings(deadline=None)
@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(0, 40), st.just(3)),
        elements=st.floats(-900, 900, width=32),
    )
)
def test_points_come_back_to_half_a_millimetre_in_any_order(points):
    unpacked = codec.unpack_points(codec.pack_points(points))
    assert unpacked.shape == points.shape
    assert unpacked.dtype == np.float32
    if len(points):
        error = 0.5 * codec.POINT_RESOLUTION * np.sqrt(3) + 2e-4  # and that of float32 at 900 m
        assert cKDTree(unpacked).query(points)[0].max() < error
        assert cKDTree(points).query(unpacked)[0].max() < error


def test_packing_points_again_loses_nothing_more():
    blob = codec.pack_points(cloud(np.random.default_rng(0), 5000))
    assert codec.pack_points(codec.unpack_points(blob)) == blob


def test_points_on_surfaces_take_less_than_half_of_float32():
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-40, 40, (20_000, 2)), rng.normal(0, 0.02, 20_000)])
    points = ground.astype(np.float32)
    assert len(codec.pack_points(points)) < 0.5 * points.nbytes


@pytest.mark.parametrize(
    ("value", "message"), [(np.nan, "finite"), (np.inf, "finite"), (3000.0, "2097 m")]
)
def test_points_that_cannot_be_stored_are_refused(value, message):
    points = np.zeros((4, 3), np.float32)
    points[2, 1] = value
    with pytest.raises(ValueError, match=message):
        codec.pack_points(points)


def test_every_flipped_bit_of_a_blob_is_noticed():
    blob = codec.pack_points(cloud(np.random.default_rng(0), 10))
    for bit in range(8 * len(blob)):
        damaged = bytearray(blob)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ValueError, match="checksum"):
            codec.unpack_points(bytes(damaged))


# --- what is written is read


def test_a_new_map_is_empty_and_knows_its_sensor(path):
    before = time.time_ns()
    new_store(path).close()
    saved = load(path)
    assert (saved.info.sensor, saved.info.voxel_size) == ("hdl64", 0.2)
    assert saved.info.version == __version__
    assert before <= saved.info.created <= time.time_ns()
    np.testing.assert_array_equal(saved.info.T_base_sensor, T_BASE_SENSOR)
    assert (saved.sessions, saved.poses, saved.next_keyframe) == ([], {}, 0)
    assert len(saved.trajectory()) == 0
    assert check_map(path) == []


def test_keyframes_edges_and_scans_come_back(path):
    new_map(path, 5)
    saved = load(path)
    assert list(saved.keyframes) == list(range(5))
    for i, found in saved.keyframes.items():
        expected = keyframe(i)
        assert (found.id, found.session, found.stamp) == (i, 0, expected.stamp)
        assert found.travelled == expected.travelled
        np.testing.assert_array_equal(found.T_odom_sensor, expected.T_odom_sensor)
        np.testing.assert_array_equal(found.covariance, expected.covariance)
        for one, other in ((found.points, expected.points), (found.features, expected.features)):
            assert one.shape == other.shape
            assert cKDTree(one).query(other)[0].max() < codec.POINT_RESOLUTION
        np.testing.assert_array_equal(saved.poses[i], expected.T_odom_sensor)
    assert_same(saved.edges, {i: edge(i - 1, i) for i in range(1, 5)})
    for i, found in enumerate(saved.scans):
        np.testing.assert_array_equal(found.stamps, scans(i).stamps)
        np.testing.assert_allclose(found.T_anchor_scan, scans(i).T_anchor_scan, atol=1e-14)


def test_sessions_are_numbered_and_only_the_first_is_located_by_itself(path):
    new_map(path)
    with MapStore.open(path) as store:
        assert store.begin_session("second", "a: 1\n") == 1
    first, second = load(path).sessions
    assert (first.source, first.config) == ("simulated", "seed: 1\n")
    assert (first.finished, first.located) == (True, True)
    assert (second.source, second.finished, second.located) == ("second", False, False)
    with MapStore.open(path) as store:
        store.write(drive(5, 1, start=5, edges={5: edge(2, 5, "loop")}, located=[1]))
        store.end_session(1)
    assert load(path).sessions[1].located
    assert load(path).sessions[1].finished
    assert check_map(path) == []


def test_poses_edges_submaps_and_places_can_change(path):
    rng = np.random.default_rng(3)
    new_map(path)
    first, second = voxels(rng), voxels(rng, 20)
    place = cloud(rng, 30)
    moved = {1: exp(STEP * 1.5), 3: exp(STEP * 3.5)}
    with MapStore.open(path) as store:
        before = store.load()
        store.write(MapUpdate(submaps={1: first, 2: first}, places={0: place, 4: place}))
        store.write(
            MapUpdate(
                poses=moved,
                submaps={2: second},
                removed_places=[0],
                edges={2: edge(1, 2, seed=9), 7: edge(0, 4, "loop"), 8: edge(1, 4, "loop")},
                removed_edges=[4],
                rejected=[7, 8],
            )
        )
        store.write(MapUpdate(rejected=[8]))
        store.write(MapUpdate(edges={8: edge(1, 4, "loop", seed=5)}))  # changed, and still outvoted
    saved = load(path)
    assert_same(saved.poses, before.poses | moved)
    assert_same(saved.submaps, {1: first, 2: second})
    assert list(saved.places) == [4]
    assert_same(saved.edges[2], edge(1, 2, seed=9))
    assert set(saved.edges) == {1, 2, 3, 7, 8}
    assert saved.rejected == {8}
    assert len(saved.graph().edges) == 4


def test_a_settled_keyframe_keeps_only_its_features(path):
    new_map(path)
    with MapStore.open(path) as store:
        store.write(MapUpdate(settled=[2], submaps={1: voxels(np.random.default_rng(0))}))
    saved = load(path)
    assert len(saved.keyframes[2].points) == 0
    assert len(saved.keyframes[2].features) == 60
    assert len(saved.keyframes[1].points) == 300
    assert check_map(path) == []


def test_scans_of_removed_keyframes_move_with_what_they_hang_on(path):
    new_map(path, 5)
    with MapStore.open(path) as store:
        straight = store.load().trajectory()
        store.write(
            MapUpdate(
                removed=[removal(2, 3)],
                removed_edges=[2, 3],
                edges={3: edge(1, 3)},
                submaps={3: voxels(np.random.default_rng(0))},
            )
        )
        store.write(
            MapUpdate(
                removed=[removal(3, 4)],
                removed_edges=[3, 4],
                edges={4: edge(1, 4)},
            )
        )
        unmoved = store.load()
        shift = exp(np.array([0, 0, 0, 0, 1.0, 0]))
        store.write(MapUpdate(poses={4: shift @ unmoved.poses[4]}))
    saved = load(path)
    assert set(saved.keyframes) == {0, 1, 4}
    assert saved.submaps == {}  # that of 3 went with it
    assert saved.next_keyframe == 5
    np.testing.assert_allclose(unmoved.trajectory().poses, straight.poses, atol=1e-12)
    moved = saved.trajectory()
    np.testing.assert_array_equal(moved.stamps, straight.stamps)
    np.testing.assert_allclose(moved.poses[:8], straight.poses[:8], atol=1e-12)
    np.testing.assert_allclose(moved.poses[8:], shift @ straight.poses[8:], atol=1e-12)
    assert check_map(path) == []


def test_removals_come_back_in_their_order_over_all_sessions(path):
    new_map(path, 5)
    first, second, third = [removal(3, 2, 4), removal(1, 0, 2)], [removal(4, 2)], [removal(2, 0)]
    with MapStore.open(path) as store:
        store.write(MapUpdate(removed=first, removed_edges=[1, 2, 3, 4], edges={9: edge(0, 2)}))
        store.write(drive(5, store.begin_session("second", ""), start=5, removed=second))
        store.write(MapUpdate(removed=third, removed_edges=[9]))
        straight = store.load().keyframe_poses()
    saved = load(path)
    assert_same(saved.removals, first + second + third)
    assert saved.next_keyframe == 6
    assert straight.keys() == set(range(6))
    for i, pose in straight.items():
        np.testing.assert_allclose(pose, exp(i * STEP), atol=1e-12)


def test_a_trajectory_can_be_that_of_one_session(path):
    new_map(path, 3)
    with MapStore.open(path) as store:
        session = store.begin_session("second", "")
        store.write(drive(3, session, start=3))
    saved = load(path)
    first, second = saved.of_sessions([0]), saved.of_sessions([1])
    np.testing.assert_array_equal(second.trajectory().stamps, scans(3, 1).stamps)
    assert first.trajectory().stamps[0] == START
    assert len(saved.trajectory()) == len(first.trajectory()) + len(second.trajectory())
    assert set(first.graph().poses) == {0, 1, 2}
    assert len(first.graph().edges) == 2
    assert set(second.graph().poses) == {3}
    with pytest.raises(MapError, match="no session 2"):
        saved.of_sessions([2])
    with MapStore.open(path) as store:
        store.write(MapUpdate(scans=[Scans(1, 0, scans(0).stamps, scans(0).T_anchor_scan)]))
    with pytest.raises(MapError, match="same stamps"):
        load(path).trajectory()


# --- a transaction is written as a whole


@pytest.mark.parametrize(
    ("update", "error"),
    [
        (MapUpdate(edges={1: edge(0, 99)}), sqlite3.IntegrityError),
        (
            MapUpdate(edges={9: edge(0, 2)}, removed=[removal(3, 2)]),
            sqlite3.IntegrityError,
        ),
        (MapUpdate(poses={0: exp(STEP), 77: np.eye(4)}), ValueError),
        (
            MapUpdate(poses={0: exp(STEP)}, places={1: np.full((1, 3), np.nan, np.float32)}),
            ValueError,
        ),
        (drive(4), sqlite3.IntegrityError),
    ],
)
def test_an_update_that_does_not_fit_changes_nothing(path, update, error):
    new_map(path)
    before = load(path)
    with MapStore.open(path) as store:
        with pytest.raises(error):
            store.write(update)
        assert_same(store.load(), before)
        store.write(drive(5))
    assert check_map(path) == []


def run_and_kill(seconds, target, *arguments):
    child = multiprocessing.get_context("fork").Process(target=target, args=arguments)
    child.start()
    time.sleep(seconds)
    child.kill()
    child.join()


def kill_a_writer(path, seconds):
    """Have a child write to a map, kill it, and return how many keyframes it said to have written."""
    ours, theirs = os.pipe()
    run_and_kill(seconds, write_until_killed, path, theirs)
    os.close(theirs)
    written = 0
    while block := os.read(ours, 1 << 16):
        written += len(block)
    os.close(ours)
    return written


@pytest.mark.parametrize("kills", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_a_killed_writer_loses_at_most_the_keyframe_in_flight(path, kills):
    random.seed(kills)
    new_map(path)
    total = first = load(path).next_keyframe
    for _ in range(kills):
        written = kill_a_writer(path, random.uniform(0.0, 0.3))
        assert check_map(path) == []
        saved = load(path)
        assert written <= saved.next_keyframe - total <= written + 1
        assert len(saved.scans) == saved.next_keyframe
        total = saved.next_keyframe
    assert total > first + kills
    MapStore.open(path).close()
    assert check_map(path) == []
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("kills", [10, pytest.param(200, marks=pytest.mark.slow)])
def test_a_kill_while_the_file_is_opened_or_closed_loses_nothing(path, kills):
    random.seed(kills)
    new_map(path)
    expected = load(path)
    for _ in range(kills):
        run_and_kill(random.uniform(0.01, 0.06), open_and_close, path)
        before = contents(path.parent)
        assert check_map(path) == []
        assert_same(load(path), expected)
        after = contents(path.parent)
        assert {name: after[name] for name in before} == before
    MapStore.open(path).close()
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_full_disk_is_an_error_after_which_the_map_is_whole(path):
    new_map(path)
    before = load(path)
    with MapStore.open(path) as store:
        (pages,) = store._connection.execute("PRAGMA page_count").fetchone()
        store._connection.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(MapError, match=r"place\.map .* full"):
            store.write(drive(5, points=20_000))
    assert_same(load(path), before)


# --- one writer, readers that change nothing


def test_a_closed_map_is_a_single_file(path):
    new_map(path)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_reading_changes_no_byte_and_adds_no_file(path):
    new_map(path)
    before = contents(path.parent)
    with MapStore.open(path, read_only=True) as store, MapStore.open(path, read_only=True) as other:
        assert store.load().next_keyframe == other.load().next_keyframe == 5
    assert check_map(path) == []
    assert contents(path.parent) == before
    with MapStore.open(path, read_only=True) as store, pytest.raises(MapError, match="readonly"):
        store.write(drive(5))
    assert contents(path.parent) == before


def test_a_reader_sees_what_a_killed_writer_committed_and_changes_nothing(path):
    new_map(path)
    child = multiprocessing.get_context("fork").Process(target=write_and_die, args=(path,))
    child.start()
    child.join()
    before = contents(path.parent)
    assert f"{path.name}-wal" in before
    saved = load(path)
    assert (len(saved.sessions), saved.next_keyframe) == (2, 6)
    after = contents(path.parent)
    assert {name: after[name] for name in before} == before
    new = [p.name for p in path.parent.iterdir() if p.name not in before]
    assert new in ([], [f"{path.name}-shm"])  # SQLite's index of the log
    MapStore.open(path).close()
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_map_from_a_place_that_cannot_be_written_is_read(path):
    new_map(path)
    path.chmod(0o444)
    path.parent.chmod(0o555)
    try:
        assert load(path).next_keyframe == 5
    finally:
        path.parent.chmod(0o755)


def test_there_is_one_writer_at_a_time_and_no_reader_beside_it(path):
    new_map(path)
    other = (
        "import sys; from pathlib import Path; from lifelong_slam.mapping.store import MapStore\n"
        "MapStore.open(Path(sys.argv[1]), read_only=bool(int(sys.argv[2])))"
    )
    with MapStore.open(path) as store:
        for read_only in (False, True):
            with pytest.raises(MapError, match=r"place\.map is in use"):
                MapStore.open(path, read_only)
            command = [sys.executable, "-c", other, str(path), str(int(read_only))]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert "in use by another process" in done.stderr
        store.write(drive(5))
    assert load(path).next_keyframe == 6


def test_a_writer_waits_for_no_reader_that_stays(path):
    new_map(path)
    with MapStore.open(path, read_only=True) as reader:
        reader._connection.execute("BEGIN")
        reader._connection.execute("SELECT * FROM map").fetchone()
        with pytest.raises(MapError, match="in use"):
            MapStore.open(path)
    MapStore.open(path).close()


# --- what is no map, or no whole one


def garbage(path):
    path.write_bytes(random.Random(0).randbytes(10_000))


def empty(path):
    path.touch()


def text(path):
    path.write_text("ply\nformat ascii 1.0\n")


def folder(path):
    path.mkdir()


def other_database(path):
    with closing(sqlite3.connect(path)) as db:
        db.executescript("PRAGMA journal_mode = WAL; CREATE TABLE songs (title TEXT)")


def newer_format(path):
    new_map(path)
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA user_version = 99")


def truncated(path):
    new_map(path)
    path.write_bytes(path.read_bytes()[:-5000])


def cut_to_its_header(path):
    new_map(path)
    path.write_bytes(path.read_bytes()[:100])


def with_unreadable_names(path):
    new_map(path)
    path.write_bytes(path.read_bytes().replace(b"CREATE TABLE", b"CREATE\xff\xffABLE"))


def overwritten_in_the_middle(path):
    new_map(path)
    data = bytearray(path.read_bytes())
    middle = len(data) // 8192 * 4096
    data[middle : middle + 4096] = bytes(4096)
    path.write_bytes(data)


@pytest.mark.parametrize("read_only", [True, False])
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (garbage, "not a database"),
        (empty, "not a map of lifelong_slam"),
        (text, "not a database|not a map"),
        (folder, "not a file"),
        (other_database, "not a map of lifelong_slam"),
        (newer_format, "map format 99; this version of lifelong_slam knows 1"),
        (truncated, "malformed|damaged"),
        (cut_to_its_header, "malformed|damaged|not a database"),
        (with_unreadable_names, "names of its tables"),
        (overwritten_in_the_middle, "malformed|damaged"),
    ],
)
def test_what_is_no_whole_map_is_refused_and_left_alone(path, make, message, read_only):
    make(path)
    before = {} if path.is_dir() else contents(path.parent)
    with pytest.raises(MapError, match=message) as raised:
        MapStore.open(path, read_only)
    assert str(path) in str(raised.value)
    with pytest.raises(MapError, match="there already"):
        new_store(path)
    assert path.is_dir() or contents(path.parent) == before


def arrays_in(value):
    """Yield the bytes of all arrays with anything in them in nested dataclasses, dicts and lists."""
    if is_dataclass(value):
        for field in fields(value):
            yield from arrays_in(getattr(value, field.name))
    elif isinstance(value, dict):
        yield from arrays_in(list(value.values()))
    elif isinstance(value, list):
        for entry in value:
            yield from arrays_in(entry)
    elif isinstance(value, np.ndarray) and value.size:
        yield value.tobytes()


def test_a_flipped_bit_is_either_an_error_or_changes_no_array(path):
    """Names, ids and other plain columns have no checksum."""
    new_map(path, 5)
    with MapStore.open(path) as store:
        store.write(MapUpdate(removed=[removal(4, 2, 3), removal(3, 2)], removed_edges=[3, 4]))
    expected = set(arrays_in(load(path)))
    whole = path.read_bytes()
    chance = random.Random(0)
    refused = 0
    for _ in range(150):
        damaged = bytearray(whole)
        damaged[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
        path.write_bytes(damaged)
        try:
            saved = load(path)
        except MapError:
            refused += 1
        else:
            assert set(arrays_in(saved)) <= expected
        assert path.read_bytes() == damaged
    assert refused > 15


@pytest.mark.parametrize("read_only", [True, False])
def test_opening_does_not_make_a_map(path, read_only):
    with pytest.raises(MapError, match="no such map"):
        MapStore.open(path, read_only)
    assert list(path.parent.iterdir()) == []


def test_a_map_where_no_folder_can_be_made_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises((MapError, OSError)):
        new_store(tmp_path / "file" / "place.map")


def test_a_damaged_blob_is_named(path):
    new_map(path)
    with closing(sqlite3.connect(path)) as db, db:
        (blob,) = db.execute("SELECT points FROM features WHERE id = 3").fetchone()
        db.execute("UPDATE features SET points = ? WHERE id = 3", (blob[:-1] + b"\0",))
    with pytest.raises(MapError, match=r"damaged: features 3, points: the checksum is wrong"):
        load(path)
    assert check_map(path) == ["features 3, points: the checksum is wrong"]


# --- check


def sql(path, *statements):
    with closing(sqlite3.connect(path)) as db, db:
        for statement in statements:
            db.execute(*statement) if isinstance(statement, tuple) else db.execute(statement)


BENT = codec.pack_matrix(np.diag([1.0, 1.0, 1.1, 1.0]))
MIRRORED = codec.pack_matrix(np.diag([1.0, 1.0, -1.0, 1.0]))
NOT_FINITE = codec.pack_matrix(np.full((4, 4), np.nan))
INDEFINITE = codec.pack_matrix(np.diag([1.0, 1, 1, 1, 1, -1e-9]))
ZERO = codec.pack_matrix(np.zeros((6, 6)))
LOPSIDED = codec.pack_matrix(np.eye(6) + np.eye(6, k=1) * 0.1)


@pytest.mark.parametrize(
    ("statements", "problem"),
    [
        (["DELETE FROM vertices WHERE id = 2"], "edges 2 names an entry that is not in vertices"),
        (["UPDATE scans SET anchor = 99 WHERE id = 1"], "scans 1 names .* not in keyframes"),
        (["DELETE FROM features WHERE id = 2"], "vertex 2 has no features"),
        (["INSERT INTO keyframes VALUES (9, 0, 1, 0.0)"], "keyframe 9 must be either"),
        (
            [("UPDATE vertices SET T_map = ? WHERE id = 1", (BENT,))],
            "pose of vertex 1: not a rigid",
        ),
        (
            [("UPDATE vertices SET T_odom = ? WHERE id = 1", (MIRRORED,))],
            "odometry of vertex 1: not",
        ),
        (
            [("UPDATE edges SET T_source_target = ? WHERE id = 1", (NOT_FINITE,))],
            "edge 1: not a rigid",
        ),
        (
            [("UPDATE edges SET covariance = ? WHERE id = 3", (INDEFINITE,))],
            "edge 3: not .* positive definite",
        ),
        (
            [("UPDATE vertices SET covariance = ? WHERE id = 3", (LOPSIDED,))],
            "vertex 3: not .* semidefinite",
        ),
        (["DELETE FROM edges WHERE id = 3"], "session 0: its vertices fall into 2 unconnected"),
        (["UPDATE edges SET rejected = TRUE WHERE id = 3"], "session 0: its vertices fall into 2"),
        (["UPDATE edges SET covariance = x'00' WHERE id = 1"], "edges 1, covariance: the checksum"),
        (["DELETE FROM map"], "table map has 0 rows"),
    ],
)
def test_check_tells_what_does_not_hold_together(path, statements, problem):
    new_map(path)
    assert check_map(path) == []
    sql(path, *statements)
    before = contents(path.parent)
    problems = check_map(path)
    assert re.search(problem, problems[0]), problems
    assert contents(path.parent) == before


def test_the_first_keyframe_may_be_exact_but_no_edge(path):
    new_map(path)
    sql(path, ("UPDATE vertices SET covariance = ? WHERE id = 0", (ZERO,)))
    assert check_map(path) == []
    sql(path, ("UPDATE edges SET covariance = ? WHERE id = 1", (ZERO,)))
    assert check_map(path) == ["covariance of edge 1: not symmetric and positive definite"]


@pytest.mark.parametrize(
    ("removals", "problem"),
    [
        ((removal(4, 3), removal(3, 0, 2)), None),
        ((removal(3, 0, 2), removal(4, 2, 3)), "keyframe 4 hangs on 3, which is neither"),
        ((removal(4, 0, 99),), "keyframe 4 hangs on 99, which is neither"),
        ((removal(4, 4, 0),), "keyframe 4 hangs on 4, which is neither"),
    ],
)
def test_a_removed_keyframe_must_hang_on_what_is_there_or_went_later(path, removals, problem):
    new_map(path)
    gone = {r.vertex for r in removals}
    with MapStore.open(path) as store:
        store.write(MapUpdate(removed=removals, removed_edges=gone))
    if problem is None:
        assert check_map(path) == []
        load(path).keyframe_poses()
    else:
        (found,) = check_map(path)
        assert found.startswith(problem)
        with pytest.raises(MapError, match=problem):
            load(path).trajectory()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"T_neighbour_vertex": np.diag([1.0, 1.0, 1.1, 1.0])}, "its pose .* not a rigid motion"),
        ({"T_neighbour_vertex": np.full((4, 4), np.nan)}, "its pose .* not a rigid motion"),
        ({"gains": 0.499 * np.eye(6)}, "its gains don't sum to the identity"),
        ({"gains": np.full((6, 6), np.nan)}, "its gains don't sum to the identity"),
    ],
)
def test_check_finds_a_removed_keyframe_that_cannot_come_back(path, change, problem):
    new_map(path)
    wrong = {name: np.stack([array, array]) for name, array in change.items()}
    with MapStore.open(path) as store:
        store.write(MapUpdate(removed=[removal(4, 0, 1)], removed_edges=[4]))
        store.write(MapUpdate(removed=[replace(removal(3, 0, 1), **wrong)], removed_edges=[3]))
    (found,) = check_map(path)
    assert re.match(f"keyframe 3: {problem}", found)


def test_a_removed_keyframe_has_a_pose_and_a_gain_for_each_neighbour(path):
    new_map(path)
    whole = removal(4, 0, 1)
    with MapStore.open(path) as store:
        cut = replace(whole, gains=whole.gains[:1])
        store.write(MapUpdate(removed=[cut], removed_edges=[4]))
    (problem,) = check_map(path)
    assert problem.startswith("removals 1, support: it needs a pose and a gain for each")
    with pytest.raises(MapError, match="removals 1, support"):
        load(path)


def test_check_finds_a_session_that_is_wrongly_called_located(path):
    new_map(path)
    with MapStore.open(path) as store:
        session = store.begin_session("second", "")
        store.write(drive(5, session, start=5))
    assert check_map(path) == []
    sql(path, "UPDATE sessions SET located = TRUE")
    assert check_map(path) == ["session 1 counts as located, but no edges join it to earlier ones"]


def test_check_compares_each_index_with_its_table(path):
    new_map(path)
    with closing(sqlite3.connect(path)) as db:
        roots = dict(db.execute("SELECT name, rootpage FROM sqlite_schema WHERE type = 'index'"))
        (size,) = db.execute("PRAGMA page_size").fetchone()
    data = bytearray(path.read_bytes())
    one, other = (size * (roots[f"edges_of_{end}"] - 1) for end in ("source", "target"))
    data[one : one + size] = data[other : other + size]
    path.write_bytes(data)
    assert "row 1 missing from index edges_of_source" in check_map(path)


def test_check_does_not_read_on_where_pages_are_missing(path):
    truncated(path)
    with pytest.raises(MapError, match="malformed"):
        check_map(path)
