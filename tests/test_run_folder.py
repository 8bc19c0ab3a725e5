"""The run folder, read back by the programs that others would use."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore
from run_folder_support import T_BASE_SENSOR, some_graph

from lifelong_slam.geometry import exp, transform
from lifelong_slam.io.bags import write_pose_bag
from lifelong_slam.io.g2o import read_g2o
from lifelong_slam.io.ply import write_ply
from lifelong_slam.result import GraphSnapshot, SlamResult
from lifelong_slam.run_folder import (
    graph_to_base,
    link_reference_map,
    points_to_base,
    trajectory_to_base,
    write_run,
)
from lifelong_slam.runner import RunRecord
from lifelong_slam.timeline import Timeline, TimelineRow
from lifelong_slam.trajectory import Trajectory, read_tum

EPOCH = 1_700_000_000_123_456_789


def some_record(count=60, points=1000):
    rng = np.random.default_rng(4)
    seconds = np.arange(count) * 0.1
    poses = exp(seconds[:, None] * np.array([0.01, 0.02, 0.3, 4.0, 0.2, 0.1]))
    stamps = EPOCH + np.arange(count, dtype=np.int64) * 100_000_000
    cloud = rng.normal(size=(points, 3)).astype(np.float32) * 20
    result = SlamResult(Trajectory(stamps, poses), cloud, some_graph(rng))
    rows = [TimelineRow(int(s), 20.5, 1.25, 0.0, 0.0, 3, 2, 512.0, 64.0, 150.0) for s in stamps]
    return RunRecord(result, Timeline(rows), {}, 2.0, 600.0, False)


def some_reference(record):
    """The run's own path at 50 Hz in another frame: what a perfect system would be compared to."""
    own = trajectory_to_base(record.result.trajectory, T_BASE_SENSOR)
    stamps = np.arange(own.stamps[0], own.stamps[-1] + 1, 20_000_000)
    world = exp(np.array([0.0, 0.0, 1.0, 100.0, 200.0, 10.0]))
    return Trajectory(stamps, world @ own.at(stamps))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "new" / "folder"
    record = some_record()
    reference = some_reference(record)
    write_run(folder, record, reference, T_BASE_SENSOR)
    return folder, record, reference


def test_all_files_are_there_and_nothing_else(run):
    folder, *_ = run
    assert {path.name for path in folder.iterdir()} == {
        "trajectory.tum",
        "reference.tum",
        "trajectory.bag",
        "map.bag",
        "map.ply",
        "pose_graph.g2o",
        "timeline.csv",
    }


def test_trajectory_is_the_base_in_the_map(run):
    folder, record, _ = run
    written = read_tum(folder / "trajectory.tum")
    np.testing.assert_array_equal(written.stamps, record.result.trajectory.stamps)
    np.testing.assert_allclose(written.poses[0], np.eye(4), atol=1e-12)
    expected = T_BASE_SENSOR @ record.result.trajectory.poses @ np.linalg.inv(T_BASE_SENSOR)
    np.testing.assert_allclose(written.poses, expected, atol=1e-12)


def test_points_seen_by_a_sensor_land_in_the_same_place_through_base_and_sensor():
    record = some_record()
    T_map_sensor = record.result.trajectory.poses[30]
    T_map_base = trajectory_to_base(record.result.trajectory, T_BASE_SENSOR).poses[30]
    seen = np.random.default_rng(0).normal(size=(10, 3)) * 10
    mapped = transform(T_map_sensor, seen).astype(np.float32)
    through_base = transform(T_map_base @ T_BASE_SENSOR, seen)
    np.testing.assert_allclose(points_to_base(mapped, T_BASE_SENSOR), through_base, atol=1e-4)


def test_reference_is_written_as_it_is(run):
    folder, _, reference = run
    written = read_tum(folder / "reference.tum")
    np.testing.assert_array_equal(written.stamps, reference.stamps)
    np.testing.assert_array_equal(written.positions, reference.positions)


