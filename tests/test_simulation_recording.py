"""A small campaign, recorded: what the bag holds, and that it agrees with the truth beside it."""

import errno
import json
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader, Writer

from lifelong_slam.errors import ConfigError, SourceError
from lifelong_slam.scan import Scan
from lifelong_slam.simulation import source as source_module
from lifelong_slam.simulation.campaign import Campaign, make_campaign
from lifelong_slam.simulation.messages import TYPESTORE
from lifelong_slam.simulation.recorder import START_STAMP, record
from lifelong_slam.simulation.returns import Label
from lifelong_slam.simulation.sensors import make_sensor
from lifelong_slam.simulation.source import SimulatedSource, ensure_recorded
from lifelong_slam.simulation.truth import read_labels
from lifelong_slam.trajectory import read_tum

TOPICS = {"bosch": "/rbldar/pointcloud", "velodyne": "/velodyne/pointcloud"}
SETTINGS: dict[str, Any] = {
    "name": "test",
    "kind": "urban",
    "distance": 16.0,
    "speed": 10.0,
    "route": [{"straight": 4.0}, {"turn": 20, "radius": 20.0, "ramp": 3.0}, {"straight": 2.02}],
    "traffic": [
        {
            "kind": "van",
            "direction": "opposite",
            "lateral": 3.3,
            "speed": 8.0,
            "count": 1,
            "first": 40,
        }
    ],
    "crosstalk": {"bosch": 0.02},
    "rig": ["bosch", "velodyne"],
    "azimuth_steps": {"bosch": 0.8, "velodyne": 0.8},
}


def make_source(cache: Path, sensor: str = "bosch", **changes: Any) -> SimulatedSource:
    return SimulatedSource(topic=TOPICS[sensor], cache_dir=str(cache), **{**SETTINGS, **changes})


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("campaigns")


@pytest.fixture(scope="module", params=["bosch", "velodyne"])
def sensor(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def source(cache: Path, sensor: str) -> SimulatedSource:
    return make_source(cache, sensor)


@pytest.fixture(scope="module")
def world(source: SimulatedSource) -> o3d.t.geometry.RaycastingScene:
    mesh = o3d.t.io.read_triangle_mesh(str(source.folder / "world.ply"))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh)
    return scene


def sensor_poses(source: SimulatedSource, scan: Scan, late: float = 0.0) -> np.ndarray:
    """Return T_world_sensor (N, 4, 4) at each point's time, `late` seconds wrong."""
    assert scan.offsets is not None
    stamps = scan.stamp + np.round((scan.offsets + late) * 1e9).astype(np.int64)
    return source.reference().at(stamps) @ source.T_base_sensor


