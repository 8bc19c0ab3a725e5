"""The front end on ray-cast sweeps whose true motion is known."""

import numpy as np
import pytest
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.kiss_icp import KissICP
from slam_support import (
    PERIOD,
    Lidar,
    World,
    box,
    drive,
    error_of,
    ground,
    planar,
    pole,
    seconds,
    town,
)

from lifelong_slam.geometry import invert, log, transform
from lifelong_slam.loop_closure.closer import relative_covariance
from lifelong_slam.odometry.kiss_icp import KissIcpOdometry
from lifelong_slam.scan import NANOSECONDS, Scan

RADIUS, SPEED, HEIGHT = 25.0, 8.0, 1.8
MIN_RANGE, MAX_RANGE = 1.0, 100.0


def circle(t):
    """Return the pose at a time on a circle driven at constant speed."""
    angle = SPEED * t / RADIUS
    return planar(RADIUS * np.sin(angle), -RADIUS * np.cos(angle), angle, HEIGHT)


def straight(speed):
    return lambda t: planar(speed * t, 0, 0, HEIGHT)


@pytest.fixture(scope="module")
def ring_town():
    return town(0, road=lambda xy: np.abs(np.linalg.norm(xy, axis=1) - RADIUS) < 6)


@pytest.fixture(scope="module")
def lap(ring_town):
    """Return the scans of 2.5 s at 8 m/s."""
    return drive(ring_town, Lidar(columns=180), circle, np.arange(25) * PERIOD)


@pytest.fixture(scope="module")
def short_drive():
    """Return a few light scans of a straight road."""
    world = town(1, road=lambda xy: np.abs(xy[:, 1]) < 6)
    return drive(world, Lidar(rings=12, columns=150), straight(SPEED), np.arange(8) * PERIOD)


def front_end(voxel_size=0.5):
    return KissIcpOdometry(voxel_size, MIN_RANGE, MAX_RANGE)


def run(scans, voxel_size=0.5):
    odometry = front_end(voxel_size)
    return [odometry.register(scan) for scan in scans]


def bare_poses(scans, voxel_size):
    """Return the poses of the package as published, on one thread."""
    config = KISSConfig(
        data=DataConfig(min_range=MIN_RANGE, max_range=MAX_RANGE, deskew=True),
        mapping=MappingConfig(voxel_size=voxel_size),
        registration=RegistrationConfig(max_num_threads=1),
    )
    odometry, poses = KissICP(config), []
    for scan in scans:
        odometry.register_frame(scan.points, scan.offsets)
        poses.append(odometry.last_pose)
    return poses


def true_poses(estimates, pose_at):
    """Return where the sensor was at the stamps of estimates, as seen from the first."""
    poses = np.array([pose_at(seconds(estimate.stamp)) for estimate in estimates])
    return invert(poses[0]) @ poses


def largest_error(estimates, pose_at):
    """Return the largest errors (m, rad) of estimates at the instants where they claim to hold."""
    truth = true_poses(estimates, pose_at)
    pairs = zip(estimates, truth, strict=True)
    return np.max([error_of(e.T_odom_sensor, T) for e, T in pairs], axis=0)


def assert_sound(estimates, scans):
    """Every estimate is a finite rigid motion with a usable covariance at an instant of its sweep."""
    for estimate, scan in zip(estimates, scans, strict=True):
        assert scan.end_stamp - scan.duration * NANOSECONDS - 1 <= estimate.stamp <= scan.end_stamp
        T = estimate.T_odom_sensor
        assert np.isfinite(T).all()
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
        assert np.isfinite(estimate.covariance).all()
        # The pose that defines the frame may be certain; no other is.
        least = np.linalg.eigvalsh(estimate.covariance).min()
        assert least > 0 or (least >= 0 and np.array_equal(T, np.eye(4)))
        assert np.isfinite(estimate.points).all()
    assert np.all(np.diff([estimate.stamp for estimate in estimates]) > 0)


@pytest.mark.parametrize(("voxel_size", "tolerance"), [(0.5, 0.05), (1.0, 0.1)])
def test_a_drive_is_recovered_from_distorted_sweeps(lap, voxel_size, tolerance):
    scans = lap
    estimates = run(scans, voxel_size)
    assert_sound(estimates, scans)
    np.testing.assert_array_equal(estimates[0].T_odom_sensor, np.eye(4))
    distance, angle = largest_error(estimates, circle)
    assert distance < tolerance
    assert angle < 0.003


