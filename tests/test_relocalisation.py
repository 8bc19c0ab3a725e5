"""Sessions without a guess of their pose: found where they are, and nowhere else."""

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from map_closures.map_closures import MapClosures
from scipy.spatial import cKDTree
from slam_support import Lidar, World, box, error_of, ground, keyframe, planar, pole, town

from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.loop_closure import relocalisation
from lifelong_slam.loop_closure.relocalisation import (
    LOCAL_MAP_LENGTH,
    LOCAL_MAP_RADIUS,
    LocalMap,
    LocalMapBuilder,
    Location,
    Relocaliser,
    SessionLocator,
    upright,
)
from lifelong_slam.mapping.static_map import thin
from lifelong_slam.registration import Cloud, Registration
from lifelong_slam.sources.folder import FolderSource

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / os.environ.get("LIFELONG_SLAM_DATA", "../shared/data") / "lidar3d"

VOXEL = 1.0
LIDAR = Lidar(rings=32, columns=360, duration=0.0, reach=60.0)
NOWHERE = np.zeros((0, 3), dtype=np.float32)


def road_town(seed):
    return town(seed, 70, lambda xy: np.abs(xy[:, 1]) < 6, spacing=6.0)


def visit(world, xs, offset=0.0, yaw=0.0, T_odom_map=None, seed=0, first_id=0):
    """Return the keyframes of a drive along x, in an odometry frame of its own, and their poses."""
    T_odom_map = np.eye(4) if T_odom_map is None else T_odom_map
    keyframes, poses = [], []
    for i, x in enumerate(xs):
        T = planar(x, offset, yaw, 1.8)
        points = LIDAR.sweep(world, T, T, rng=np.random.default_rng([seed, i])).points
        travelled = abs(float(x - xs[0]))
        keyframes.append(keyframe(first_id + i, T_odom_map @ T, points, travelled))
        poses.append(T)
    return keyframes, poses


def local_maps(keyframes, voxel_size=VOXEL):
    builder = LocalMapBuilder(voxel_size)
    return [built for built in map(builder.add, keyframes) if built is not None]


def saved(keyframes, voxel_size=VOXEL):
    relocaliser = Relocaliser(voxel_size)
    for place in local_maps(keyframes, voxel_size):
        relocaliser.add_place(place.reference.id, place.points)
    return relocaliser


@pytest.fixture(scope="module")
def mapped():
    """Return a town, the places saved from a drive through it, and the poses of the drive."""
    world = road_town(5)
    keyframes, poses = visit(world, np.arange(-40.0, 41.0, 2.0))
    return world, saved(keyframes), poses


START = planar(25.0, -40.0, 2.4, 3.0)  # where the second session's odometry begins in the map


@pytest.mark.parametrize(("offset", "yaw"), [(0.0, 0.0), (2.0, 0.0), (-2.0, np.pi)])
def test_a_session_is_located_wherever_its_odometry_begins(mapped, offset, yaw):
    world, relocaliser, poses = mapped
    xs = np.arange(-25.0, 26.0, 2.0) * (1 if yaw == 0 else -1)
    session, truth = visit(world, xs, offset, yaw, invert(START), seed=1, first_id=1000)
    locator = SessionLocator(2 * VOXEL)
    found = []
    for query in local_maps(session):
        locations = relocaliser.locate(query, range(len(poses)))
        found += locator.agreeing(locations, poses.__getitem__)
    assert found
    for location in found:
        expected = invert(poses[location.reference_id]) @ truth[location.query.id - 1000]
        distance, angle = error_of(location.registration.T_target_source, expected)
        assert distance < 0.1
        assert angle < 0.01


def test_other_towns_are_not_mistaken_for_the_place(mapped):
    _, relocaliser, poses = mapped
    for seed in (31, 32):
        session, _ = visit(road_town(seed), np.arange(-20.0, 21.0, 2.0), seed=seed)
        for query in local_maps(session):
            assert relocaliser.locate(query, range(len(poses))) == []