def test_evo_ape_runs_from_its_command_line(run, tmp_path):
    folder, *_ = run
    program = Path(sys.executable).with_name("evo_ape")
    arguments = ["tum", "reference.tum", "trajectory.tum", "-a", "--sync_method", "interpolation"]
    done = subprocess.run(
        [program, *arguments],
        cwd=folder,
        env={**os.environ, "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    rmse = next(line.split()[1] for line in done.stdout.splitlines() if "rmse" in line)
    assert float(rmse) < 1e-3


def test_rosbags_reads_both_trajectories(run):
    folder, _, reference = run
    store = get_typestore(Stores.ROS1_NOETIC)
    estimate = read_tum(folder / "trajectory.tum")
    with Reader(folder / "trajectory.bag") as bag:
        assert {name: t.msgtype for name, t in bag.topics.items()} == {
            "/trajectory/base/pose": "geometry_msgs/msg/Pose",
            "/odometry/base/pose": "geometry_msgs/msg/Pose",
        }
        messages = list(bag.messages())
    for topic, expected in (
        ("/trajectory/base/pose", estimate),
        ("/odometry/base/pose", reference),
    ):
        rows = [(stamp, data) for c, stamp, data in messages if c.topic == topic]
        assert [stamp for stamp, _ in rows] == expected.stamps.tolist()
        pose = store.deserialize_ros1(rows[7][1], "geometry_msgs/msg/Pose")
        position = [pose.position.x, pose.position.y, pose.position.z]
        np.testing.assert_allclose(position, expected.positions[7], atol=1e-12)
        q = pose.orientation
        written = gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z).matrix()
        np.testing.assert_allclose(written, expected.poses[7, :3, :3], atol=1e-12)
    stamps = [stamp for _, stamp, _ in messages]
    assert stamps == sorted(stamps)


def test_rosbags_reads_the_map(run):
    folder, record, _ = run
    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(folder / "map.bag") as bag:
        ((connection, stamp, data),) = bag.messages()
    cloud = store.deserialize_ros1(data, "sensor_msgs/msg/PointCloud2")
    assert (connection.topic, cloud.header.frame_id) == ("/map", "map")
    assert stamp == record.result.trajectory.stamps[-1]
    assert cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec == stamp
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
    ]
    points = cloud.data.view("<f4").reshape(cloud.width, 3)
    np.testing.assert_array_equal(points, points_to_base(record.result.map_points, T_BASE_SENSOR))


def test_open3d_reads_the_map(run):
    o3d = pytest.importorskip("open3d")
    folder, record, _ = run
    cloud = o3d.t.io.read_point_cloud(str(folder / "map.ply"))
    points = cloud.point.positions.numpy()
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points, points_to_base(record.result.map_points, T_BASE_SENSOR))


def test_points_are_transformed_in_blocks(monkeypatch):
    points = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    whole = points_to_base(points, T_BASE_SENSOR)
    monkeypatch.setattr("lifelong_slam.run_folder._BLOCK", 3)
    np.testing.assert_allclose(points_to_base(points, T_BASE_SENSOR), whole, rtol=1e-6)


def test_graph_is_the_bases(run):
    folder, record, _ = run
    expected = graph_to_base(record.result.graph, T_BASE_SENSOR)
    written = read_g2o(folder / "pose_graph.g2o")
    for i, pose in expected.poses.items():
        np.testing.assert_allclose(written.poses[i], pose, atol=1e-12)


def test_timeline_has_one_row_a_scan(run):
    folder, record, _ = run
    header, first, *rest = (folder / "timeline.csv").read_text().splitlines()
    assert header == (
        "stamp,odometry_ms,loop_ms,optimise_ms,prune_ms,vertices,edges,rss_mb,child_rss_mb,cpu_percent"
    )
    assert first == "1700000000.123456789,20.500,1.250,0.000,0.000,3,2,512.000,64.000,150.000"
    assert len(rest) == len(record.timeline) - 1


def test_without_reference_an_old_one_does_not_stay(tmp_path):
    record = some_record(5, 10)
    write_run(tmp_path, record, some_reference(record), np.eye(4))
    write_run(tmp_path, record, None, np.eye(4))
    assert not (tmp_path / "reference.tum").exists()
    with Reader(tmp_path / "trajectory.bag") as bag:
        assert set(bag.topics) == {"/trajectory/base/pose"}


def test_the_reference_map_is_a_link_that_goes_where_the_run_folder_goes(tmp_path):
    surface, folder = tmp_path / "cache" / "surface.ply", tmp_path / "outputs" / "run"
    for path in (surface.parent, folder):
        path.mkdir(parents=True)
    surface.write_text("points")
    link_reference_map(folder, surface)
    link_reference_map(folder, surface)
    link = folder / "reference_map.ply"
    assert link.is_symlink()
    assert not link.readlink().is_absolute()
    assert link.read_text() == "points"
    link_reference_map(folder, None)
    assert not link.is_symlink()
    assert surface.exists()


def test_a_run_of_one_scan_without_map_or_graph_is_written(tmp_path):
    trajectory = Trajectory(np.array([EPOCH]), np.eye(4)[None])
    result = SlamResult(trajectory, np.zeros((0, 3), np.float32), GraphSnapshot({}, []))
    write_run(tmp_path, RunRecord(result, [], {}, 1.0, 1.0, False), None, np.eye(4))
    assert len(read_tum(tmp_path / "trajectory.tum")) == 1
    assert read_g2o(tmp_path / "pose_graph.g2o").poses == {}
    with Reader(tmp_path / "map.bag") as bag:
        assert bag.message_count == 1


def test_poses_without_a_ros_time_are_left_out_with_a_warning(tmp_path, caplog):
    trajectory = Trajectory(np.array([-5, 0, 7]), np.tile(np.eye(4), (3, 1, 1)))
    with caplog.at_level(logging.WARNING):
        write_pose_bag(tmp_path / "a.bag", {"/pose": trajectory})
    assert "1 poses have no valid ROS time" in caplog.text
    with Reader(tmp_path / "a.bag") as bag:
        assert [stamp for _, stamp, _ in bag.messages()] == [0, 7]


def test_clouds_of_a_wrong_shape_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        write_ply(tmp_path / "a.ply", np.zeros((5, 4), np.float32))