def range_errors(
    scene: o3d.t.geometry.RaycastingScene, poses: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Return measured minus true range of (N, 3) points in the sensor frame."""
    ranges = np.linalg.norm(points, axis=1)
    beams = np.einsum("nij,nj->ni", poses[:, :3, :3], points / ranges[:, None])
    rays = np.concatenate([poses[:, :3, 3], beams], axis=1).astype(np.float32)
    return ranges - scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()


def test_static_points_lie_on_the_true_surface(
    source: SimulatedSource, sensor: str, world: o3d.t.geometry.RaycastingScene
) -> None:
    """Frames, times, motion during the sweep and noise are right only if all of this holds."""
    labels, sigma = read_labels(source.folder, sensor), make_sensor(sensor).sigma
    scans = list(source)
    for i in (0, 7, len(scans) - 1):
        scan = scans[i]
        static = labels.of_sweep(i) == Label.STATIC
        errors = range_errors(world, sensor_poses(source, scan)[static], scan.points[static])
        # Beams that graze an edge may, by rounding, meet what is behind it.
        regular = errors[np.abs(errors) < 6 * sigma]
        assert len(regular) > 0.995 * len(errors)
        assert regular.mean() == pytest.approx(0, abs=0.002)
        assert regular.std() == pytest.approx(sigma, rel=0.05)


def test_wrong_times_would_show(
    source: SimulatedSource, sensor: str, world: o3d.t.geometry.RaycastingScene
) -> None:
    scan = list(source)[7]
    static = read_labels(source.folder, sensor).of_sweep(7) == Label.STATIC
    late = sensor_poses(source, scan, late=0.02)[static]
    errors = range_errors(world, late, scan.points[static])
    assert np.median(np.abs(errors)) > 1.5 * make_sensor(sensor).sigma


def test_moving_points_hide_the_static_world(
    source: SimulatedSource, sensor: str, world: o3d.t.geometry.RaycastingScene
) -> None:
    labels = read_labels(source.folder, sensor)
    for i, scan in enumerate(source):
        moving = labels.of_sweep(i) == Label.MOVING
        if moving.any():
            errors = range_errors(world, sensor_poses(source, scan)[moving], scan.points[moving])
            assert np.all(errors < 0.3)


def test_moving_points_move_and_static_ones_do_not(source: SimulatedSource, sensor: str) -> None:
    labels = read_labels(source.folder, sensor)
    middles = []
    for i, scan in enumerate(source):
        moving = labels.of_sweep(i) == Label.MOVING
        if moving.sum() >= 30:
            poses = sensor_poses(source, scan)[moving]
            points = np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points[moving])
            middles.append((i, (points + poses[:, :3, 3]).mean(axis=0)))
    (first, start), (last, end) = middles[0], middles[-1]
    assert last - first >= 8
    pace = np.linalg.norm(end - start) / (0.1 * (last - first))
    # What is seen of the van changes with the view, so its middle is known to a metre or two.
    assert pace == pytest.approx(8.0, rel=0.25)


def test_crosstalk_is_seen_by_the_named_sensor_only(cache: Path) -> None:
    folder = make_source(cache).folder
    share = {s: np.mean(read_labels(folder, s).values == Label.CROSSTALK) for s in TOPICS}
    assert share["velodyne"] == 0
    assert 0.005 < share["bosch"] < 0.06


def test_the_cloud_is_cropped_as_in_section_3_3_1(source: SimulatedSource) -> None:
    points = np.concatenate([scan.points for scan in source])
    ranges = np.linalg.norm(points, axis=1)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.degrees(np.arcsin(points[:, 2] / ranges))
    assert ranges.min() >= 3
    assert ranges.max() <= 240
    assert np.abs(azimuth).max() <= 60
    assert np.ptp(elevation) <= 24
    assert np.ptp(elevation) > 22


def test_columns_are_timed_by_the_sweep(source: SimulatedSource, sensor: str) -> None:
    scan = next(iter(source))
    assert scan.offsets is not None
    assert np.all(np.diff(scan.offsets) >= 0)
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    # The VLS-128 turns all around in 0.1 s and starts at the rear; the B2 needs all of it ahead.
    expected = (180 - azimuth) / 360 if sensor == "velodyne" else (60 - azimuth) / 120
    np.testing.assert_allclose(scan.offsets, 0.1 * expected, atol=1e-6)


def test_scans_and_truth_share_the_clock(source: SimulatedSource) -> None:
    scans, truth = list(source), source.reference()
    assert len(scans) == len(source) == 16
    assert [scan.stamp for scan in scans] == [START_STAMP + k * 10**8 for k in range(16)]
    assert truth.stamps[0] <= scans[0].stamp
    assert truth.stamps[-1] >= scans[-1].end_stamp
    assert truth.length == pytest.approx(16.0, rel=0.005)


def test_the_bag_has_the_topics_types_and_fields_of_section_3_3_1(cache: Path) -> None:
    with AnyReader([make_source(cache).folder / "campaign.bag"]) as bag:
        types = {c.topic: (c.msgtype, c.msgcount) for c in bag.connections}
        assert types == {
            "/rbldar/pointcloud": ("sensor_msgs/msg/PointCloud2", 16),
            "/velodyne/pointcloud": ("sensor_msgs/msg/PointCloud2", 16),
            "/imar/odom": ("nav_msgs/msg/Odometry", 161),
            "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
        }
        received = [stamp for _, stamp, _ in bag.messages()]
        assert received == sorted(received)
        clouds = [c for c in bag.connections if "pointcloud" in c.topic]
        for connection, stamp, raw in bag.messages(clouds):
            cloud = bag.deserialize(raw, connection.msgtype)
            fields = [(f.name, f.datatype) for f in cloud.fields]
            assert fields == [
                *((name, 7) for name in ("x", "y", "z", "intensity")),
                ("ring", 4),
                ("time", 7),
            ]
            assert cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec == stamp - 10**8
            assert cloud.header.frame_id in ("bosch_b2", "velodyne")


def test_tf_static_has_the_mounting(source: SimulatedSource, sensor: str) -> None:
    np.testing.assert_allclose(source.T_base_sensor, make_sensor(sensor).T_base_sensor, atol=1e-9)


def test_imar_odometry_is_the_truth_within_centimetres(cache: Path) -> None:
    source = make_source(cache)
    truth = source.reference()
    stamps, positions = [], []
    with AnyReader([source.folder / "campaign.bag"]) as bag:
        odometry = [c for c in bag.connections if c.topic == "/imar/odom"]
        for connection, _, raw in bag.messages(odometry):
            message = bag.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            stamps.append(stamp.sec * 10**9 + stamp.nanosec)
            p = message.pose.pose.position
            positions.append((p.x, p.y, p.z))
            assert message.pose.covariance.reshape(6, 6)[0, 0] == pytest.approx(1e-4)
            assert message.twist.twist.linear.x == pytest.approx(10, rel=0.2)
    errors = np.array(positions) - truth.at(np.array(stamps))[:, :3, 3]
    assert 0.001 < np.abs(errors).max() < 0.08


def test_surface_points_lie_on_the_world_and_cover_what_is_seen(
    source: SimulatedSource, sensor: str, world: o3d.t.geometry.RaycastingScene
) -> None:
    cloud = o3d.t.io.read_point_cloud(str(source.surface_path))
    points = cloud.point.positions.numpy()
    normals = cloud.point.normals.numpy()
    some = points[:: max(len(points) // 20_000, 1)]
    assert world.compute_distance(o3d.core.Tensor(some)).numpy().max() < 5e-3
    np.testing.assert_allclose(np.linalg.norm(normals[::50], axis=1), 1, atol=1e-5)
    scan = list(source)[8]
    static = read_labels(source.folder, sensor).of_sweep(8) == Label.STATIC
    near = static & (np.linalg.norm(scan.points, axis=1) < 100)
    poses = sensor_poses(source, scan)[near]
    seen = np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points[near]) + poses[:, :3, 3]
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points))
    tree.knn_index()
    _, squared = tree.knn_search(o3d.core.Tensor(seen[::7].astype(np.float32)), 1)
    assert np.quantile(np.sqrt(squared.numpy()), 0.98) < 0.3


def test_missing_labels_are_named(cache: Path) -> None:
    with pytest.raises(SourceError, match="vls128"):
        read_labels(make_source(cache).folder, "vls128")


def test_a_topic_without_a_sensor_is_refused_before_recording(tmp_path: Path) -> None:
    settings = {**SETTINGS, "rig": ["bosch"]}
    with pytest.raises(ConfigError, match="/rbldar/pointcloud"):
        SimulatedSource(topic="/velodyne/pointcloud", cache_dir=str(tmp_path), **settings)
    assert not list(tmp_path.iterdir())


def tiny(**changes: Any) -> Campaign:
    route = {"distance": 3.0, "route": [{"straight": 3.0}]}
    steps = {"azimuth_steps": {"bosch": 8.0, "velodyne": 8.0}}
    return make_campaign(**{**SETTINGS, **route, **steps, **changes})


def test_the_same_config_gives_the_same_bytes(tmp_path: Path) -> None:
    one, two = (ensure_recorded(tiny(), tmp_path / name) for name in ("one", "two"))
    other = ensure_recorded(tiny(seed=1), tmp_path / "one")
    names = sorted(path.name for path in one.iterdir())
    assert names == sorted(path.name for path in two.iterdir())
    for name in set(names):
        assert (one / name).read_bytes() == (two / name).read_bytes(), name
    assert (one / "campaign.bag").read_bytes() != (other / "campaign.bag").read_bytes()


def test_an_interrupted_recording_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(campaign: Campaign, folder: Path) -> None:
        (folder / "campaign.bag").write_bytes(b"#ROSBAG")
        raise KeyboardInterrupt

    monkeypatch.setattr(source_module, "record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ensure_recorded(tiny(), tmp_path)
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def test_a_full_disk_is_said_to_be_where_the_recording_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(campaign: Campaign, folder: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(source_module, "record", full)
    with pytest.raises(OSError, match=f"No space left on device: '{tmp_path}/test-"):
        ensure_recorded(tiny(), tmp_path)
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def test_what_a_killed_recording_left_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = tiny()
    left = tmp_path / f".{campaign.name}-{campaign.digest()}-abc"
    left.mkdir(parents=True)
    (left / "campaign.bag").write_bytes(b"#ROSBAG")
    monkeypatch.setattr(source_module, "record", lambda campaign, folder: None)
    folder = ensure_recorded(campaign, tmp_path)
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == [folder]


def test_only_one_of_several_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def slow(campaign: Campaign, folder: Path) -> None:
        calls.append(folder)
        record(campaign, folder)

    monkeypatch.setattr(source_module, "record", slow)
    with ThreadPoolExecutor(4) as pool:
        folders = list(pool.map(lambda _: ensure_recorded(tiny(), tmp_path), range(4)))
    assert len(calls) == 1
    assert len(set(folders)) == 1


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def lose_a_chunk(bag: Path) -> None:
    """Replace a bag by a whole one that holds fewer sweeps, as a tool that repairs bags does."""
    with Reader(bag) as reader, Writer(bag.with_suffix(".new")) as writer:
        topics = {c.topic: c for c in reader.connections}
        for topic, c in topics.items():
            added = writer.add_connection(topic, c.msgtype, typestore=TYPESTORE)
            for _, stamp, data in list(reader.messages([c]))[:-1]:
                writer.write(added, stamp, data)
    bag.with_suffix(".new").replace(bag)


def forget_sizes(path: Path) -> None:
    """Make campaign.json one of those from before it had sizes."""
    description = json.loads(path.read_text())
    del description["sizes"]
    path.write_text(json.dumps(description))


@pytest.mark.parametrize(
    ("name", "harm", "what"),
    [
        ("campaign.bag", cut, r"campaign.bag has \d+ bytes of \d+"),
        ("truth.tum", cut, r"truth.tum has \d+ bytes of \d+"),
        ("surface.ply", Path.unlink, r"surface.ply"),
        ("campaign.json", cut, "campaign.json can't be read"),
        ("campaign.json", Path.unlink, r"campaign.json"),
    ],
)
def test_a_damaged_recording_is_recorded_again(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    name: str,
    harm: Callable[[Path], None],
    what: str,
) -> None:
    folder = ensure_recorded(tiny(), tmp_path)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    harm(folder / name)
    assert ensure_recorded(tiny(), tmp_path) == folder
    assert re.search(f"{folder} is damaged .*{what}.*recording it again", caplog.text)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 1


@pytest.mark.parametrize("harm", [None, cut, lose_a_chunk])
def test_a_recording_from_before_there_were_sizes_is_checked_by_its_sweeps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, harm: Callable[[Path], None] | None
) -> None:
    folder = ensure_recorded(tiny(), tmp_path)
    forget_sizes(folder / "campaign.json")
    again: list[Path] = []
    monkeypatch.setattr(source_module, "record", lambda campaign, folder: again.append(folder))
    if harm:
        harm(folder / "campaign.bag")
    ensure_recorded(tiny(), tmp_path)
    assert bool(again) == bool(harm)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["highway", "ramp"])
def test_other_worlds_record_as_well(tmp_path: Path, kind: str) -> None:
    source = make_source(tmp_path, "bosch", kind=kind, azimuth_steps={"bosch": 4.0})
    labels = read_labels(source.folder, "bosch")
    counts = [len(scan.points) for scan in source]
    assert min(counts) > 0.3 * 30 * 64
    assert counts == np.diff(labels.starts).tolist()


@pytest.mark.parametrize(("speed", "sweeps"), [(1.0, 30), (2.05, 15), (2.15, 14)])
def test_truth_covers_the_whole_distance_and_every_sweep(
    tmp_path: Path, speed: float, sweeps: int
) -> None:
    campaign = tiny(speed=speed)
    folder = ensure_recorded(campaign, tmp_path)
    truth = read_tum(folder / "truth.tum")
    assert len(read_labels(folder, "bosch").stamps) == sweeps
    assert truth.stamps[-1] >= START_STAMP + sweeps * 10**8
    assert truth.length == pytest.approx(campaign.distance, abs=0.055 * speed)
