"""Keyframes, submaps and the static map."""

import numpy as np
import pytest
from slam_support import START, World, box, estimate, ground, keyframe, planar, pole

from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.mapping import static_map
from lifelong_slam.mapping.keyframe import KeyframeSelector, submap
from lifelong_slam.mapping.static_map import StaticMap, thin

VOXEL = 0.5


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


def brute_force_means(points, voxel_size):
    cells = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point / voxel_size).astype(int)), []).append(point)
    return {cell: np.mean(members, axis=0) for cell, members in cells.items()}


def test_a_maps_points_are_the_means_of_what_was_measured_in_each_voxel():
    rng = np.random.default_rng(2)
    poses = [exp(rng.normal(size=6) * [0.1, 0.1, 1, 3, 3, 0.3]) for _ in range(3)]
    keyframes = [keyframe(i, T, rng.uniform(-6, 6, (400, 3))) for i, T in enumerate(poses)]
    measured = np.vstack(
        [transform(T, k.points.astype(float)) for k, T in zip(keyframes, poses, strict=True)]
    )
    expected = brute_force_means(measured, VOXEL)
    points, hits = StaticMap(VOXEL)._voxelise(keyframes, poses)
    assert len(points) == len(expected)
    assert hits.sum() == len(measured)
    for point in points:
        np.testing.assert_allclose(point, expected[tuple(np.floor(point / VOXEL).astype(int))])


def test_merging_in_chunks_changes_nothing(monkeypatch):
    rng = np.random.default_rng(3)
    keyframes = [keyframe(i, np.eye(4), rng.uniform(-6, 6, (200, 3))) for i in range(7)]
    poses = [planar(i, 0) for i in range(7)]
    whole = StaticMap(VOXEL).build(keyframes, poses)
    monkeypatch.setattr(static_map, "_CHUNK", 2)
    np.testing.assert_allclose(StaticMap(VOXEL).build(keyframes, poses), whole, atol=1e-6)


def test_points_beyond_the_range_stay_out_of_the_map():
    points = np.array([[5.0, 0, 0], [79.0, 0, 0], [81.0, 0, 0]])
    built = StaticMap(VOXEL, max_range=80.0).build([keyframe(0, np.eye(4), points)], [np.eye(4)])
    assert sorted(built[:, 0].tolist()) == [5.0, 79.0]


def test_a_map_of_nothing_is_empty():
    assert StaticMap().build([], []).shape == (0, 3)
    blind = keyframe(0, np.eye(4), np.zeros((0, 3)))
    for keyframes in ([blind], [blind] * 3):
        built = StaticMap().build(keyframes, [np.eye(4)] * len(keyframes))
        assert built.shape == (0, 3)
        assert built.dtype == np.float32


def test_voxels_keep_apart_on_both_sides_of_the_origin_and_far_away():
    places = np.array([[0.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [-0.1, -0.1, -0.1], [0.1, -0.1, 0.1]])
    far = np.vstack([places, places + np.array([30_000.0, -40_000.0, 500.0])])
    keys = static_map._keys(far, 0.2)
    assert len(np.unique(keys)) == len(far)


@pytest.mark.parametrize("seed", range(3))
def test_tiles_find_every_point_in_sight_and_none_far_out_of_it(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-150, -90, -5], [120, 200, 20], (4000, 3))
    tiles = static_map._Tiles(points)
    for centre in [*rng.uniform(-150, 150, (10, 2)), np.array([1e4, 1e4])]:
        found = tiles.around(centre)
        assert len(np.unique(found)) == len(found)
        distance = np.linalg.norm(points[:, :2] - centre, axis=1)
        assert set(np.flatnonzero(distance < static_map._SIGHT)) <= set(found)
        assert np.all(distance[found] < static_map._SIGHT + 2 * static_map._TILE)


def scan_of(world, T, rays):
    """Return a static sweep's points in the sensor's frame at T."""
    directions = rays @ T[:3, :3].T
    ranges = world.cast(np.broadcast_to(T[:3, 3], directions.shape), directions)
    hit = ranges < 60
    return rays[hit] * ranges[hit, None]


def street(with_car_at=None):
    """Return a street with walls and poles, and a car somewhere on it."""
    meshes = [ground(100), box((10, 9, 0), (60, 1, 6)), box((10, -9, 0), (60, 1, 6))]
    meshes += [pole(x, 5.0, 0.1, 5.0) for x in (-5, 5, 15, 25)]
    if with_car_at is not None:
        meshes.append(box((with_car_at, 3.0, 0), (4.2, 1.8, 1.6)))
    return World(meshes)


def drive_by(car_at):
    """Return keyframes along a street, with a car at `car_at(i)` (x, or None) at each, and poses."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(0, 360, 1.0)), np.radians(np.arange(-24, 10, 1.0))
    )
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
         np.sin(elevation)], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    poses = [planar(1.0 * i, 0, 0, 1.8) for i in range(20)]
    keyframes = [keyframe(i, T, scan_of(street(car_at(i)), T, rays)) for i, T in enumerate(poses)]
    return keyframes, poses


def in_lane(points):
    """Select what stands in the lane that the car uses, above the ground."""
    return points[(points[:, 2] > 0.4) & (points[:, 2] < 1.7) & (np.abs(points[:, 1] - 3) < 1.3)]


def test_what_moves_is_removed_and_what_stands_remains():
    empty, moving, parked = (
        StaticMap(0.2).build(*drive_by(car_at))
        for car_at in (lambda _: None, lambda i: 25.0 - 2.0 * i, lambda _: 12.0)
    )
    assert len(in_lane(empty)) == 0
    raw, _ = StaticMap(0.2)._voxelise(*drive_by(lambda i: 25.0 - 2.0 * i))
    trail = len(in_lane(raw))
    assert trail > 300
    assert len(in_lane(moving)) < 0.25 * trail
    # The parked car stands, as do walls, poles and ground.
    stands, _ = StaticMap(0.2)._voxelise(*drive_by(lambda _: 12.0))
    assert len(in_lane(parked)) > 0.9 * len(in_lane(stands))
    everything, _ = StaticMap(0.2)._voxelise(*drive_by(lambda _: None))
    assert len(empty) > 0.97 * len(everything)
    poles = everything[(np.abs(everything[:, 1] - 5) < 0.3) & (everything[:, 2] > 0.4)]
    kept = empty[(np.abs(empty[:, 1] - 5) < 0.3) & (empty[:, 2] > 0.4)]
    assert len(kept) > 0.6 * len(poles)  # thinner than a pixel: rays pass beside them


def test_what_moves_is_removed_wherever_the_map_frame_lies():
    keyframes, poses = drive_by(lambda i: 25.0 - 2.0 * i)
    X = exp(np.array([0.0, 0.0, 2.0, 500.0, -300.0, 20.0]))
    here = StaticMap(0.2).build(keyframes, poses)
    there = StaticMap(0.2).build(keyframes, [X @ T for T in poses])
    back = transform(invert(X), there.astype(float))
    assert len(in_lane(back)) == pytest.approx(len(in_lane(here)), rel=0.1)
    assert len(there) == pytest.approx(len(here), rel=0.1)


def test_the_same_keyframes_give_the_same_map():
    keyframes, poses = drive_by(lambda i: 25.0 - 2.0 * i)
    maps = [StaticMap(0.2).build(keyframes, poses) for _ in range(2)]
    np.testing.assert_array_equal(maps[0], maps[1])
