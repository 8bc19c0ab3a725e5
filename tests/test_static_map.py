"""The static map: what hits and looks do to the voxels of its owners, and what moves out of it."""

import numpy as np
import pytest
from slam_support import World, box, ground, keyframe, planar, pole

from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.mapping.static_map import StaticMap, thin
from lifelong_slam.mapping.submap import HIGH, Submap, voxel_keys
from lifelong_slam.mapping.view import View

VOXEL = 0.5
HOME = {0: np.eye(4)}


# --- what a keyframe looks through


def wall_at(x):
    """Return points of a wall across the x axis, 0.1 m apart."""
    y, z = np.meshgrid(np.arange(-4, 4, 0.1), np.arange(-2, 2, 0.1))
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1).astype(np.float32)


def test_rays_pass_what_lies_well_before_their_returns_and_nothing_else():
    view = View.of(wall_at(10.0), np.eye(4))
    asked = np.array([[5.0, 0, 0], [9.7, 0, 0], [10.0, 0, 0], [12.0, 0, 0], [-5.0, 0, 0]])
    assert view.looks_through(asked.astype(np.float32)).tolist() == [True] + [False] * 4


def test_rays_beside_a_pole_dont_look_through_it():
    post = np.stack([np.full(30, 5.0), np.full(30, 0.05), np.linspace(-2, 2, 30)], axis=1)
    view = View.of(np.vstack([wall_at(10.0), post.astype(np.float32)]), np.eye(4))
    beside = np.array([[5.0, 0.2, 0.0], [5.0, 1.0, 0.0]], dtype=np.float32)  # 0.15 m, 0.95 m
    assert view.looks_through(beside).tolist() == [False, True]


# --- hits


def brute_force_means(points, voxel_size):
    cells = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point / voxel_size).astype(int)), []).append(point)
    return {cell: np.mean(members, axis=0) for cell, members in cells.items()}


def clutter(seed, count=3):
    """Return keyframes that see points all around them, and their poses."""
    rng = np.random.default_rng(seed)
    poses = [exp(rng.normal(size=6) * [0.1, 0.1, 1, 3, 3, 0.3]) for _ in range(count)]
    return [keyframe(i, T, rng.uniform(-6, 6, (400, 3))) for i, T in enumerate(poses)], poses


def without_looks(monkeypatch):
    monkeypatch.setattr(View, "looks_through", lambda self, points: np.zeros(len(points), bool))


def settled(keyframes, poses, owners, static_map=None, at_a_time=1):
    static_map = static_map or StaticMap(VOXEL)
    for i in range(0, len(keyframes), at_a_time):
        group = slice(i, i + at_a_time)
        static_map.settle(keyframes[group], poses[group], owners)
    return static_map


def built_from(keyframes, poses, static_map=None, at_a_time=1):
    """Return the points of a map whose owners are 5 m apart."""
    owners = {}
    for i, pose in enumerate(poses):
        if all(np.linalg.norm(T[:3, 3] - pose[:3, 3]) >= 5.0 for T in owners.values()):
            owners[i] = pose
    static_map = static_map or StaticMap(0.2)
    return settled(keyframes, poses, owners, static_map, at_a_time).points(owners)


def test_a_maps_points_are_the_means_of_what_was_measured_in_each_voxel(monkeypatch):
    without_looks(monkeypatch)
    keyframes, poses = clutter(2)
    measured = np.vstack(
        [transform(T, k.points.astype(float)) for k, T in zip(keyframes, poses, strict=True)]
    )
    expected = brute_force_means(measured, VOXEL)
    points = settled(keyframes, poses, HOME).points(HOME)
    assert len(points) == len(expected)
    for point in points:
        cell = tuple(np.floor(point / VOXEL).astype(int))
        np.testing.assert_allclose(point, expected[cell], atol=1e-5)


def test_the_order_of_hits_changes_nothing(monkeypatch):
    without_looks(monkeypatch)
    keyframes, poses = clutter(3)
    owners = {0: planar(-4, 0), 1: planar(4, 1, 0.5)}
    there, back = (settled(keyframes[::s], poses[::s], owners).points(owners) for s in (1, -1))
    np.testing.assert_allclose(there, back, atol=1e-5)


