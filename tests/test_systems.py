import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from run_support import arc, room, scans
from scipy.spatial import cKDTree

from lifelong_slam.errors import ConfigError
from lifelong_slam.geometry import invert, rotation_angle
from lifelong_slam.systems.kiss_icp import KissIcpSystem
from lifelong_slam.systems.kiss_slam import KissSlamSystem
from lifelong_slam.systems.point_map import PointMap

try:
    import kiss_slam
except ImportError:
    kiss_slam = None

needs_kiss_slam = pytest.mark.skipif(
    kiss_slam is None, reason="the optional package kiss-slam isn't installed"
)
SYSTEMS = [KissIcpSystem, pytest.param(KissSlamSystem, marks=needs_kiss_slam)]
SETTINGS = {"min_range": 0.5, "max_range": 40.0, "voxel_size": 0.5}


def run(system, sequence):
    times = [system.process(scan) for scan in sequence]
    return times, system.finish()


@pytest.mark.parametrize("kind", SYSTEMS)
def test_follows_an_arc(kind):
    times, result = run(kind(**SETTINGS), scans(25))
    truth = arc(25)
    difference = invert(truth) @ result.trajectory.poses
    assert np.linalg.norm(difference[:, :3, 3], axis=1).max() < 0.05
    assert rotation_angle(difference).max() < 0.01
    assert all(row.odometry_ms > 0 for row in times)


@pytest.mark.parametrize("kind", SYSTEMS)
def test_poses_hold_at_the_end_of_the_sweep(kind):
    sequence = scans(3, offsets=np.linspace(0.0, 0.08, 50))
    _, result = run(kind(**SETTINGS), sequence)
    assert result.trajectory.stamps.tolist() == [scan.stamp + 80_000_000 for scan in sequence]


@pytest.mark.parametrize("kind", SYSTEMS)
@pytest.mark.parametrize("offset", [0.0, 0.05])
def test_survives_point_times_that_are_all_equal(kind, offset):
    _, result = run(kind(**SETTINGS), scans(4, offsets=np.array([offset])))
    _, plain = run(kind(**SETTINGS), scans(4))
    np.testing.assert_allclose(result.trajectory.poses, plain.trajectory.poses, atol=1e-9)


@pytest.mark.parametrize("kind", SYSTEMS)
def test_map_lies_on_the_world_with_a_point_a_voxel(kind):
    world = room()
    _, result = run(kind(**SETTINGS, map_voxel_size=0.2), scans(10, world=world))
    points = result.map_points
    assert points.dtype == np.float32
    assert len(np.unique(np.floor(points / np.float32(0.2)), axis=0)) > 0.95 * len(points)
    assert len(points) > 5000
    distances, _ = cKDTree(world).query(points)
    assert np.percentile(distances, 99) < 0.1


@pytest.mark.parametrize("kind", SYSTEMS)
def test_map_can_be_left_out(kind):
    _, result = run(kind(**SETTINGS, map_voxel_size=None), scans(3))
    assert result.map_points.shape == (0, 3)


@pytest.mark.parametrize("kind", SYSTEMS)
def test_one_scan_is_enough(kind):
    _, result = run(kind(**SETTINGS), scans(1))
    np.testing.assert_allclose(result.trajectory.poses, np.eye(4)[None], atol=1e-12)
    assert len(result.graph.poses) == 1
    assert result.graph.edges == []


REPEAT = """
import numpy as np
from run_support import scans
from lifelong_slam.systems.{module} import {name} as System
results = []
for _ in range(2):
    system = System(min_range=0.5, max_range=40.0, voxel_size=0.5, threads=1)
    for scan in scans(6):
        system.process(scan)
    results.append(system.finish())
first, second = results
assert np.array_equal(first.trajectory.poses, second.trajectory.poses)
assert np.array_equal(first.map_points, second.map_points)
"""


@pytest.mark.parametrize("kind", SYSTEMS)
def test_runs_with_one_thread_agree_to_the_last_bit(kind):
    """In a process of its own: KISS-ICP keeps the number of threads that it is first given."""
    code = REPEAT.format(module=kind.__module__.rpartition(".")[2], name=kind.__name__)
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent, timeout=120)


@pytest.mark.parametrize("kind", SYSTEMS)
def test_can_be_watched(kind):
    system = kind(**SETTINGS)
    for scan in scans(3):
        system.process(scan)
    T_map_sensor, _ = system.watch()
    np.testing.assert_allclose(T_map_sensor, system.finish().trajectory.poses[-1], atol=1e-9)


@pytest.mark.parametrize("kind", SYSTEMS)
@pytest.mark.parametrize(
    "wrong", [{"min_range": 50.0}, {"voxel_size": 0.0}, {"map_voxel_size": -1.0}]
)
def test_refuses_senseless_settings(kind, wrong):
    with pytest.raises(ConfigError):
        kind(**{**SETTINGS, **wrong})


def test_kiss_icp_graph_is_a_chain_that_agrees_with_the_poses():
    _, result = run(KissIcpSystem(**SETTINGS), scans(4))
    assert [(e.source, e.target, e.kind) for e in result.graph.edges] == [
        (i, i + 1, "odometry") for i in range(3)
    ]
    for edge in result.graph.edges:
        expected = invert(result.graph.poses[edge.source]) @ result.graph.poses[edge.target]
        np.testing.assert_allclose(edge.T_source_target, expected, atol=1e-12)


@pytest.mark.slow
@needs_kiss_slam
def test_kiss_slam_closes_a_loop_and_prints_nothing(capfd):
    """Two laps on a circle, with local maps that end sooner than the 100 m of the package."""
    radius, step, count = 30.0, 1.0, 415
    world = room(seed=3, size=60.0, boxes=120, points=300_000)
    poses = arc(count, step=step, turn=step / radius)
    system = KissSlamSystem(min_range=1.0, max_range=40.0, voxel_size=1.0)
    system._slam.local_map_splitting_distance = 35.0
    _, result = run(system, scans(count, world=world, poses=poses, visible=10_000))
    assert len(result.trajectory) == count
    assert result.counts["loops_accepted"] >= 1
    loops = [edge for edge in result.graph.edges if edge.kind == "loop"]
    assert len(loops) == result.counts["loops_accepted"]
    for edge in result.graph.edges:
        estimated = invert(result.graph.poses[edge.source]) @ result.graph.poses[edge.target]
        assert np.linalg.norm((invert(estimated) @ edge.T_source_target)[:3, 3]) < 0.3
    errors = np.linalg.norm(result.trajectory.positions - poses[:, :3, 3], axis=1)
    assert errors.max() < 1.0
    assert capfd.readouterr() == ("", "")


def test_point_map_keeps_one_point_a_voxel_across_merges(monkeypatch):
    monkeypatch.setattr("lifelong_slam.systems.point_map._SMALLEST_MERGE", 100)
    rng = np.random.default_rng(0)
    batches = rng.uniform(-3, 3, (20, 400, 3))
    point_map = PointMap(0.5)
    for batch in batches:
        point_map.add(batch, np.eye(4))
    expected = np.unique(np.floor(batches.reshape(-1, 3) / 0.5), axis=0)
    np.testing.assert_array_equal(np.floor(point_map.points() / 0.5), expected)
    first = batches[0][0]
    assert np.any(np.all(point_map.points() == first.astype(np.float32), axis=1))
