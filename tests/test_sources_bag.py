import logging

import numpy as np
import pytest
from sources_support import (
    CLOUD,
    FORMATS,
    PERIOD,
    ROS1,
    ROS2,
    START,
    assert_same,
    cloud_message,
    header,
    odometry,
    static_transforms,
    storage_file,
    sweep,
    sweeps,
    write_bag,
    xyz,
)

from lifelong_slam.errors import SourceError, TopicError
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.cleaning import UNREADABLE, InputCounts, clean
from lifelong_slam.sources.livox import decode_livox
from lifelong_slam.sources.recording import open_recording
from lifelong_slam.sources.typestores import default_typestore

ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
QUARTER_TURN = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
NO_TURN = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_comes_back(tmp_path, kind):
    source = BagSource(str(write_bag(tmp_path, kind, sweeps(kind))))
    assert source.topic == "/lidar"
    assert len(source) == 12
    scans = list(source)
    for i, scan in enumerate(scans):
        columns = sweep(i)
        assert scan.stamp == START + i * PERIOD
        np.testing.assert_array_equal(
            scan.points, np.column_stack([columns[n] for n in "xyz"]).astype(np.float64)
        )
        np.testing.assert_allclose(scan.offsets, columns["t"] / 1e9, atol=1e-12)
    assert_same(scans, source)  # and can be read again


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_single_storage_files_open_like_their_folder(tmp_path, kind):
    folder = write_bag(tmp_path, kind, sweeps(kind))
    assert_same(BagSource(str(folder)), BagSource(str(storage_file(folder))))
    (folder / "metadata.yaml").unlink()
    assert len(BagSource(str(folder))) == 12


def test_split_ros1_bag(tmp_path):
    messages = sweeps("ros1")
    write_bag(tmp_path, "ros1", messages[:5], "part_2")
    write_bag(tmp_path, "ros1", messages[5:], "part_10")
    assert [s.stamp for s in BagSource(str(tmp_path))] == [m[2] for m in messages]


def test_stamps_are_those_of_the_headers_to_the_nanosecond(tmp_path):
    stamp = START + 123_456_789
    message = cloud_message(xyz(), stamp)
    path = write_bag(tmp_path, "mcap", [("/lidar", CLOUD, stamp + 5 * 10**9, message)])
    assert next(iter(BagSource(str(path)))).stamp == stamp


def test_receive_times_stand_in_for_headers_without_stamps(tmp_path, caplog):
    messages = [("/lidar", CLOUD, START + i, cloud_message(xyz(), 0)) for i in range(3)]
    source = BagSource(str(write_bag(tmp_path, "db3", messages)))
    assert [scan.stamp for scan in source] == [START, START + 1, START + 2]
    assert "receive times used" in caplog.text


def test_simulated_time_may_start_at_zero(tmp_path):
    messages = [("/lidar", CLOUD, START + i, cloud_message(xyz(), i)) for i in range(3)]
    source = BagSource(str(write_bag(tmp_path, "db3", messages)))
    assert [scan.stamp for scan in source] == [0, 1, 2]


def test_topic_must_be_named_where_there_are_several(tmp_path):
    messages = sweeps("db3", 2) + sweeps("db3", 2, topic="/other")
    path = str(write_bag(tmp_path, "db3", messages))
    with pytest.raises(TopicError, match=r"2 point cloud topics.*/lidar.*/other"):
        BagSource(path)
    assert len(BagSource(path, "/other")) == 2


def mixed_bag(folder, kind):
    ros1 = kind.startswith("ros1")
    messages = sweeps(kind, 3)
    messages += [("/odom", ODOMETRY, START + i, odometry(START + i, 1.0, ros1)) for i in range(3)]
    return str(write_bag(folder, kind, messages))


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_absent_topic_lists_those_there_are(tmp_path, kind):
    with pytest.raises(TopicError) as caught:
        BagSource(mixed_bag(tmp_path, kind), "/lidr")
    message = str(caught.value)
    assert "no topic '/lidr'" in message
    assert "Did you mean '/lidar'?" in message
    assert f"/odom ({ODOMETRY}, 3 messages)" in message
    assert "\n" not in message