def test_a_tilted_sensor_is_located_in_all_six_degrees_of_freedom(mapped):
    world, relocaliser, poses = mapped
    session, truth = visit(world, np.arange(-10.0, 13.0, 2.0), seed=2)
    (query,) = local_maps(session)
    tilt = exp(np.array([0.25, -0.2, 1.0, 0.0, 0.0, 0.0]))
    tilted = transform(invert(tilt), query.points.astype(float)).astype(np.float32)
    best = relocaliser.locate(replace(query, points=tilted), range(len(poses)))[0]
    expected = invert(poses[best.reference_id]) @ truth[query.reference.id] @ tilt
    distance, angle = error_of(best.registration.T_target_source, expected)
    assert distance < 0.1
    assert angle < 0.01


def test_candidates_are_few_and_the_likeliest_comes_first(mapped):
    world, relocaliser, poses = mapped
    session, _ = visit(world, np.arange(-10.0, 13.0, 2.0), seed=2)
    (query,) = local_maps(session)
    candidates = relocaliser.candidates(query.points, range(len(poses)))
    inliers = [candidate.inliers for candidate in candidates]
    assert 1 <= len(candidates) <= 5
    assert inliers == sorted(inliers, reverse=True)


def test_of_the_places_that_a_query_fits_the_best_supported_comes_first(mapped):
    world, relocaliser, poses = mapped
    session, _ = visit(world, np.arange(-20.0, 23.0, 2.0), 1.0, seed=2)
    found = [relocaliser.locate(query, range(len(poses))) for query in local_maps(session)]
    supports = [[at.registration.support for at in locations] for locations in found]
    assert any(len(set(several)) > 1 for several in supports)
    assert supports == [sorted(several, reverse=True) for several in supports]


def test_a_place_that_is_not_among_those_asked_for_is_not_found(mapped):
    world, relocaliser, poses = mapped
    session, _ = visit(world, np.arange(-10.0, 13.0, 2.0), seed=2)
    (query,) = local_maps(session)
    best = relocaliser.candidates(query.points, range(len(poses)))[0].reference_id
    assert relocaliser.locate(query, []) == []
    others = set(range(len(poses))) - {best}
    assert best not in [c.reference_id for c in relocaliser.candidates(query.points, others)]


def test_a_place_is_still_found_after_any_number_of_queries(mapped):
    world, _, _ = mapped
    (place,) = local_maps(visit(world, np.arange(-10.0, 13.0, 2.0))[0])
    (query,) = local_maps(visit(world, np.arange(-9.0, 14.0, 2.0), seed=3)[0])
    relocaliser = Relocaliser(VOXEL)
    relocaliser.add_place(7, place.points)
    for others in (0, 40):  # the database keeps fewer
        for _ in range(others):
            relocaliser.candidates(NOWHERE, {7})
        assert [c.reference_id for c in relocaliser.candidates(query.points, {7})] == [7]


def test_places_are_matched_with_queries_and_with_nothing_else(mapped, monkeypatch):
    """A match takes milliseconds: a new place must not cost more the more places there are."""
    world, _, _ = mapped
    (place,) = local_maps(visit(world, np.arange(-10.0, 13.0, 2.0))[0])
    matches = []

    class Counting(MapClosures):
        def get_top_k_closures(self, *arguments):
            closures = super().get_top_k_closures(*arguments)
            matches.append(len(closures))
            return closures

    monkeypatch.setattr(relocalisation, "MapClosures", Counting)
    relocaliser = Relocaliser(VOXEL)
    for i in range(20):
        relocaliser.add_place(i, place.points)
    assert matches == [0] * 20
    for _ in range(40):
        matches.clear()
        candidates = relocaliser.candidates(place.points, {3, 18})
        assert sum(matches) == 20
        assert {candidate.reference_id for candidate in candidates} == {3, 18}


def test_maps_of_nothing_are_located_nowhere(mapped):
    empty = Relocaliser(VOXEL)
    query = LocalMap(keyframe(0, np.eye(4), NOWHERE), 0.0, NOWHERE)
    assert empty.locate(query, {0}) == []
    assert mapped[1].locate(query, range(len(mapped[2]))) == []
    empty.add_place(0, NOWHERE)
    assert len(empty) == 1
    assert empty.locate(query, {0}) == []


