"""Sessions in one map file: joined where they belong, kept apart where not, resumed after a cut-off."""

import errno
import logging
import multiprocessing
import os
import re
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from map_support import assert_same, contents, load, new_map
from omegaconf import OmegaConf
from run_support import ListSource
from scipy.spatial import cKDTree
from session_support import (
    SETTINGS,
    WINDOW,
    circle_town,
    cut_off,
    open_session,
    parts,
    record_drive,
    run_session,
)
from test_slam import VOXEL, errors, pipeline

import run
from lifelong_slam.errors import ConfigError, MapError
from lifelong_slam.geometry import exp, invert
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.mapping import map_file
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.mapping.store import MapStore
from lifelong_slam.odometry.kiss_icp import KissIcpOdometry
from lifelong_slam.result import Edge
from lifelong_slam.systems.kiss_icp import KissIcpSystem

ELSEWHERE = 40  # place on the circle where later sessions begin


@pytest.fixture(scope="module")
def world():
    return circle_town(0)


@pytest.fixture(scope="module")
def first(world):
    """Return a drive of more than a lap."""
    return record_drive(world, 0, 130, 0)


@pytest.fixture(scope="module")
def second(world):
    """Return a drive of half a lap that begins elsewhere."""
    return record_drive(world, ELSEWHERE, 60, 1)


@pytest.fixture(scope="module")
def stranger():
    """Return a drive through another world."""
    return record_drive(circle_town(7), 0, 50, 1)


@pytest.fixture(scope="module")
def mapped(first, tmp_path_factory):
    """Return the file and the result of a first session."""
    path = tmp_path_factory.mktemp("mapped") / "place.map"
    return path, run_session(path, first)


@pytest.fixture(scope="module")
def joined(mapped, second, tmp_path_factory):
    """Return the file after a second session in the same place, and the session's result."""
    path = Path(shutil.copy(mapped[0], tmp_path_factory.mktemp("joined")))
    return path, run_session(path, second)


@pytest.fixture(scope="module")
def apart(mapped, stranger, tmp_path_factory):
    """Return the file after a second session in another world, and the session's result."""
    path = Path(shutil.copy(mapped[0], tmp_path_factory.mktemp("apart")))
    return path, run_session(path, stranger)


@pytest.fixture
def path(mapped, tmp_path):
    """Return a copy of the map of one session."""
    return Path(shutil.copy(mapped[0], tmp_path))


def beginning(drive, count):
    return replace(drive, scans=drive.scans[:count], truth=drive.truth[:count])


def map_errors(trajectory, drive, first):
    """Return (N, 2) errors in m and rad of poses in the map, whose frame is the first drive's start."""
    return errors(trajectory.poses, invert(first.truth[0]) @ drive.truth)


# --- a first session, and a second in the same place


def test_a_first_session_makes_the_map(mapped, first):
    path, result = mapped
    saved = load(path)
    assert check_map(path) == []
    assert [(s.source, s.finished, s.located) for s in saved.sessions] == [("circle", True, True)]
    assert saved.sessions[0].config == SETTINGS["config"]
    assert result.counts["located in the map"] == 1
    assert_same(saved.poses, result.graph.poses)
    assert saved.next_keyframe == result.counts["keyframes"]
    assert len(saved.removals) == result.counts["keyframes pruned"]
    assert not any(len(keyframe.points) for keyframe in saved.keyframes.values())
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_writing_a_map_does_not_change_what_slam_finds(mapped, first):
    slam = pipeline(first.odometry(), **WINDOW)
    for scan in first.scans:
        slam.process(scan)
    result = slam.finish()
    np.testing.assert_array_equal(result.trajectory.poses, mapped[1].trajectory.poses)
    np.testing.assert_array_equal(result.map_points, mapped[1].map_points)