def test_covariance_of_a_motion_stands_for_its_error(lap):
    scans = lap
    estimates, squared = run(scans), []
    truth = true_poses(estimates, circle)
    for i in range(5, len(scans) - 5, 5):
        a, b = estimates[i], estimates[i + 5]
        motion = invert(a.T_odom_sensor) @ b.T_odom_sensor
        error = log(invert(invert(truth[i]) @ truth[i + 5]) @ motion)
        covariance = relative_covariance(a, b, motion)
        squared.append(error @ np.linalg.solve(covariance, error))
    # 6 if it were exact; a tenfold sigma in either direction would show.
    assert 0.06 < np.mean(squared) < 60


@pytest.mark.parametrize(("duration", "width"), [(PERIOD, 2 * np.pi), (PERIOD / 3, 2.1)])
def test_deskewed_points_lie_on_the_true_surfaces(ring_town, duration, width):
    lidar = Lidar(duration=duration, width=width, columns=160, noise=0.005)
    scans = drive(ring_town, lidar, circle, np.arange(8) * PERIOD)
    last = run(scans)[-1]
    pose = circle(seconds(last.stamp))
    raw = scans[-1].points
    inside = raw[np.linalg.norm(raw, axis=1) > MIN_RANGE]
    deskewed = ring_town.distance(transform(pose, last.points))
    skewed = ring_town.distance(transform(pose, inside))
    assert len(last.points) == len(inside)
    assert np.percentile(deskewed, 95) < 0.05
    assert np.percentile(skewed, 95) > 3 * np.percentile(deskewed, 95)


def test_the_motion_of_a_whole_period_is_not_spread_over_a_short_sweep(ring_town):
    lidar = Lidar(duration=PERIOD / 3, width=2.1, columns=160, noise=0.005)
    scans = drive(ring_town, lidar, circle, np.arange(8) * PERIOD)
    config = KISSConfig(
        data=DataConfig(min_range=MIN_RANGE, max_range=MAX_RANGE, deskew=True),
        mapping=MappingConfig(voxel_size=0.5),
    )
    last, scan = run(scans)[-1], scans[-1]
    step = invert(circle(0.0)) @ circle(PERIOD)
    bare = KissICP(config).preprocessor.preprocess(scan.points, scan.offsets, step)
    ours = ring_town.distance(transform(circle(seconds(last.stamp)), last.points))
    theirs = ring_town.distance(transform(circle(seconds(scan.end_stamp)), bare))
    assert np.percentile(ours, 95) < 0.5 * np.percentile(theirs, 95)


def country_road(seed, structures):
    """Return flat ground with few things on it."""
    rng = np.random.default_rng(seed)
    meshes = [ground(400)]
    for _ in range(structures):
        x, y = rng.uniform(-20, 220), rng.choice([-1, 1]) * rng.uniform(8, 25)
        if rng.random() < 0.6:
            meshes.append(pole(x, y, 0.15, rng.uniform(3, 7)))
        else:
            meshes.append(box((x, y, 0), (4, 3, 2.5), rng.uniform(0, 3)))
    return World(meshes)


FORWARD = Lidar(width=2.1, elevations=(-0.2, 0.2), reach=MAX_RANGE, duration=PERIOD / 3)


@pytest.mark.parametrize(("seed", "structures"), [(0, 150), (2, 150), (0, 40), (2, 80), (3, 40)])
def test_a_start_at_full_speed_does_not_lock_at_standstill(seed, structures):
    scans = drive(country_road(seed, structures), FORWARD, straight(20.0), np.arange(20) * PERIOD)
    bare = bare_poses(scans, 1.0)
    assert np.linalg.norm(bare[-1][:3, 3]) < 1.0  # of 38 m: this is the trap
    distance, angle = largest_error(run(scans, 1.0), straight(20.0))
    assert distance < 1.0
    assert angle < 0.02


@pytest.mark.parametrize("speed", [0.0, -3.0, 12.0, 30.0])
def test_a_start_at_any_speed(speed):
    world = town(2, 80, lambda xy: np.abs(xy[:, 1]) < 6)
    scans = drive(world, Lidar(), straight(speed), np.arange(6) * PERIOD)
    distance, angle = largest_error(run(scans), straight(speed))
    assert distance < 0.06
    assert angle < 0.003


@pytest.mark.parametrize("lost", [[10], [10, 11, 12], list(range(8, 16))])
def test_lost_scans_do_not_lose_the_way(lap, lost):
    scans = lap
    estimates = run([scan for i, scan in enumerate(scans) if i not in lost])
    distance, angle = largest_error(estimates, circle)
    assert distance < 0.06
    assert angle < 0.003


def test_an_uneven_rate_is_predicted_by_time(ring_town):
    times = np.cumsum([0.0] + [0.1, 0.2, 0.1, 0.3] * 4)
    distance, _ = largest_error(run(drive(ring_town, Lidar(), circle, times)), circle)
    assert distance < 0.06