def fit(T, support):
    return Registration(T, np.eye(6), 1.0, 1000, support, support, 0.03, converged=True)


def location(query, reference, T, support):
    """Return that the query, taken 10 m along x after the one before, fits a place."""
    return Location(reference, keyframe(query, planar(10.0 * query, 0), NOWHERE), fit(T, support))


def located(*answers):
    """Tell a locator where query after query fits; return what it says."""
    locator = SessionLocator(max_offset=1.0)
    places = {0: planar(0, 0), 1: planar(10, 0), 9: planar(500, 0)}
    found = [
        locator.agreeing([location(i, *fits) for fits in answer], places.__getitem__)
        for i, answer in enumerate(answers)
    ]
    return [[(each.reference_id, each.query.id) for each in agreeing] for agreeing in found]


HERE = (0, planar(3, 0), 0.7)
ON = (1, planar(3, 0), 0.7)  # 10 m further, as odometry says
ASTRAY = (9, planar(3, 0), 0.7)


def test_one_place_alone_does_not_locate_a_session():
    assert located([HERE]) == [[]]


def test_two_places_that_odometry_confirms_locate_a_session():
    assert located([HERE], [ON]) == [[], [(0, 0), (1, 1)]]


@pytest.mark.parametrize("second", [planar(5, 0), planar(3, 0, 0.2)])
def test_two_places_that_odometry_contradicts_do_not(second):
    assert located([HERE], [(1, second, 0.7)]) == [[], []]


def test_a_wrong_place_in_between_does_not_hide_the_right_ones():
    assert located([HERE], [ASTRAY], [(1, planar(13, 0), 0.7)]) == [[], [], [(0, 0), (1, 2)]]


def test_a_query_that_fits_two_spots_about_equally_is_not_counted():
    weak, strong = (9, planar(3, 0), 0.4), (9, planar(3, 0), 0.65)
    assert located([HERE, strong], [ON]) == [[], []]
    assert located([HERE, weak], [ON]) == [[], [(0, 0), (1, 1)]]


def test_a_moved_map_moves_what_was_pending():
    # The graph is optimised between the two queries; the places keep their ids.
    poses = {0: planar(0, 0), 1: planar(10, 0)}
    locator = SessionLocator(max_offset=1.0)
    assert locator.agreeing([location(0, *HERE)], poses.__getitem__) == []
    moved = {i: planar(70, 20, 1.0) @ T for i, T in poses.items()}
    assert len(locator.agreeing([location(1, *ON)], moved.__getitem__)) == 2


def test_a_query_that_fits_nowhere_changes_nothing():
    assert located([HERE], [], [(1, planar(13, 0), 0.7)]) == [[], [], [(0, 0), (1, 2)]]


def test_locations_long_ago_are_forgotten():
    astray = [[(9, planar(20.0 * i, 5.0 * i), 0.7)] for i in range(1, 4)]
    back = (1, planar(3 + 30, 0), 0.7)  # agrees with the first
    assert located([HERE], *astray[:2], [(1, planar(23, 0), 0.7)])[-1] == [(0, 0), (1, 3)]
    assert located([HERE], *astray, [back])[-1] == []


def test_local_maps_overlap_by_half_and_stay_near_their_reference():
    far = np.array([[LOCAL_MAP_RADIUS + 30.0, 0, 0], [5.0, 0, 0]])
    maps = local_maps([keyframe(i, planar(2.0 * i, 0), far, 2.0 * i) for i in range(31)])
    centres = [built.reference.travelled for built in maps]
    np.testing.assert_allclose(np.diff(centres), LOCAL_MAP_LENGTH / 2, atol=2.0)
    assert centres[0] == pytest.approx(LOCAL_MAP_LENGTH / 2, abs=2.0)
    begins = [built.begin for built in maps]
    assert begins[0] == 0.0
    np.testing.assert_allclose(np.array(centres) - begins, LOCAL_MAP_LENGTH / 2, atol=2.0)
    for built in maps:
        assert np.linalg.norm(built.points, axis=1).max() < LOCAL_MAP_RADIUS
        assert len(built.points) == len(thin(built.points.astype(float), VOXEL / 2))


