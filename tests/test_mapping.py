"""Keyframes, and what is joined and thinned of their points."""

import numpy as np
from slam_support import START, estimate, keyframe, planar

from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.mapping.keyframe import KeyframeSelector, submap
from lifelong_slam.mapping.static_map import thin


def selected(poses, distance=2.0, rotation=0.3):
    selector = KeyframeSelector(distance, rotation)
    return [i for i, T in enumerate(poses) if selector.takes(estimate(START + i, T))]


def test_the_first_scan_is_a_keyframe_and_standing_still_adds_none():
    assert selected([np.eye(4)] * 5) == [0]


def test_keyframes_are_taken_by_distance_from_the_last_one_not_from_the_last_scan():
    poses = [planar(0.7 * i, 0) for i in range(10)]
    assert selected(poses) == [0, 3, 6, 9]  # 2.1 m apart


def test_keyframes_are_taken_by_rotation_on_the_spot():
    poses = [planar(0, 0, 0.11 * i) for i in range(9)]
    assert selected(poses) == [0, 3, 6]


def test_going_there_and_back_within_the_distance_adds_none():
    assert selected([planar(x, 0) for x in (0, 1.0, 1.9, 1.0, 0.0, -1.0, -1.9)]) == [0]


def test_a_submap_is_in_the_frame_of_its_centre():
    rng = np.random.default_rng(0)
    centre = exp(rng.normal(size=6))
    poses = [exp(rng.normal(size=6)) for _ in range(3)]
    world = rng.uniform(-5, 5, (50, 3))
    keyframes = [keyframe(i, np.eye(4), transform(invert(T), world)) for i, T in enumerate(poses)]
    joined = submap(keyframes, poses, centre)
    assert joined.shape == (150, 3)
    expected = np.vstack([transform(invert(centre), world)] * 3)
    np.testing.assert_allclose(joined, expected, atol=1e-5)


def test_keyframes_without_points_add_nothing_to_a_submap():
    empty = keyframe(0, np.eye(4), np.zeros((0, 3)))
    full = keyframe(1, np.eye(4), np.ones((4, 3)))
    assert submap([empty], [np.eye(4)], np.eye(4)).shape == (0, 3)
    assert submap([empty, full], [np.eye(4)] * 2, np.eye(4)).shape == (4, 3)


def test_thinning_keeps_one_measured_point_a_voxel():
    points = np.random.default_rng(1).uniform(-10, 10, (5000, 3))
    kept = thin(points, 1.0)
    cells = np.floor(kept).astype(int)
    assert len(np.unique(cells, axis=0)) == len(kept)
    assert len(kept) == len(np.unique(np.floor(points).astype(int), axis=0))
    assert {tuple(p) for p in kept} <= {tuple(p) for p in points.astype(np.float32)}
    assert thin(np.zeros((0, 3)), 1.0).shape == (0, 3)