@pytest.mark.parametrize("at_a_time", [2, 3, 7])
def test_keyframes_may_be_settled_one_by_one_or_together(monkeypatch, at_a_time):
    without_looks(monkeypatch)
    keyframes, poses = clutter(4, 7)
    owners = {0: planar(-4, 0), 1: planar(4, 1, 0.5)}
    apart, together = (settled(keyframes, poses, owners, at_a_time=n) for n in (1, at_a_time))
    for owner in owners:
        one, other = apart.submaps[owner], together.submaps[owner]
        np.testing.assert_array_equal(one.keys, other.keys)
        np.testing.assert_array_equal(one.weights, other.weights)
        np.testing.assert_array_equal(one.scores, other.scores)
        np.testing.assert_allclose(one.means, other.means, atol=1e-5)


def test_a_keyframe_counts_once_for_a_voxel_however_many_points_it_has_there():
    points = np.array([[5.1, 0.1, 0.1], [5.2, 0.1, 0.1], [5.3, 0.1, 0.1]])
    submap = settled([keyframe(0, np.eye(4), points)], [np.eye(4)], HOME).submaps[0]
    assert submap.scores.tolist() == [1]
    assert submap.weights.tolist() == [3]


def test_points_belong_to_the_nearest_owner_and_move_with_it():
    points = np.array([[3.0, 1, 0], [43.0, 1, 0]])
    owners = {4: planar(0, 0), 9: planar(40, 0, 1.0)}
    static_map = settled([keyframe(0, np.eye(4), points)], [np.eye(4)], owners)
    np.testing.assert_allclose(static_map.submaps[4].means, [[3, 1, 0]], atol=1e-5)
    motion = exp(np.array([0, 0, 0.3, 2.0, 5.0, 0.5]))
    moved = static_map.points({4: owners[4], 9: motion @ owners[9]})
    expected = [points[0], transform(motion, points[1:])[0]]
    np.testing.assert_allclose(moved, expected, atol=1e-4)


def test_points_beyond_the_range_stay_out_of_the_map():
    points = np.array([[5.0, 0, 0], [79.0, 0, 0], [81.0, 0, 0]])
    built = built_from(
        [keyframe(0, np.eye(4), points)], [np.eye(4)], StaticMap(VOXEL, max_range=80.0)
    )
    assert sorted(built[:, 0].tolist()) == [5.0, 79.0]


def test_a_map_of_nothing_is_empty():
    assert built_from([], []).shape == (0, 3)
    blind = keyframe(0, np.eye(4), np.zeros((0, 3)))
    for keyframes in ([blind], [blind] * 3):
        built = built_from(keyframes, [np.eye(4)] * len(keyframes))
        assert built.shape == (0, 3)
        assert built.dtype == np.float32


def test_owners_that_changed_are_told_once():
    near = keyframe(0, np.eye(4), [[1.0, 0, 0]])
    owners = {4: planar(0, 0), 9: planar(40, 0)}
    static_map = settled([near], [np.eye(4)], owners)
    assert static_map.take_changed() == {4}
    assert static_map.take_changed() == set()
    static_map.settle([near], [planar(40, 0)], owners)
    assert static_map.take_changed() == {9}
    static_map.rehome(9, owners)
    assert static_map.take_changed() == {4}


# --- owners that leave


@pytest.mark.parametrize("turn", [0.0, np.pi / 2])
def test_rehoming_to_a_frame_of_the_same_grid_keeps_every_voxel_as_it_is(turn):
    keyframes, poses = clutter(5)
    owners = {0: np.eye(4), 1: planar(20 * VOXEL, 0, turn)}
    static_map = settled(keyframes, poses, {0: np.eye(4)})
    before = static_map.submaps[0]
    static_map.rehome(0, owners)
    after = static_map.submaps[1]
    assert list(static_map.submaps) == [1]
    back = transform(owners[1], after.means.astype(float))
    order = np.argsort(voxel_keys(back, VOXEL))
    np.testing.assert_allclose(back[order], before.means, atol=1e-4)
    np.testing.assert_array_equal(after.scores[order], before.scores)
    np.testing.assert_array_equal(after.weights[order], before.weights)