def test_a_second_session_is_located_without_a_guess_and_joined(joined):
    path, result = joined
    saved = load(path)
    assert check_map(path) == []
    assert len(parts(saved)) == 1
    assert saved.sessions[1].located
    assert saved.sessions[1].finished
    assert result.counts["located in the map"] == 1
    assert result.counts["loop by appearance"] >= 1


def test_both_sessions_are_in_one_frame_near_the_truth(joined, first, second):
    path, result = joined
    odometry = invert(second.truth[0]) @ second.truth
    assert errors(odometry, invert(first.truth[0]) @ second.truth)[:, 0].min() > 10.0
    assert map_errors(result.trajectory, second, first)[:, 0].max() < 0.6
    saved = load(path)
    for session, drive in enumerate((first, second)):
        found = map_errors(saved.of_sessions([session]).trajectory(), drive, first)
        assert found[:, 0].max() < 0.6
        assert found[:, 1].max() < 0.05


def test_a_second_visit_agrees_with_the_first_where_they_overlap(joined, first, second):
    """The map may be bent; the sessions lie upon each other all the same."""
    saved = load(joined[0])
    one, other = (saved.of_sessions([session]).trajectory().poses for session in (0, 1))
    count = len(second.scans)
    true = invert(first.truth[ELSEWHERE : ELSEWHERE + count]) @ second.truth
    found = invert(one[ELSEWHERE : ELSEWHERE + count]) @ other
    assert np.median(errors(found, true)[:, 0]) < 0.15


def test_every_scan_of_both_sessions_comes_back(mapped, joined, first, second):
    saved = load(joined[0])
    np.testing.assert_array_equal(
        saved.trajectory().stamps, np.concatenate([first.stamps, second.stamps])
    )
    for session, drive in enumerate((first, second)):
        stamps = saved.of_sessions([session]).trajectory().stamps
        np.testing.assert_array_equal(stamps, drive.stamps)
    # A result spreads the graph's corrections between keyframes, a file does not.
    for (path, result), session in ((mapped, 0), (joined, 1)):
        poses = load(path).of_sessions([session]).trajectory().poses
        assert errors(poses, result.trajectory.poses)[:, 0].max() < 0.1


def test_a_visit_to_a_known_place_adds_little_to_graph_and_map(mapped, joined):
    before, after = load(mapped[0]), load(joined[0])
    assert after.next_keyframe - before.next_keyframe == joined[1].counts["keyframes"] == 30
    assert len(after.poses) <= len(before.poses) + 3
    assert len(joined[1].map_points) < 1.2 * len(mapped[1].map_points)
    assert len(after.places) <= len(before.places) + 3  # those seen before it was located


# --- another world


def test_a_session_in_another_world_is_kept_apart(apart, mapped):
    path, result = apart
    saved = load(path)
    assert check_map(path) == []
    assert result.counts["located in the map"] == 0
    assert [(s.finished, s.located) for s in saved.sessions] == [(True, True), (True, False)]
    known, new = parts(saved)
    assert known == set(load(mapped[0]).poses)
    assert {saved.keyframes[vertex].session for vertex in new} == {1}


def test_the_user_is_warned_of_a_session_that_was_not_located(path, stranger, caplog):
    with caplog.at_level(logging.WARNING):
        run_session(path, beginning(stranger, 3))
    (warning,) = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert "not located" in warning
    assert "stays apart" in warning


def test_a_session_in_another_world_leaves_the_map_as_it_was(apart, mapped):
    before, after = load(mapped[0]), load(apart[0]).of_sessions([0])
    assert_same(after.submaps, before.submaps)
    assert_same(after.edges, before.edges)
    assert_same(after.scans, before.scans)
    assert_same(after.keyframes, before.keyframes)
    for vertex, T in before.poses.items():
        np.testing.assert_allclose(after.poses[vertex], T, atol=1e-3)  # optimised once more


