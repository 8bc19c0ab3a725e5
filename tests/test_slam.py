"""The whole pipeline on two laps of a small town, with an odometry that drifts."""

import gtsam
import networkx
import numpy as np
import pytest
from scipy.spatial import cKDTree
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

from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.graph.marginalisation import StarMesh
from lifelong_slam.graph.pruning import NoPruning, Pruner, protected
from lifelong_slam.graph.selection import Geometry
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


def record(count, columns=120):
    """Return undistorted scans on the circle and the true poses as seen from the first."""
    world = town(0, 45, lambda xy: np.abs(np.linalg.norm(xy, axis=1) - RADIUS) < 4, spacing=7.0)
    lidar, rng = Lidar(columns=columns, duration=0.0, reach=40.0), np.random.default_rng(0)
    poses = np.array([on_the_circle(i) for i in range(count)])
    scans = [
        Scan(START + i * NANOSECONDS // 10, lidar.sweep(world, T, T, rng=rng).points)
        for i, T in enumerate(poses)
    ]
    return scans, invert(poses[0]) @ poses


@pytest.fixture(scope="module")
def recording():
    """Return 2.2 laps."""
    return record(SCANS)


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
        self.counts = {}
        self._next = 0

    def register(self, scan):
        T = self.poses[self._next]
        self._next += 1
        return estimate(scan.end_stamp, T, scan.points, self.covariance)


SPACING = 4.0  # between vertices
VOXEL = 0.3  # of the map


def pipeline(odometry, pruning=None, closer=None, **settings):
    closer = LoopCloser(0.5, **{"min_travel": 30.0, "spacing": 6.0} | (closer or {}))
    pruning = pruning or Pruner(Geometry(SPACING), StarMesh())
    static_map = StaticMap(VOXEL, 40.0)
    return LifelongSlam(odometry, closer, pruning, static_map, keyframe_distance=1.9, **settings)


def run(recording, count=None, pruning=None, **odometry):
    scans, truth = recording
    slam = pipeline(DriftingOdometry(truth, **odometry), pruning)
    times = [slam.process(scan) for scan in scans[:count]]
    return slam, slam.finish(), times


@pytest.fixture(scope="module")
def two_laps(recording):
    return run(recording)


@pytest.fixture(scope="module")
def unpruned(recording):
    return run(recording, pruning=NoPruning())


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
    slam = pipeline(DriftingOdometry(truth), closer={"min_travel": 1e9})
    for scan in scans[:60]:
        slam.process(scan)
    result = slam.finish()
    expected = np.array(DriftingOdometry(truth).poses[:60])
    np.testing.assert_allclose(result.trajectory.poses, expected, atol=1e-6)
    assert all(edge.kind == "odometry" for edge in result.graph.edges)
    assert result.counts["keyframes"] == 30
    assert sum(n for what, n in result.counts.items() if what.startswith("loop")) == 0


def test_counts_and_graph_tell_the_same_story(unpruned):
    _, result, times = unpruned
    kinds = [edge.kind for edge in result.graph.edges]
    accepted = sum(n for what, n in result.counts.items() if what.endswith(": accepted"))
    accepted += result.counts["loop by appearance"]
    assert kinds.count("loop") == accepted - result.counts["loop closures rejected"]
    assert kinds.count("loop") >= 5
    assert kinds.count("odometry") == len(result.graph.poses) - 1
    assert len(result.graph.poses) == result.counts["keyframes"]
    assert result.counts["keyframes"] == pytest.approx(SCANS * STEP / 2, rel=0.1)
    assert result.counts["keyframes pruned"] == 0
    assert [t.vertices for t in times] == sorted(t.vertices for t in times)
    assert times[-1].vertices == len(result.graph.poses)
    assert times[-1].edges == len(kinds)


def test_a_keyframe_is_a_vertex_or_pruned(two_laps, unpruned):
    slam, result, times = two_laps
    counts = result.counts
    assert counts["keyframes"] == unpruned[1].counts["keyframes"]
    assert counts["keyframes pruned"] > 0
    assert counts["removals checked"] > 0
    assert counts["removals refused"] == 0
    assert len(result.graph.poses) == counts["keyframes"] - counts["keyframes pruned"]
    # Until the end the newest are left alone.
    assert times[-1].vertices - len(result.graph.poses) <= 50
    assert all(
        t.odometry_ms >= 0 and t.loop_ms >= 0 and t.optimise_ms >= 0 and t.prune_ms >= 0
        for t in times
    )
    # What stays of a removed keyframe is its pose.
    assert set(slam._keyframes) == set(result.graph.poses)
    assert set(slam._static_map.submaps) <= set(result.graph.poses)


def test_vertices_are_spread_over_the_place(two_laps, unpruned):
    graph = two_laps[1].graph
    positions = np.array([T[:3, 3] for T in graph.poses.values()])
    free = [
        i for i, vertex in enumerate(graph.poses) if vertex not in protected(two_laps[0]._graph)
    ]
    assert len(free) > 0.7 * len(positions)
    # The optimiser moved some since they were chosen, but none within half the spacing.
    nearest = cKDTree(positions).query(positions[free], k=2)[0][:, 1]
    assert nearest.min() >= SPACING / 2
    assert np.mean(nearest > 0.9 * SPACING) > 0.9
    everywhere = np.array([T[:3, 3] for T in unpruned[1].graph.poses.values()])
    assert cKDTree(positions).query(everywhere)[0].max() < 2 * SPACING


def test_a_pruned_graph_is_small_and_connected(two_laps, unpruned):
    graph = two_laps[1].graph
    assert len(graph.poses) < 0.25 * len(unpruned[1].graph.poses)
    assert len(graph.edges) < 5 * len(graph.poses)
    structure = networkx.Graph((edge.source, edge.target) for edge in graph.edges)
    assert set(structure) == set(graph.poses)
    assert networkx.is_connected(structure)


def test_pruning_leaves_the_trajectory_where_it_was(recording, two_laps, unpruned):
    truth = recording[1]
    apart = errors(two_laps[1].trajectory.poses, unpruned[1].trajectory.poses)
    assert apart[:, 0].max() < 0.1
    assert apart[:, 1].max() < 0.01
    pruned, best = (errors(r.trajectory.poses, truth)[:, 0] for r in (two_laps[1], unpruned[1]))
    assert pruned.mean() < 1.15 * best.mean()


def test_pruning_leaves_the_map_what_it_was(two_laps, unpruned):
    maps = two_laps[1].map_points, unpruned[1].map_points
    for one, other in (maps, maps[::-1]):
        assert np.mean(cKDTree(other).query(one)[0] > VOXEL) < 0.01


def test_more_laps_do_not_make_graph_and_map_larger():
    scans, truth = record(round(3.2 * LAP / STEP), columns=60)
    slam, size = pipeline(DriftingOdometry(truth), window=10, settle_every=5), []
    for scan in scans:
        slam.process(scan)
        submaps = slam._static_map.submaps
        size.append([len(slam._graph), slam._graph.edge_count, len(slam._keyframes), len(submaps)])
    second_lap, later = np.array_split(np.array(size)[round(1.2 * LAP / STEP) :], 2)
    second_lap, later = second_lap.max(axis=0), later.max(axis=0)
    assert later[0] <= second_lap[0] + 2
    assert later[1] <= 1.3 * second_lap[1]
    assert later[2] == later[0]
    assert later[3] <= second_lap[3] + 1
    poses = slam.finish().trajectory.poses
    assert len(poses) == len(scans)


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
    """Before the window has filled and after: no scan, vertex or point is forgotten."""
    scans, truth = recording
    _, result, _ = run(recording, count)
    assert len(result.trajectory) == count
    assert errors(result.trajectory.poses, truth[:count])[:, 0].max() < 5.0
    keyframes = (count + 1) // 2
    assert result.counts["keyframes"] == keyframes
    assert len(result.graph.poses) == keyframes - result.counts["keyframes pruned"]
    last = count - 1 if count % 2 else count - 2
    points = scans[last].points[np.linalg.norm(scans[last].points, axis=1) < 15.0]
    seen = transform(result.trajectory.poses[last], points)
    assert np.mean(cKDTree(result.map_points).query(seen)[0] < VOXEL) > 0.9


def test_finishing_twice_is_harmless(recording):
    scans, truth = recording
    slam = pipeline(DriftingOdometry(truth))
    for scan in scans[:40]:
        slam.process(scan)
    first, second = slam.finish(), slam.finish()
    np.testing.assert_allclose(first.trajectory.poses, second.trajectory.poses, atol=1e-6)
    np.testing.assert_allclose(first.map_points, second.map_points, atol=1e-6)
    assert first.counts == second.counts


def test_a_viewer_may_watch_after_each_scan(recording):
    scans, truth = recording
    slam = pipeline(DriftingOdometry(truth))
    seen = []
    for i, scan in enumerate(scans[:60]):
        slam.process(scan)
        T, graph = slam.watch()
        assert (graph is not None) == (i % 2 == 0)
        seen.append(T)
    assert errors(np.array(seen), truth[:60])[:, 0].max() < 5.0


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
    slam = pipeline(BlindOdometry(truth), closer={"spacing": 2.0})
    for scan in scans[:110]:
        slam.process(scan)
    result = slam.finish()
    assert len(result.trajectory) == 110
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