@pytest.mark.parametrize("seed", range(3))
def test_rehoming_to_any_frame_conserves_measurements_their_centre_and_scores(seed):
    rng = np.random.default_rng(seed)
    keyframes, poses = clutter(seed)
    owners = {i: exp(rng.normal(size=6) * [0.1, 0.1, 2, 4, 4, 0.3]) for i in range(4)}
    static_map = settled(keyframes, poses, owners)

    def totals():
        parts = static_map.submaps.items()
        weight = sum(s.weights.sum(dtype=int) for _, s in parts)
        moment = sum(
            transform(owners[o], s.means.astype(float)).T @ s.weights for o, s in parts if len(s)
        )
        return weight, moment / weight, sum(s.scores.sum(dtype=int) for _, s in parts)

    weight, centre, score = totals()
    owned = sum(map(len, static_map.submaps.values()))
    static_map.rehome(2, owners)
    assert 2 not in static_map.submaps
    assert totals()[0] == weight
    np.testing.assert_allclose(totals()[1], centre, atol=1e-4)
    assert totals()[2] == score  # three keyframes: far from the clamps
    assert 0.8 * owned < sum(map(len, static_map.submaps.values())) <= owned


def test_rehoming_who_owns_nothing_changes_nothing():
    static_map = StaticMap(VOXEL)
    static_map.rehome(3, {3: np.eye(4), 4: np.eye(4)})
    assert not static_map.submaps
    assert static_map.take_changed() == set()


# --- what moves


