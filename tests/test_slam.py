"""The whole pipeline on two laps of a small town, with an odometry that drifts."""

import gtsam
import numpy as np
import pytest
from slam_support import (
    PERIOD,
    START,
    Lidar,
    World,
    box,
    drive,
    error_of,
    estimate,
    ground,
    planar,
    seconds,
    town,
)

from lifelong_slam.geometry import exp, invert
from lifelong_slam.io.g2o import write_g2o
from lifelong_slam.loop_closure.closer import LoopCloser
from lifelong_slam.mapping.static_map import StaticMap
from lifelong_slam.odometry.kiss_icp import KissIcpOdometry
from lifelong_slam.scan import NANOSECONDS, Scan
from lifelong_slam.slam import LifelongSlam
from lifelong_slam.sources.cleaning import InputCounts, clean

RADIUS, STEP = 16.0, 1.0
LAP = 2 * np.pi * RADIUS
SCANS = round(2.2 * LAP / STEP)
SIGMAS = np.array([2e-4, 2e-4, 2e-3, 0.01, 0.01, 0.003])  # of a scan's pose
DRIFT = np.array([0, 0, 1.5e-3, 0, 0, 0.0])  # rad a scan, on top of the noise


def on_the_circle(i):
    angle = STEP * i / RADIUS
    return planar(RADIUS * np.sin(angle), -RADIUS * np.cos(angle), angle, 1.8)


@pytest.fixture(scope="module")
def recording():
    """Return undistorted scans of 2.2 laps and the true poses as seen from the first."""
    world = town(0, 45, lambda xy: np.abs(np.linalg.norm(xy, axis=1) - RADIUS) < 4, spacing=7.0)
    lidar, rng = Lidar(columns=180, duration=0.0, reach=40.0), np.random.default_rng(0)
    poses = np.array([on_the_circle(i) for i in range(SCANS)])
    scans = [
        Scan(START + i * NANOSECONDS // 10, lidar.sweep(world, T, T, rng=rng).points)
        for i, T in enumerate(poses)
    ]
    return scans, invert(poses[0]) @ poses


class DriftingOdometry:
    """An odometry that knows the truth but for noise and a steady drift in heading."""

    def __init__(self, truth, drift=DRIFT, seed=0):
        rng = np.random.default_rng(seed)
        steps = invert(truth[:-1]) @ truth[1:]
        self.poses = [np.eye(4)]
        for step in steps:
            error = exp(drift + rng.normal(size=6) * SIGMAS * (np.any(drift) > 0))
            self.poses.append(self.poses[-1] @ step @ error)
        self.covariance = np.diag(SIGMAS**2 + drift**2)
        self._next = 0

    def register(self, scan):
        T = self.poses[self._next]
        self._next += 1
        return estimate(scan.end_stamp, T, scan.points, self.covariance)


def pipeline(odometry, **settings):
    closer = LoopCloser(0.5, **{"min_travel": 30.0, "spacing": 6.0} | settings)
    return LifelongSlam(odometry, closer, StaticMap(0.3, 40.0), keyframe_distance=1.9)


def run(recording, count=None, **odometry):
    scans, truth = recording
    slam = pipeline(DriftingOdometry(truth, **odometry))
    times = [slam.process(scan) for scan in scans[:count]]
    return slam, slam.finish(), times


@pytest.fixture(scope="module")
def two_laps(recording):
    return run(recording)


def errors(poses, truth):
    return np.array([error_of(T, true) for T, true in zip(poses, truth, strict=True)])


def test_closed_loops_undo_the_drift(recording, two_laps):
    truth = recording[1]
    drifted = errors(DriftingOdometry(truth).poses, truth)
    closed = errors(two_laps[1].trajectory.poses, truth)
    assert drifted[:, 0].max() > 3.0
    assert closed[:, 0].max() < 0.25 * drifted[:, 0].max()
    # The laps lie upon each other, wherever the whole may have turned to.
    lap = round(LAP / STEP)
    poses = two_laps[1].trajectory.poses
    apart = errors(invert(poses[5:100]) @ poses[5 + lap : 100 + lap],
                   invert(truth[5:100]) @ truth[5 + lap : 100 + lap])  # fmt: skip
    assert np.median(apart[:, 0]) < 0.1


def test_there_is_a_pose_for_every_scan_and_the_path_has_no_jumps(recording, two_laps):
    scans, truth = recording
    trajectory = two_laps[1].trajectory
    np.testing.assert_array_equal(trajectory.stamps, [scan.end_stamp for scan in scans])
    steps = invert(trajectory.poses[:-1]) @ trajectory.poses[1:]
    odometry = np.array(DriftingOdometry(truth).poses)
    believed = invert(odometry[:-1]) @ odometry[1:]
    # What closures correct is spread; no step differs from odometry's by more than a little.
    assert errors(steps, believed).max(axis=0)[0] < 0.1
    assert errors(steps, believed).max(axis=0)[1] < 0.02


def test_keyframes_keep_the_poses_that_the_graph_gives_them(two_laps):
    _, result, _ = two_laps
    poses = result.trajectory.poses
    for T in result.graph.poses.values():
        distance = np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1)
        np.testing.assert_allclose(poses[np.argmin(distance)], T, atol=1e-9)


def test_without_closures_the_trajectory_is_odometrys(recording):
    scans, truth = recording
    slam = pipeline(DriftingOdometry(truth), min_travel=1e9)
    for scan in scans[:60]:
        slam.process(scan)
    result = slam.finish()
    expected = np.array(DriftingOdometry(truth).poses[:60])
    np.testing.assert_allclose(result.trajectory.poses, expected, atol=1e-6)
    assert all(edge.kind == "odometry" for edge in result.graph.edges)
    assert sum(result.counts.values()) == 0


