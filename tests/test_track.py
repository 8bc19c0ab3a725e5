"""The path of every scan: odometry where nothing speaks against it, else carried by keyframes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slam_support import START, planar

from lifelong_slam.geometry import exp, invert, log
from lifelong_slam.mapping.track import Track
from lifelong_slam.scan import NANOSECONDS


def odometry(count, seed=0):
    """Return the poses of a drive with arbitrary turns and climbs."""
    rng = np.random.default_rng(seed)
    poses = [exp(rng.normal(size=6))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ exp(rng.normal(size=6) * 0.1 + [0, 0, 0.05, 1.0, 0, 0]))
    return np.array(poses)


def track_of(poses, every=4, stamps=None):
    """Return a track of scans 0.1 s apart of which every few are keyframes, named by tens."""
    track = Track()
    for i, T in enumerate(poses):
        track.add(START + i * NANOSECONDS // 10 if stamps is None else int(stamps[i]), T)
        if i % every == 0:
            track.mark_keyframe(10 * (i // every))
    return track


@pytest.mark.parametrize("count", [1, 2, 4, 5, 30, 2500])
def test_the_trajectory_is_odometrys_where_the_graph_agrees(count):
    poses = odometry(count)
    trajectory = track_of(poses).trajectory(poses[::4])
    np.testing.assert_allclose(trajectory.poses, poses, atol=1e-9)
    assert len(trajectory) == count


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_trajectory_moves_as_the_map_does(seed):
    poses = odometry(23, seed)
    shift = exp(np.random.default_rng(seed).normal(size=6) * [1, 1, 1, 50, 50, 50])
    trajectory = track_of(poses).trajectory(shift @ poses[::4])
    np.testing.assert_allclose(trajectory.poses, shift @ poses, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_keyframes_are_where_the_graph_has_them(seed):
    poses = odometry(23, seed)
    noise = np.random.default_rng(seed).normal(size=(6, 6)) * 0.3
    graph = poses[::4] @ exp(noise)
    trajectory = track_of(poses).trajectory(graph)
    np.testing.assert_allclose(trajectory.poses[::4], graph, atol=1e-8)


def test_a_correction_is_spread_over_the_scans_in_proportion_to_time():
    """Four steps of 1 m, and the graph says that the second keyframe is 0.4 m further."""
    poses = np.array([planar(i, 0) for i in range(5)])
    stamps = START + np.array([0, 1, 5, 7, 10]) * NANOSECONDS // 10
    graph = np.array([planar(0, 0), planar(4.4, 0)])
    trajectory = track_of(poses, 4, stamps).trajectory(graph)
    np.testing.assert_array_equal(trajectory.stamps, stamps)
    np.testing.assert_allclose(
        trajectory.positions[:, 0], np.arange(5) + 0.4 * np.array([0, 0.1, 0.5, 0.7, 1.0])
    )


def test_a_turn_of_the_next_keyframe_is_shared_out_in_equal_turns():
    """Of a standing sensor the graph says that it turned by 0.4 rad in four scans."""
    poses = np.array([np.eye(4)] * 5)
    trajectory = track_of(poses).trajectory(np.array([np.eye(4), planar(0, 0, 0.4)]))
    np.testing.assert_allclose(log(trajectory.poses)[:, 2], [0, 0.1, 0.2, 0.3, 0.4], atol=1e-12)


def test_scans_after_the_last_keyframe_hang_on_it():
    poses = odometry(7)
    graph = np.array([poses[0], poses[4] @ planar(3, 2, 1)])
    trajectory = track_of(poses).trajectory(graph)
    for i in (5, 6):
        expected = graph[1] @ invert(poses[4]) @ poses[i]
        np.testing.assert_allclose(trajectory.poses[i], expected, atol=1e-9)


def test_the_way_travelled_is_the_length_of_the_path_not_of_the_chord():
    track = Track()
    assert track.travelled == 0.0
    for i, (x, y) in enumerate([(5, 5), (8, 9), (8, 9), (5, 5)]):
        track.add(START + i, planar(x, y, 1.0 * i))
    assert track.travelled == pytest.approx(10.0)


def test_the_motion_since_the_keyframe_is_odometrys():
    poses = odometry(7)
    np.testing.assert_allclose(track_of(poses[:5]).since_keyframe(), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(
        track_of(poses).since_keyframe(), invert(poses[4]) @ poses[6], atol=1e-12
    )


def test_scans_before_the_newest_keyframe_hang_on_the_one_before():
    poses = odometry(11)
    keyframe, stamps, T_keyframe_scan = track_of(poses).scans_before_newest()
    assert keyframe == 10
    np.testing.assert_array_equal(stamps, START + np.arange(4, 8) * NANOSECONDS // 10)
    np.testing.assert_allclose(T_keyframe_scan, invert(poses[4]) @ poses[4:8], atol=1e-12)


def test_scans_after_the_newest_keyframe_hang_on_it():
    poses = odometry(11)
    keyframe, stamps, T_keyframe_scan = track_of(poses).scans_after_newest()
    assert keyframe == 20
    np.testing.assert_array_equal(stamps, START + np.arange(8, 11) * NANOSECONDS // 10)
    np.testing.assert_allclose(T_keyframe_scan, invert(poses[8]) @ poses[8:], atol=1e-12)


def test_every_scan_is_told_of_once():
    """What is told at each keyframe about the stretch before it, and the rest at the end."""
    poses, track, told = odometry(27), Track(), []
    for i, T in enumerate(poses):
        track.add(START + i, T)
        if i % 4 == 0:
            track.mark_keyframe(i)
            if i:
                told += track.scans_before_newest()[1].tolist()
    told += track.scans_after_newest()[1].tolist()
    assert told == list(range(START, START + 27))
    assert track.keyframes == list(range(0, 27, 4))
    assert len(track) == 27