def test_a_session_apart_begins_in_a_frame_of_its_own(apart, stranger):
    trajectory = load(apart[0]).of_sessions([1]).trajectory()
    np.testing.assert_array_equal(trajectory.stamps, stranger.stamps)
    np.testing.assert_allclose(trajectory.poses[0], np.eye(4), atol=1e-6)
    odometry = np.array(stranger.odometry().poses)
    assert errors(trajectory.poses, odometry)[:, 0].max() < 0.1


def test_a_restored_graph_has_a_root_in_each_component():
    covariance = np.eye(6) * 1e-4
    graph = PoseGraph()
    graph.restore(
        {i: np.eye(4) for i in range(4)},
        {
            0: Edge(0, 1, np.eye(4), covariance, "odometry"),
            1: Edge(2, 3, np.eye(4), covariance, "odometry"),
        },
        [],
    )
    assert graph.roots == [0, 2]
    assert set(graph.component(0)) == {0, 1}
    assert set(graph.component(3)) == {2, 3}


def test_a_restored_graph_is_in_parts_where_its_only_join_is_set_aside():
    covariance = np.eye(6) * 1e-4
    graph = PoseGraph()
    graph.restore(
        {i: exp(np.array([0, 0, 0, i, 0, 0.0])) for i in range(4)},
        {
            0: Edge(0, 1, exp(np.array([0, 0, 0, 1.0, 0, 0])), covariance, "odometry"),
            1: Edge(2, 3, exp(np.array([0, 0, 0, 1.0, 0, 0])), covariance, "odometry"),
            2: Edge(1, 2, exp(np.array([0, 0, 0, 1.0, 0, 0])), covariance, "loop"),
        },
        [2],
    )
    assert set(graph.component(0)) == {0, 1}
    assert set(graph.component(3)) == {2, 3}


def test_places_hang_on_vertices_of_their_own_session_where_sessions_are_apart(
    apart, second, tmp_path
):
    """Poses of sessions that are apart can't be compared: each begins at the origin."""
    path = Path(shutil.copy(apart[0], tmp_path))
    saved = load(path)
    owner = {scans.anchor: scans.session for scans in saved.scans}
    slam = pipeline(second.odometry(), **WINDOW)
    with open_session(path, "localize") as session:
        slam.begin(session)
    for place in saved.places:
        vertex, _ = slam._loop_closer.places.anchor(place)
        assert owner[vertex] == owner[place], f"place {place} hangs on vertex {vertex}"


def test_a_third_session_is_located_where_the_second_was_kept_apart(apart, second, first, tmp_path):
    path = Path(shutil.copy(apart[0], tmp_path))
    result = run_session(path, second)
    saved = load(path)
    assert check_map(path) == []
    assert [s.located for s in saved.sessions] == [True, False, True]
    assert len(parts(saved)) == 2
    assert map_errors(result.trajectory, second, first)[:, 0].max() < 0.6


# --- only localising


def test_localising_gives_poses_and_points_of_the_map_and_leaves_the_file_as_it_is(
    path, first, second, mapped
):
    before = contents(path.parent)
    result = run_session(path, second, "localize")
    assert contents(path.parent) == before
    assert result.counts["located in the map"] == 1
    np.testing.assert_array_equal(result.trajectory.stamps, second.stamps)
    assert map_errors(result.trajectory, second, first)[:, 0].max() < 0.6
    np.testing.assert_array_equal(result.map_points, mapped[1].map_points)


def test_localising_in_another_world_fails_to(path, stranger):
    before = contents(path.parent)
    result = run_session(path, beginning(stranger, 30), "localize")
    assert result.counts["located in the map"] == 0
    assert contents(path.parent) == before


def test_one_may_localise_while_another_does(path, second):
    with open_session(path, "localize"), open_session(path, "localize") as session:
        assert session.localize