def test_prediction_takes_a_gap_into_account(lap):
    # After the gap there is nothing to see, so what remains is the prediction itself.
    scans = lap
    blind = Scan(scans[20].stamp, scans[20].points * 1e3, scans[20].offsets)
    estimates = run([*scans[:16], blind])
    assert error_of(estimates[-1].T_odom_sensor, true_poses(estimates, circle)[-1])[0] < 0.3


def test_identical_runs_give_identical_poses(lap):
    scans = lap
    first, second = run(scans[:12]), run(scans[:12])
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.T_odom_sensor, b.T_odom_sensor)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_scans_without_times_are_registered_as_they_are(ring_town):
    flash = Lidar(duration=0.0)
    scans = drive(ring_town, flash, circle, np.arange(12) * PERIOD)
    scans = [Scan(scan.stamp, scan.points) for scan in scans]
    estimates = run(scans)
    assert_sound(estimates, scans)
    distance, _ = largest_error(estimates, circle)
    assert distance < 0.05
    inside = np.linalg.norm(scans[-1].points, axis=1) > MIN_RANGE
    np.testing.assert_allclose(estimates[-1].points, scans[-1].points[inside])


def test_offsets_that_are_all_equal_mean_an_instant(short_drive):
    scans = short_drive
    instant = [Scan(s.stamp, s.points, np.full(len(s.points), 0.03)) for s in scans]
    untimed = [Scan(s.stamp + round(0.03 * NANOSECONDS), s.points) for s in scans]
    for a, b in zip(run(instant), run(untimed), strict=True):
        np.testing.assert_array_equal(a.T_odom_sensor, b.T_odom_sensor)
        assert a.stamp == b.stamp


def test_a_header_at_the_end_of_the_sweep_is_the_same_sweep(short_drive):
    scans = short_drive
    late = [Scan(s.stamp + round(0.1 * NANOSECONDS), s.points, s.offsets - 0.1) for s in scans]
    for a, b in zip(run(scans), run(late), strict=True):
        assert abs(a.stamp - b.stamp) <= 1
        np.testing.assert_allclose(a.T_odom_sensor, b.T_odom_sensor, atol=1e-3)


def few(scan, count):
    """Keep few points, the last one among them, so that the sweep ends when it did."""
    kept = np.linspace(0, len(scan.points) - 1, count + 1).astype(int)[1:]
    return Scan(scan.stamp, scan.points[kept], scan.offsets[kept])


def too_far(scan, _=0):
    return Scan(scan.stamp, scan.points * 1e3, scan.offsets)


def too_near(scan, _=0):
    return Scan(scan.stamp, scan.points * 1e-3, scan.offsets)


POOR = [(few, 1), (few, 2), (few, 5), (few, 19), (too_far, 0), (too_near, 0)]


@pytest.mark.parametrize(("spoil", "count"), POOR)
def test_nothing_but_poor_scans_is_survived_and_means_no_motion_worth_telling(
    short_drive, spoil, count
):
    scans = [spoil(scan, count) for scan in short_drive]
    estimates = run(scans)
    assert_sound(estimates, scans)
    assert np.sqrt(estimates[-1].covariance[3, 3]) > 0.2


@pytest.mark.parametrize(("spoil", "count"), [(few, 5), (few, 19), (too_far, 0)])
@pytest.mark.parametrize("spoilt", [[0], [1], [0, 1], [4], [4, 5, 6]], ids=str)
def test_poor_scans_among_good_ones_do_not_matter(short_drive, spoil, count, spoilt):
    scans = short_drive
    scans = [spoil(scan, count) if i in spoilt else scan for i, scan in enumerate(scans)]
    estimates = run(scans)
    assert_sound(estimates, scans)
    # Before the first good scan nothing is known; the frame is that of the first good one.
    first = next(i for i in range(len(scans)) if i not in spoilt)
    truth = true_poses(estimates, straight(SPEED))
    relative = invert(estimates[first].T_odom_sensor) @ estimates[-1].T_odom_sensor
    distance, angle = error_of(relative, invert(truth[first]) @ truth[-1])
    assert distance < 0.06
    assert angle < 0.003


def test_a_recording_of_one_scan(short_drive):
    scans = short_drive[:1]
    estimates = run(scans)
    assert_sound(estimates, scans)
    np.testing.assert_array_equal(estimates[0].T_odom_sensor, np.eye(4))


def test_a_scan_that_ends_when_the_last_one_did_is_survived(short_drive):
    # Of the next sweep only the first column returned something.
    scans = short_drive
    early = scans[4].offsets == scans[4].offsets.min()
    stump = Scan(scans[4].stamp, scans[4].points[early], scans[4].offsets[early])
    assert stump.end_stamp <= scans[3].end_stamp
    estimates = run([*scans[:4], stump, *scans[5:]])
    assert all(np.isfinite(estimate.T_odom_sensor).all() for estimate in estimates)