def test_wrong_type_is_named_with_the_right_topics(tmp_path):
    with pytest.raises(TopicError, match=r"'/odom' is of type nav_msgs.*/lidar"):
        BagSource(mixed_bag(tmp_path, "mcap"), "/odom")
    with pytest.raises(TopicError, match=r"'/lidar' is of type sensor_msgs.*/odom"):
        BagSource(mixed_bag(tmp_path, "ros1"), "/lidar", "/lidar")


def test_bag_without_clouds(tmp_path):
    messages = [("/odom", ODOMETRY, START, odometry(START, 1.0))]
    with pytest.raises(TopicError, match=r"no point cloud topic; its topics: /odom"):
        BagSource(str(write_bag(tmp_path, "db3", messages)))


def test_cloud_without_z(tmp_path):
    columns = xyz()
    del columns["z"]
    path = write_bag(tmp_path, "mcap", [("/lidar", CLOUD, START, cloud_message(columns))])
    with pytest.raises(SourceError, match=r"topic /lidar: a cloud without z.*x, y"):
        list(BagSource(str(path)))


def test_unreadable_messages_are_counted_and_left_out(tmp_path, caplog):
    messages = sweeps("db3", 6)
    for index in (0, 3):
        messages[index][3].width += 1000
    source = BagSource(str(write_bag(tmp_path, "db3", messages)))
    counts = InputCounts()
    assert len(list(clean(source, counts))) == 4
    assert counts.skipped == {UNREADABLE: 2}
    assert source.unreadable == 2
    assert "2 unreadable messages left out" in caplog.text


def test_no_readable_message_is_an_error(tmp_path):
    messages = sweeps("db3", 2)
    for message in messages:
        message[3].width += 1000
    with pytest.raises(SourceError, match="no message on /lidar could be decoded"):
        list(BagSource(str(write_bag(tmp_path, "db3", messages))))


def test_nan_points_and_repeated_stamps_come_through_to_cleaning(tmp_path):
    columns = sweep(0)
    columns["x"][:7] = np.nan
    stamps = [START, START + PERIOD, START + PERIOD, START]
    messages = [
        ("/lidar", CLOUD, START + i, cloud_message(columns, stamp))
        for i, stamp in enumerate(stamps)
    ]
    counts = InputCounts()
    scans = list(clean(BagSource(str(write_bag(tmp_path, "mcap", messages))), counts))
    assert len(scans) == 2
    assert len(scans[0].points) == len(scans[0].offsets) == 33
    assert sum(counts.skipped.values()) == 2


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_reference_is_sorted_and_distinct(tmp_path, kind, caplog):
    ros1 = kind == "ros1"
    times = [2, 0, 1, 1, 3]
    messages = sweeps(kind, 2)
    messages += [
        ("/odom", ODOMETRY, START + i, odometry(START + PERIOD * t, float(t), ros1))
        for i, t in enumerate(times)
    ]
    reference = BagSource(str(write_bag(tmp_path, kind, messages)), None, "/odom").reference()
    assert reference.stamps.tolist() == [START + PERIOD * t for t in range(4)]
    np.testing.assert_allclose(reference.positions[:, 0], range(4))
    assert "1 poses with a stamp seen before" in caplog.text


def test_reference_leaves_out_impossible_poses(tmp_path, caplog):
    bad = odometry(START, 0.0)
    bad.pose.pose.orientation.w = 0.0
    messages = [*sweeps("db3", 2), ("/odom", ODOMETRY, START, bad)]
    messages.append(("/odom", ODOMETRY, START + 1, odometry(START + 1, 1.0)))
    reference = BagSource(str(write_bag(tmp_path, "db3", messages)), None, "/odom").reference()
    assert len(reference) == 1
    assert "1 messages without a usable pose" in caplog.text


def test_no_reference_unless_named(tmp_path):
    assert BagSource(mixed_bag(tmp_path, "db3")).reference() is None