def beams():
    """Return the unit vectors of a LiDAR with 34 rings and 1 degree between columns."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(0, 360, 1.0)), np.radians(np.arange(-24, 10, 1.0))
    )
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
         np.sin(elevation)], axis=-1,
    ).reshape(-1, 3)  # fmt: skip


def scan_of(world, T):
    """Return a static sweep's points in the sensor's frame at T."""
    directions = beams() @ T[:3, :3].T
    ranges = world.cast(np.broadcast_to(T[:3, 3], directions.shape), directions)
    hit = ranges < 60
    return beams()[hit] * ranges[hit, None].astype(float)


def street(with_car_at=None):
    """Return a street with walls and poles, and a car somewhere on it."""
    meshes = [ground(100), box((10, 9, 0), (60, 1, 6)), box((10, -9, 0), (60, 1, 6))]
    meshes += [pole(x, 5.0, 0.1, 5.0) for x in (-5, 5, 15, 25)]
    if with_car_at is not None:
        meshes.append(box((with_car_at, 3.0, 0), (4.2, 1.8, 1.6)))
    return World(meshes)


def drive_by(car_at):
    """Return keyframes along a street, with a car at `car_at(i)` (x, or None) at each, and poses."""
    poses = [planar(1.0 * i, 0, 0, 1.8) for i in range(20)]
    scans = [thin(scan_of(street(car_at(i)), T), 0.2) for i, T in enumerate(poses)]
    return [keyframe(i, T, scans[i]) for i, T in enumerate(poses)], poses


@pytest.fixture(scope="module")
def empty_street():
    return drive_by(lambda _: None)


@pytest.fixture(scope="module")
def parked_car():
    return drive_by(lambda _: 12.0)


@pytest.fixture(scope="module")
def oncoming_car():
    return drive_by(lambda i: 25.0 - 2.0 * i)


def measured(keyframes, poses):
    """Return everything that was seen, in the map frame, thinned."""
    clouds = [transform(T, k.points.astype(float)) for k, T in zip(keyframes, poses, strict=True)]
    return thin(np.vstack(clouds), 0.2)


def in_lane(points):
    """Select what stands in the lane that the car uses, above the ground."""
    return points[(points[:, 2] > 0.4) & (points[:, 2] < 1.7) & (np.abs(points[:, 1] - 3) < 1.3)]


@pytest.mark.parametrize("at_a_time", [1, 6, 20])
def test_what_moves_leaves_no_trail(oncoming_car, empty_street, at_a_time):
    assert len(in_lane(measured(*oncoming_car))) > 300
    assert len(in_lane(built_from(*oncoming_car, at_a_time=at_a_time))) == 0
    assert len(in_lane(built_from(*empty_street, at_a_time=at_a_time))) == 0


@pytest.mark.parametrize("at_a_time", [1, 6, 20])
def test_what_stands_remains(empty_street, parked_car, at_a_time):
    keyframes, poses = empty_street
    static_map = settled(keyframes, poses, HOME, StaticMap(0.2), at_a_time)
    submap = static_map.submaps[0]
    assert submap.static.mean() > 0.995
    x, y, z = submap.means.T
    poles = (np.abs(y - 5) < 0.3) & (z > 0.4) & (np.abs(x - 10) < 6)
    assert poles.sum() > 100
    assert submap.static[poles].mean() > 0.98  # though they are thinner than a pixel
    with_car = settled(*parked_car, HOME, StaticMap(0.2), at_a_time)
    stands, kept = in_lane(with_car.submaps[0].means), in_lane(with_car.points(HOME))
    assert len(kept) > 0.98 * len(stands) > 100


def test_what_moves_is_removed_wherever_the_map_frame_lies(oncoming_car):
    keyframes, poses = oncoming_car
    X = exp(np.array([0.0, 0.0, 2.0, 500.0, -300.0, 20.0]))
    here = built_from(keyframes, poses)
    there = built_from(keyframes, [X @ T for T in poses])
    back = transform(invert(X), there.astype(float))
    assert len(in_lane(back)) == 0
    # Owners' voxels that lie askew in the map's fill fewer of these.
    assert len(there) == pytest.approx(len(here), rel=0.2)


def test_the_same_keyframes_give_the_same_map(oncoming_car):
    maps = [built_from(*oncoming_car) for _ in range(2)]
    np.testing.assert_array_equal(maps[0], maps[1])


def test_what_came_and_left_among_keyframes_settled_together_does_not_enter():
    (full, T), (free, _) = standing_before(12.0), standing_before(None)
    visits = [free] * 3 + [full] * 3 + [free] * 14
    static_map = settled(visits, [T] * 20, HOME, StaticMap(0.2), at_a_time=20)
    stood = settled([free] * 3 + [full] * 17, [T] * 20, HOME, StaticMap(0.2), at_a_time=20)
    assert len(in_lane(static_map.points(HOME))) < 0.02 * len(in_lane(stood.points(HOME)))


def test_what_passes_where_others_looked_through_before_does_not_enter(empty_street, parked_car):
    static_map = settled(*empty_street, HOME, StaticMap(0.2))
    glimpse, T = parked_car[0][-1], parked_car[1][-1]
    assert len(in_lane(transform(T, glimpse.points.astype(float)))) > 10
    static_map.settle([glimpse], [T], HOME)
    assert len(in_lane(static_map.points(HOME))) == 0


def standing_before(car_at):
    """Return a keyframe beside a place where a car is parked, or not."""
    T = planar(12.0, -1.0, 0, 1.8)
    return keyframe(0, T, thin(scan_of(street(car_at), T), 0.2)), T


def test_a_car_that_was_parked_for_50_visits_is_gone_after_the_stated_number_of_looks():
    (full, T), (free, _) = standing_before(12.0), standing_before(None)
    static_map = settled([full] * 50, [T] * 50, HOME, StaticMap(0.2))
    car = len(in_lane(static_map.points(HOME)))
    assert car > 100
    settled([free] * 2 * HIGH, [T] * 2 * HIGH, HOME, static_map)  # every second keyframe looks
    assert len(in_lane(static_map.points(HOME))) > 0.9 * car
    settled([free] * 2, [T] * 2, HOME, static_map)
    assert len(in_lane(static_map.points(HOME))) < 0.02 * car
    for one in static_map.submaps.values():
        assert len(in_lane(one.means[one.static])) < 0.02 * car


def test_in_the_next_visit_a_parked_car_that_left_is_gone_and_one_that_came_is_there(
    empty_street, parked_car
):
    static_map = StaticMap(0.2)
    for _ in range(3):
        settled(*parked_car, HOME, static_map)
    parked = len(in_lane(static_map.points(HOME)))
    left = settled(*empty_street, HOME, next_session(static_map))
    assert len(in_lane(left.points(HOME))) < 0.05 * parked
    came = settled(*parked_car, HOME, next_session(left))
    assert len(in_lane(came.points(HOME))) > 0.95 * parked


def next_session(static_map):
    """Return the map as another run gets it from the store."""
    again = StaticMap(static_map.voxel_size, static_map.max_range)
    again.restore({o: Submap(**s.arrays()) for o, s in static_map.submaps.items()})
    return again


def test_the_map_stops_growing_when_the_place_is_known(oncoming_car):
    keyframes, poses = oncoming_car
    owners = dict(enumerate(poses[::5]))
    static_map, sizes = StaticMap(0.2), []
    for _ in range(5):
        settled(keyframes, poses, owners, static_map)
        sizes.append(sum(map(len, static_map.submaps.values())))
    assert sizes[-1] <= 1.01 * sizes[0]
    assert sizes[-1] == pytest.approx(sizes[-2], rel=1e-3)