def test_there_is_nothing_to_localise_in_where_there_is_no_file(tmp_path):
    path = tmp_path / "nowhere.map"
    with pytest.raises(MapError, match=r"no such map: .*nowhere\.map"):
        open_session(path, "localize")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_located_in_a_map_without_keyframes(tmp_path, second):
    path = tmp_path / "empty.map"
    MapStore.create(path, *list(SETTINGS.values())[:3]).close()
    slam = pipeline(second.odometry(), **WINDOW)
    with open_session(path, "localize") as session:
        slam.begin(session)
        slam.process(second.scans[0])
        assert not session.is_located


# --- a map that doesn't fit


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": "other"}, "sensor=toy, not other"),
        ({"voxel_size": 2 * VOXEL}, f"{VOXEL} m, not {2 * VOXEL} m"),
        ({"T_base_sensor": np.eye(4)}, "elsewhere on the base"),
        ({"T_base_sensor": SETTINGS["T_base_sensor"] @ exp(1e-3 * np.eye(6)[3])}, "elsewhere"),
    ],
)
@pytest.mark.parametrize("mode", ["map", "localize"])
def test_a_map_of_other_settings_is_refused_and_left_alone(path, changes, message, mode):
    before = contents(path.parent)
    with pytest.raises(MapError, match=message):
        open_session(path, mode, **changes)
    assert contents(path.parent) == before
    open_session(path, mode).__exit__()  # nor is it left locked