def test_a_standing_sensor_makes_no_local_maps():
    assert local_maps([keyframe(i, np.eye(4), NOWHERE, 0.0) for i in range(100)]) == []


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.4, 0.0), (-0.2, 0.3)])
def test_upright_finds_the_ground_under_a_tilted_sensor(tilt):
    world = World([ground(60), box((12, 3, 0), (6, 8, 7)), box((-9, -6, 0), (4, 4, 5), 0.5),
                   pole(4, -7, 0.2, 6)])  # fmt: skip
    T = planar(0, 0, 0.3, 1.8)
    points = LIDAR.sweep(world, T, T).points
    tilted = transform(invert(exp(np.array([*tilt, 0, 0, 0, 0]))), points)
    up = upright(tilted, VOXEL)[2, :3]
    true_up = exp(np.array([*tilt, 0, 0, 0, 0.0]))[2, :3]
    assert np.arccos(np.clip(up @ true_up, -1, 1)) < 0.01


def test_upright_does_not_depend_on_the_side_that_normals_point_to(monkeypatch):
    world = World([ground(60), box((12, 3, 0), (6, 8, 7)), box((-9, -6, 0), (4, 4, 5), 0.5)])
    T = planar(0, 0, 0.3, 1.8)
    points = transform(
        invert(exp(np.array([0.3, 0.1, 0, 0, 0, 0]))), LIDAR.sweep(world, T, T).points
    )
    expected = upright(points, VOXEL)
    prepared = Cloud.prepare(points, VOXEL)
    for side in (-1.0, 1.0):  # all down, all up
        normals = side * np.where(prepared.normals[:, 2:] < 0, -1, 1) * prepared.normals
        turned = SimpleNamespace(normals=normals)
        monkeypatch.setattr(Cloud, "prepare", lambda *_, turned=turned: turned)
        np.testing.assert_allclose(upright(points, VOXEL), expected, atol=1e-12)


def recorded(session, T_begin_again):
    """Return the keyframes of a recorded session by its reference, begun at another pose."""
    folder = DATA / f"hku_session_{session}"
    source = FolderSource(
        str(folder / "scans"), str(folder / "times.txt"), str(folder / "odom_poses.txt")
    )
    poses = source.reference().poses
    travelled = np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=0), axis=1))
    return [
        keyframe(i, T_begin_again @ poses[i], thin(scan.points, 0.2), float(travelled[i]))
        for i, scan in enumerate(source)
        if i % 4 == 0
    ]


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.skipif(
    not DATA.is_dir(), reason=f"{DATA} is not there (LIFELONG_SLAM_DATA names the data folder)"
)
@pytest.mark.parametrize(("yaw", "x", "y"), [(0.0, 0.0, 0.0), (2.39, 25.0, -8.0)])
def test_a_hand_held_session_is_located_in_an_earlier_one(yaw, x, y):
    first = recorded(1, np.eye(4))
    poses = {k.id: k.T_odom_sensor for k in first}
    relocaliser, locator = saved(first, 0.5), SessionLocator(max_offset=1.0)
    again = recorded(2, planar(x, y, yaw))
    found = []
    for query in local_maps(again, 0.5):
        found = found or locator.agreeing(relocaliser.locate(query, poses), poses.__getitem__)
    assert found
    T_map_query = poses[found[-1].reference_id] @ found[-1].registration.T_target_source
    T_map_odom = T_map_query @ invert(found[-1].query.T_odom_sensor)
    tree = cKDTree(np.vstack([transform(k.T_odom_sensor, k.points.astype(float)) for k in first]))
    seen = [transform(T_map_odom @ k.T_odom_sensor, k.points.astype(float)) for k in again]
    # With the identity, as the two references would have it, the median is 0.4 m.
    assert np.median(tree.query(np.vstack(seen)[::20])[0]) < 0.1