def test_counts_and_graph_tell_the_same_story(two_laps):
    _, result, times = two_laps
    kinds = [edge.kind for edge in result.graph.edges]
    accepted = sum(n for what, n in result.counts.items() if what.endswith(": accepted"))
    assert kinds.count("loop") == accepted - result.counts["loop closures outvoted"]
    assert kinds.count("loop") >= 5
    assert kinds.count("odometry") == len(result.graph.poses) - 1
    assert len(result.graph.poses) == pytest.approx(SCANS * STEP / 2, rel=0.1)
    assert [t.vertices for t in times] == sorted(t.vertices for t in times)
    assert times[-1].vertices == len(result.graph.poses)
    assert all(t.odometry_ms >= 0 and t.loop_ms >= 0 and t.optimise_ms >= 0 for t in times)


def test_the_graph_can_be_written_and_read_by_gtsam(two_laps, tmp_path):
    graph = two_laps[1].graph
    write_g2o(tmp_path / "graph.g2o", graph)
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert values.size() == len(graph.poses)
    assert factors.size() == len(graph.edges)
    for vertex, T in graph.poses.items():
        np.testing.assert_allclose(values.atPose3(vertex).matrix(), T, atol=1e-5)


def test_the_map_lies_on_the_true_surfaces(recording, two_laps):
    points = two_laps[1].map_points
    assert points.dtype == np.float32
    assert len(points) > 5000
    flat = points[np.linalg.norm(points[:, :2] - [0, RADIUS], axis=1) < 2 * RADIUS]
    low = flat[np.abs(flat[:, 2] + 1.8) < 0.5]
    assert np.median(np.abs(low[:, 2] + 1.8)) < 0.1  # the ground is where it was


def test_the_end_may_come_after_one_scan(recording):
    _, result, _ = run(recording, 1)
    np.testing.assert_allclose(result.trajectory.poses, [np.eye(4)], atol=1e-12)
    assert len(result.graph.poses) == 1
    assert result.graph.edges == []
    assert len(result.map_points) > 100


@pytest.mark.parametrize("count", [2, 3, 50, 130])
def test_the_end_may_come_at_any_time(recording, count):
    _, result, _ = run(recording, count)
    assert len(result.trajectory) == count
    assert np.isfinite(result.trajectory.poses).all()
    assert errors(result.trajectory.poses, recording[1][:count])[:, 0].max() < 5.0


def test_finishing_twice_and_going_on_in_between_is_harmless(recording):
    scans, truth = recording
    slam = pipeline(DriftingOdometry(truth))
    for scan in scans[:40]:
        slam.process(scan)
    first, second = slam.finish(), slam.finish()
    np.testing.assert_allclose(first.trajectory.poses, second.trajectory.poses, atol=1e-6)
    slam.process(scans[40])
    assert len(slam.finish().trajectory) == 41
    assert len(first.trajectory) == 40


def test_two_runs_are_equal_to_the_last_bit(recording, two_laps):
    _, again, _ = run(recording)
    np.testing.assert_array_equal(again.trajectory.poses, two_laps[1].trajectory.poses)
    np.testing.assert_array_equal(again.map_points, two_laps[1].map_points)
    assert again.counts == two_laps[1].counts


class BlindOdometry(DriftingOdometry):
    """Sees nothing in range in some scans."""

    def register(self, scan):
        blind = (self._next // 20) % 2 == 0
        return super().register(Scan(scan.stamp, np.zeros((0, 3))) if blind else scan)


def test_scans_with_nothing_in_range_leave_keyframes_without_points(recording):
    scans, truth = recording
    slam = pipeline(BlindOdometry(truth), local_map_length=10.0, spacing=2.0)
    for scan in scans[:150]:
        slam.process(scan)
    result = slam.finish()
    assert len(result.trajectory) == 150
    assert np.isfinite(result.trajectory.poses).all()


def test_a_recording_in_which_nothing_is_ever_in_range():
    odometry = KissIcpOdometry(0.5, 1.0, 40.0)
    slam = pipeline(odometry)
    for i in range(5):
        slam.process(Scan(START + i * NANOSECONDS // 10, np.full((100, 3), 1e3)))
    result = slam.finish()
    assert len(result.trajectory) == 5
    assert result.map_points.shape == (0, 3)


def test_a_stump_of_a_sweep_does_not_spoil_the_end_of_the_run():
    # Only its first column returned something, so it ends before the sweep before it did.
    world = town(1, 40, lambda xy: np.abs(xy[:, 1]) < 6)
    scans = drive(world, Lidar(columns=120), lambda t: planar(5 * t, 0, 0, 1.8),
                  np.arange(5) * PERIOD)  # fmt: skip
    early = scans[3].offsets <= np.unique(scans[3].offsets)[0]
    scans[3] = Scan(scans[3].stamp, scans[3].points[early], scans[3].offsets[early])
    assert scans[3].end_stamp <= scans[2].end_stamp
    slam = pipeline(KissIcpOdometry(0.5, 1.0, 40.0))
    for scan in clean(scans, InputCounts()):
        slam.process(scan)
    trajectory = slam.finish().trajectory
    assert np.isfinite(trajectory.poses).all()
    passed = seconds(trajectory.stamps[-1]) - seconds(trajectory.stamps[0])
    assert trajectory.positions[-1, 0] == pytest.approx(5 * passed, abs=0.1)


def test_a_world_is_what_rays_see():
    # The ray caster behind these tests, by hand: a wall at 5 m, the ground 2 m below.
    world = World([ground(50), box((5.5, 0, 0), (1, 20, 10))])
    origin = np.array([[0, 0, 2.0]] * 2)
    np.testing.assert_allclose(world.cast(origin, np.array([[1, 0, 0], [0, 0, -1.0]])), [5, 2])