def test_a_file_that_is_no_map_is_refused_and_left_alone(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("what I did last summer\n" * 100)
    before = contents(tmp_path)
    for mode in ("map", "localize"):
        with pytest.raises(MapError, match=r"notes\.txt"):
            open_session(path, mode)
    assert contents(tmp_path) == before


def test_a_map_of_another_sensor_is_refused_by_name(tmp_path):
    path = tmp_path / "other.map"
    new_map(path)
    with pytest.raises(MapError, match="sensor=hdl64, not toy"):
        open_session(path)


# --- after a cut-off


@pytest.fixture(scope="module")
def half(first, tmp_path_factory):
    """Return the file of a first session that was cut off."""
    path = tmp_path_factory.mktemp("half") / "place.map"
    cut_off(path, first)
    return path


def test_a_session_that_was_cut_off_leaves_unsettled_keyframes(half):
    saved = load(half)
    assert check_map(half) == []
    assert not saved.sessions[0].finished
    assert any(len(keyframe.points) for keyframe in saved.keyframes.values())


def test_the_next_session_settles_what_was_left(half, first, second, tmp_path):
    path = Path(shutil.copy(half, tmp_path))
    unsettled = {i for i, keyframe in load(path).keyframes.items() if len(keyframe.points)}
    slam = pipeline(second.odometry(), **WINDOW)
    with open_session(path) as session:
        slam.begin(session)
        slam.process(second.scans[0])
    saved = load(path)
    assert check_map(path) == []
    left = {i for i, keyframe in saved.keyframes.items() if len(keyframe.points)}
    assert left == {saved.next_keyframe - 1}
    pruned = {removal.vertex for removal in saved.removals}
    assert pruned & unsettled


def test_a_map_goes_on_after_a_cut_off_as_after_an_end(half, first, second, joined, tmp_path):
    path = Path(shutil.copy(half, tmp_path))
    result = run_session(path, second)
    saved = load(path)
    assert check_map(path) == []
    assert len(parts(saved)) == 1
    assert [(s.finished, s.located) for s in saved.sessions] == [(False, True), (True, True)]
    assert map_errors(result.trajectory, second, first)[:, 0].max() < 0.6
    maps = result.map_points, joined[1].map_points
    for one, other in (maps, maps[::-1]):
        assert np.mean(cKDTree(other).query(one)[0] > 2 * VOXEL) < 0.02


def test_only_scans_since_the_last_keyframe_are_lost(half, first):
    stamps = load(half).trajectory().stamps
    lost = len(first.stamps) - len(stamps)
    np.testing.assert_array_equal(stamps, first.stamps[: len(stamps)])
    assert 0 < lost <= 2


def test_one_can_localise_in_a_map_that_was_cut_off(half, first, second, tmp_path):
    path = Path(shutil.copy(half, tmp_path))
    before = contents(tmp_path)
    result = run_session(path, second, "localize")
    assert contents(tmp_path) == before
    assert result.counts["located in the map"] == 1
    assert map_errors(result.trajectory, second, first)[:, 0].max() < 0.6


def test_what_a_cut_off_session_looked_at_does_not_judge_the_next_ones_points(
    half, second, tmp_path
):
    """Views are related by odometry, which begins anew."""
    slam = pipeline(second.odometry(), **WINDOW)
    with open_session(Path(shutil.copy(half, tmp_path))) as session:
        slam.begin(session)
        assert len(slam._static_map._views) == 0


@pytest.mark.parametrize(
    "count",
    [1, 3, 25],
)
def test_a_session_may_be_cut_off_at_any_time(path, world, second, count):
    cut_off(path, beginning(second, count))
    assert check_map(path) == []
    third = record_drive(world, ELSEWHERE - 10, 20, 2)
    run_session(path, third)
    assert check_map(path) == []
    saved = load(path)
    assert [s.finished for s in saved.sessions] == [True, False, True]
    assert not any(len(keyframe.points) for keyframe in saved.keyframes.values())
    np.testing.assert_array_equal(saved.of_sessions([2]).trajectory().stamps, third.stamps)


def test_a_session_too_short_to_be_located_does_not_hide_the_map_from_later_ones(
    path, world, second, first
):
    """What it saw has a copy in the map, elsewhere only because it has a frame of its own."""
    cut_off(path, beginning(second, 25))
    third = record_drive(world, ELSEWHERE - 10, 50, 2)
    result = run_session(path, third)
    assert check_map(path) == []
    assert result.counts["located in the map"] == 1
    assert map_errors(result.trajectory, third, first)[:, 0].max() < 0.6


def test_a_session_that_was_cut_off_before_its_first_keyframe_is_nothing_but_a_row(path, second):
    before = load(path)
    open_session(path).__exit__()
    after = load(path)
    assert check_map(path) == []
    assert [s.finished for s in after.sessions] == [True, False]
    assert_same(after.poses, before.poses)
    run_session(path, beginning(second, 5))
    assert check_map(path) == []
    assert [s.finished for s in load(path).sessions] == [True, False, True]


def test_a_map_whose_first_session_has_no_keyframe_begins_with_the_second(tmp_path, second):
    path = tmp_path / "late.map"
    open_session(path).__exit__()
    run_session(path, beginning(second, 5))
    saved = load(path)
    assert check_map(path) == []
    assert [(s.finished, s.located) for s in saved.sessions] == [(False, True), (True, True)]


# --- scripts/run.py


@pytest.mark.parametrize(
    ("system", "settings", "message"),
    [
        (
            KissIcpSystem(1.0, 40.0, 0.5, threads=1),
            {"map": "a.map", "mode": "map"},
            "only system=lifelong",
        ),
        (
            KissIcpSystem(1.0, 40.0, 0.5, threads=1),
            {"map": "a.map", "mode": "localize"},
            "only system=lifelong",
        ),
        (
            pipeline(KissIcpOdometry(0.5, 1.0, 40.0)),
            {"map": None, "mode": "localize"},
            "give map=FILE",
        ),
        pytest.param(
            pipeline(KissIcpOdometry(0.5, 1.0, 40.0)),
            {"map": "a.map", "mode": "mapping"},
            "mode",
        ),
    ],
)
def test_a_map_that_makes_no_sense_is_a_wrong_setting(
    tmp_path, monkeypatch, system, settings, message
):
    monkeypatch.chdir(tmp_path)
    config = OmegaConf.create({**settings, "sensor": {"name": "toy"}})
    with (
        pytest.raises(ConfigError, match=message),
        run.map_session(config, system, ListSource([])),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


# --- a file that can't be written any more


def fill(session, pages):
    """Let the map grow by some pages only, as on a disk that is nearly full."""
    db = session._store._connection
    (now,) = db.execute("PRAGMA page_count").fetchone()
    db.execute(f"PRAGMA max_page_count = {now + pages}")


@pytest.mark.parametrize("pages", [0, 40])
def test_a_run_goes_on_without_a_map_file_that_cannot_be_written(path, second, caplog, pages):
    before, expected = load(path), run_session(Path(shutil.copy(path, f"{path}.2")), second)
    slam = pipeline(second.odometry(), **WINDOW)
    with open_session(path) as session:
        fill(session, pages)
        slam.begin(session)
        for scan in second.scans:
            slam.process(scan)
        result = slam.finish()
        assert re.search(r"place\.map .*full", str(session.failure))
    (message,) = [r.getMessage() for r in caplog.records if r.levelno == logging.ERROR]
    assert re.search(r"place\.map .* full: the run goes on without it", message)
    np.testing.assert_array_equal(result.trajectory.poses, expected.trajectory.poses)
    np.testing.assert_array_equal(result.map_points, expected.map_points)
    assert result.counts == expected.counts
    saved = load(path)
    assert check_map(path) == []
    assert [session.finished for session in saved.sessions] == [True, False]
    assert before.next_keyframe <= saved.next_keyframe
    assert saved.next_keyframe < before.next_keyframe + expected.counts["keyframes"]
    run_session(path, replace(second, number=2))
    assert check_map(path) == []


def test_a_map_that_cannot_be_closed_is_no_reason_to_lose_a_run(path, second, monkeypatch, caplog):
    with open_session(path) as session:
        slam = pipeline(second.odometry(), **WINDOW)
        slam.begin(session)
        slam.process(second.scans[0])
        with monkeypatch.context() as patch:
            error = sqlite3.OperationalError("database or disk is full")
            error.sqlite_errorcode = sqlite3.SQLITE_FULL
            patch.setattr(map_file, "close", raising(error))
            slam.finish()
    assert "full" in str(session.failure)
    assert "the run goes on without it" in caplog.text


def raising(error):
    def function(*_):
        raise error

    return function


# --- many processes make one map


def open_at_once(path, barrier, answers):
    barrier.wait()
    try:
        with open_session(path) as session:
            session.end()
            answers.put(session.id)
    except MapError as error:
        answers.put(str(error))


def test_processes_that_make_one_map_at_the_same_time_lose_no_session(tmp_path):
    fork = multiprocessing.get_context("fork")
    for attempt in range(8):
        path = tmp_path / f"{attempt}.map"
        barrier, answers = fork.Barrier(3), fork.SimpleQueue()
        children = [
            fork.Process(target=open_at_once, args=(path, barrier, answers)) for _ in range(3)
        ]
        for child in children:
            child.start()
        for child in children:
            child.join()
        said = [answers.get() for _ in children]
        sessions = sorted(answer for answer in said if isinstance(answer, int))
        assert sessions == list(range(len(load(path).sessions)))
        assert sessions
        assert all("in use" in answer for answer in said if isinstance(answer, str))
    assert len(list(tmp_path.iterdir())) == 8


@pytest.mark.parametrize("links", [True, False])
def test_a_map_that_is_there_is_not_replaced(path, monkeypatch, links):
    if not links:
        refused = OSError(errno.EPERM, "no hard links on this file system")
        monkeypatch.setattr(os, "link", raising(refused))
    before = contents(path.parent)
    with pytest.raises(MapError, match="there already"):
        MapStore.create(path, *list(SETTINGS.values())[:3])
    assert contents(path.parent) == before
    MapStore.create(path.with_name("other.map"), *list(SETTINGS.values())[:3]).close()
    assert sorted(contents(path.parent)) == ["other.map", "place.map"]