@pytest.mark.parametrize(
    "msgtype",
    [
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
    ],
)
def test_reference_types(tmp_path, msgtype):
    types = ROS2.types
    pose = odometry(START, 7.0).pose
    if msgtype.endswith("TransformStamped"):
        transform = static_transforms([("map", "base_link", (7.0, 0.0, 0.0), NO_TURN)])
        message = transform.transforms[0]
    elif msgtype.endswith("CovarianceStamped"):
        message = types[msgtype](header=header(START), pose=pose)
    else:
        message = types[msgtype](header=header(START), pose=pose.pose)
    path = write_bag(tmp_path, "mcap", [*sweeps("mcap", 1), ("/pose", msgtype, START, message)])
    reference = BagSource(str(path), None, "/pose").reference()
    np.testing.assert_allclose(reference.positions, [[7.0, 0.0, 0.0]])


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_sensor_pose_by_a_chain_of_static_transforms(tmp_path, kind):
    ros1 = kind == "ros1"
    links = [
        ("mast", "/lidar", (0.0, 0.0, 1.0), NO_TURN),
        ("base_link", "mast", (2.0, 0.0, 0.0), QUARTER_TURN),
        ("base_link", "imu", (0.0, 5.0, 0.0), NO_TURN),
    ]
    messages = [("/tf_static", TF, START, static_transforms(links, ros1)), *sweeps(kind, 2)]
    messages.append(("/odom", ODOMETRY, START, odometry(START, 1.0, ros1, "imu")))
    source = BagSource(str(write_bag(tmp_path, kind, messages)), None, "/odom")
    expected = np.array([[0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
    np.testing.assert_allclose(source.T_base_sensor, expected, atol=1e-12)
    np.testing.assert_allclose(source.reference().positions, [[1.0, -5.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("links", [[], [("a", "lidar", (1.0, 0.0, 0.0), NO_TURN)]])
def test_identity_where_nothing_leads_to_a_base(tmp_path, links, caplog):
    caplog.set_level(logging.INFO)
    messages = [("/tf_static", TF, START, static_transforms(links)), *sweeps("db3", 1)]
    source = BagSource(str(write_bag(tmp_path, "db3", messages)))
    np.testing.assert_array_equal(source.T_base_sensor, np.eye(4))
    assert "taken as base" in caplog.text


def test_static_transforms_in_a_circle(tmp_path):
    links = [("a", "lidar", (1.0, 0, 0), NO_TURN), ("lidar", "a", (1.0, 0, 0), NO_TURN)]
    messages = [("/tf_static", TF, START, static_transforms(links)), *sweeps("db3", 1)]
    source = BagSource(str(write_bag(tmp_path, "db3", messages)))
    np.testing.assert_array_equal(source.T_base_sensor, np.eye(4))


@pytest.mark.parametrize("frame", ["", "livox", "livox_frame"])
@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_livox_messages(tmp_path, kind, frame):
    ros1 = kind == "ros1"
    store = default_typestore(ros1)
    name = "livox_ros_driver2/msg/CustomMsg"
    point = store.types["livox_ros_driver2/msg/CustomPoint"]
    points = [
        point(offset_time=i * 1_000_000, x=float(i), y=1.0, z=2.0, reflectivity=9, tag=0, line=1)
        for i in range(100)
    ]
    message = store.types[name](
        header=header(START, ros1, frame),
        timebase=0,
        point_num=100,
        lidar_id=0,
        rsvd=np.zeros(3, np.uint8),
        points=points,
    )
    path = write_bag(tmp_path, kind, [("/livox", name, START, message)], typestore=store)
    raw = next(open_recording(path).messages("/livox"))[1]
    with pytest.raises(ValueError, match="points in"):
        decode_livox(raw[:-1], ros1)
    (scan,) = list(BagSource(str(path)))
    assert scan.stamp == START
    np.testing.assert_array_equal(scan.points, [[i, 1.0, 2.0] for i in range(100)])
    np.testing.assert_allclose(scan.offsets, np.arange(100) / 1000)


def test_without_times_the_log_says_so(tmp_path, caplog):
    path = write_bag(tmp_path, "db3", [("/lidar", CLOUD, START, cloud_message(xyz()))])
    assert next(iter(BagSource(str(path)))).offsets is None
    assert len([r for r in caplog.records if "can't be deskewed" in r.message]) == 1


def test_stores_are_what_the_writers_use():
    assert CLOUD in ROS1.fielddefs
    assert CLOUD in ROS2.fielddefs


def test_a_wrong_byte_order_is_said_once(tmp_path, caplog):
    messages = sweeps("db3")
    for *_, message in messages:
        message.is_bigendian = True
    scans = list(BagSource(str(write_bag(tmp_path, "db3", messages))))
    assert_same(scans, BagSource(str(write_bag(tmp_path, "db3", sweeps("db3"), "right"))))
    assert len([r for r in caplog.records if "byte order" in r.message]) == 1
