"""The map file: what is written is read, a kill costs one keyframe, there is one writer."""

import multiprocessing
import os
import random
import sqlite3
import subprocess
import sys
import time

import numpy as np
import pytest
from map_support import (
    START,
    STEP,
    T_BASE_SENSOR,
    assert_same,
    cloud,
    contents,
    drive,
    edge,
    keyframe,
    lasting,
    load,
    make_older,
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


@pytest.mark.parametrize("version", [1, 2])
def test_a_map_of_an_older_format_is_read_as_it_is_and_gone_on_from(path, version):
    new_map(path)
    before = load(path)
    make_older(path, version)
    old = contents(path.parent)
    assert_same(load(path), before)
    assert contents(path.parent) == old
    with MapStore.open(path) as store:
        assert_same(store.load(), before)
        store.write(MapUpdate(edges={7: edge(0, 4, "composed"), 8: edge(1, 4, "loop")}))
    edges = load(path).edges
    assert [edges[i].kind for i in (7, 8)] == ["composed", "loop"]
    assert_same({i: edges[i] for i in before.edges}, before.edges)
    assert check_map(path) == []
    assert [p.name for p in path.parent.iterdir()] == [path.name]


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
        before = lasting(path.parent)
        assert check_map(path) == []
        assert_same(load(path), expected)
        assert lasting(path.parent) == before
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
    before = lasting(path.parent)
    assert f"{path.name}-wal" in before
    saved = load(path)
    assert (len(saved.sessions), saved.next_keyframe) == (2, 6)
    assert lasting(path.parent) == before
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
