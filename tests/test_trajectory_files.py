"""Trajectories from files of every kind, good and bad."""

import logging

import numpy as np
import pytest
from eval_support import winding
from evo.tools import file_interface
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from eval.errors import FileError
from eval.trajectory_files import read_euroc, read_kitti, read_trajectory, read_tum

TUM = "1.5 1 2 3 0 0 0 1\n2.5 4 5 6 0.6 0 0 0.8\n"
EUROC = "1500000000,1,2,3,1,0,0,0\n2500000000,4,5,6,0.8,0.6,0,0\n"
KITTI = "1 0 0 1 0 1 0 2 0 0 1 3\n1 0 0 4 0 0 -1 5 0 1 0 6\n"


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def same(a, b, stamps=True):
    np.testing.assert_allclose(a.positions_xyz, b.positions_xyz, atol=1e-12)
    turned = [Rotation.from_quat(t.orientations_quat_wxyz, scalar_first=True) for t in (a, b)]
    assert (turned[0].inv() * turned[1]).magnitude().max() < 1e-7
    if stamps:
        np.testing.assert_allclose(a.timestamps, b.timestamps, rtol=0, atol=1e-6)
    return True


# text


def test_text_files_are_read_as_evo_reads_them(tmp_path):
    path = winding(50)
    file_interface.write_tum_trajectory_file(str(tmp_path / "a"), path)
    file_interface.write_kitti_poses_file(str(tmp_path / "b"), path)
    rows = np.column_stack(
        [path.timestamps * 1e9 + 1.4e18, path.positions_xyz, path.orientations_quat_wxyz]
    )
    np.savetxt(
        tmp_path / "c", np.column_stack([rows, rows]), fmt=["%d"] + ["%.18e"] * 15, delimiter=","
    )
    for name, read, evos in (
        ("a", read_tum, file_interface.read_tum_trajectory_file),
        ("c", read_euroc, file_interface.read_euroc_csv_trajectory),
    ):
        expected = evos(str(tmp_path / name))
        assert same(read(tmp_path / name), expected)
        assert same(read_trajectory(tmp_path / name), expected)
    expected = file_interface.read_kitti_poses_file(str(tmp_path / "b"))
    assert same(read_kitti(tmp_path / "b"), expected, stamps=False)
    assert same(read_trajectory(tmp_path / "b"), expected, stamps=False)


@pytest.mark.parametrize("content", [TUM, EUROC, KITTI], ids=["tum", "euroc", "kitti"])
@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text,
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: "# stamp x y z\n\n" + text.replace("\n", "\n# more\n"),
        lambda text: "\n\n" + text.rstrip(),
        lambda text: "timestamp,tx ty tz,qx\n" + text,
        lambda text: "\ufeff#timestamp [ns], p_RS_R_x [m]\r\n" + text.replace("\n", "\r\n\r\n"),
        lambda text: text.replace(",", ", ").replace(" ", " \t"),
    ],
    ids=["plain", "bom", "crlf", "comments", "blank lines", "heading", "euroc's heading", "blanks"],
)
def test_how_the_text_is_laid_out_does_not_matter(tmp_path, content, spoil):
    path = read_trajectory(write(tmp_path / "any.name", spoil(content)))
    np.testing.assert_array_equal(path.positions_xyz, [[1, 2, 3], [4, 5, 6]])
    quarter = 2 * np.arctan2(0.6, 0.8) if content != KITTI else np.pi / 2
    turns = Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True).as_rotvec()
    np.testing.assert_allclose(turns, [[0, 0, 0], [quarter, 0, 0]], atol=1e-12)
    if content != KITTI:
        np.testing.assert_allclose(path.timestamps, [1.5, 2.5])


def test_a_path_is_named_by_its_file(tmp_path):
    path = write(tmp_path / "a.tum", TUM)
    assert read_trajectory(path).name == str(path)


def test_one_pose_is_a_trajectory(tmp_path):
    assert read_trajectory(write(tmp_path / "a.tum", "1 0 0 0 0 0 0 1")).num_poses == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "holds no numbers"),
        ("# stamp x y z\n\n", "holds no numbers"),
        ("stamp x y z qx qy qz qw\n", "holds no numbers"),
        (b"\x80\x81\x82\x83", "not text"),
        ("1 2 3\n", "3 columns; TUM has 8, KITTI 12, EuRoC at least 8"),
        ("1,2,3,4\n", "4 columns instead of 8"),
        (TUM + "3.5 1 2 3\n", "columns changed from 8 to 4"),
        (TUM + "3.5 1 2 3 0 0 zero 1\n", "zero"),
        ("x 0 0 0 0 0 0 1\n", "'x'"),
        (TUM + "3.5 nan 2 3 0 0 0 1\n", "1 of 3 rows hold NaN.*first row 3"),
        (KITTI.replace("6", "inf"), "1 of 2 rows hold NaN or infinity"),
        (EUROC.replace(",6,", ",nan,"), "NaN"),
        (TUM + "0.5 0 0 0 0 0 0 1\n", "run back after pose 2"),
        (EUROC + "1500000000,1,2,3,1,0,0,0\n", "run back after pose 2"),
        (TUM + "3.5 0 0 0 0 0 0 0\n", "quaternion of pose 3 has length 0"),
        (TUM + "3.5 0 0 0 1 1 1 1\n", "quaternion of pose 3 has length 2"),
        (KITTI.replace("-1", "1"), "pose 2 is not a rotation"),
        (KITTI.replace("-1", "-2"), "pose 2 is not a rotation"),
        (TUM.replace(" ", ","), "whole nanoseconds"),
    ],
)
def test_bad_files_are_named_with_what_is_wrong(tmp_path, content, message):
    path = write(tmp_path / "bad.txt", content)
    with pytest.raises(FileError, match=rf"bad\.txt.*{message}"):
        read_trajectory(path)


@pytest.mark.parametrize("read", [read_trajectory, read_tum, read_kitti, read_euroc])
def test_missing_files_are_named(tmp_path, read):
    with pytest.raises(FileError, match=r"no such .*trajectory: .*none\.tum"):
        read(tmp_path / "none.tum")


def test_a_file_of_another_kind_is_called_so(tmp_path):
    with pytest.raises(FileError, match="not a KITTI trajectory: 8 columns instead of 12"):
        read_kitti(write(tmp_path / "a.tum", TUM))
    with pytest.raises(FileError, match="not a TUM trajectory: 12 columns instead of 8"):
        read_tum(write(tmp_path / "a.txt", KITTI))


def test_repeated_stamps_and_rough_quaternions_are_counted(tmp_path, caplog):
    text = TUM + "2.5 0 0 0 0 0 0 1.02\n3.5 0 0 0 0 0 0 0.98\n"
    with caplog.at_level(logging.WARNING):
        path = read_trajectory(write(tmp_path / "a.tum", text))
    assert "2 quaternions are up to 2.0 %" in caplog.text
    assert "the stamp of the one before: 1" in caplog.text
    np.testing.assert_allclose(np.linalg.norm(path.orientations_quat_wxyz, axis=1), 1)


def test_four_digits_are_not_worth_a_word(tmp_path, caplog):
    path = winding(50)
    rows = np.column_stack(
        [path.timestamps, path.positions_xyz, np.roll(path.orientations_quat_wxyz, -1, axis=1)]
    )
    np.savetxt(tmp_path / "a.tum", rows, fmt="%.4f")
    read_trajectory(tmp_path / "a.tum")
    assert caplog.text == ""


# bags


class Messages:
    """Makes the messages of one ROS version."""

    def __init__(self, ros1):
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)

    def make(self, kind, *fields):
        return self.store.types[kind](*fields)

    def header(self, stamp):
        nanoseconds = round(stamp * 1e9)
        time = self.make("builtin_interfaces/msg/Time", *divmod(nanoseconds, 10**9))
        fields = (0, time, "map") if self.ros1 else (time, "map")
        return self.make("std_msgs/msg/Header", *fields)

    def pose(self, p, q, kind="geometry_msgs/msg/Pose"):
        point = "Vector3" if kind.endswith("Transform") else "Point"
        return self.make(
            kind,
            self.make(f"geometry_msgs/msg/{point}", *p.tolist()),
            self.make("geometry_msgs/msg/Quaternion", *q.tolist()),
        )

    def message(self, kind, stamp, p, q):
        """A message of any kind that carries one pose."""
        name, covariance = kind.split("/")[-1], np.zeros(36)
        pose = self.pose(p, q)
        if name == "Pose":
            return pose
        if name == "PoseStamped":
            return self.make(kind, self.header(stamp), pose)
        if name == "TransformStamped":
            transform = self.pose(p, q, "geometry_msgs/msg/Transform")
            return self.make(kind, self.header(stamp), "base", transform)
        uncertain = self.make("geometry_msgs/msg/PoseWithCovariance", pose, covariance)
        if name == "PoseWithCovarianceStamped":
            return self.make(kind, self.header(stamp), uncertain)
        zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self.make("geometry_msgs/msg/Twist", zero, zero)
        uncertain_twist = self.make("geometry_msgs/msg/TwistWithCovariance", twist, covariance)
        return self.make(kind, self.header(stamp), "base", uncertain, uncertain_twist)


POSES = [
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
]


def rows_of(path):
    return [
        *zip(
            path.timestamps.tolist(),
            path.positions_xyz,
            np.roll(path.orientations_quat_wxyz, -1, axis=1),
            strict=True,
        )
    ]


def write_bag(target, topics, form="bag"):
    """Write (topic, kind, [(received, message), ...]) to a bag of a form: bag, mcap or db3."""
    messages = Messages(form == "bag")
    if form == "bag":
        writer = Writer1(target)
    else:
        plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(target, version=9, storage_plugin=plugin)
    with writer:
        for topic, kind, stamped in topics:
            connection = writer.add_connection(topic, kind, typestore=messages.store)
            for received, message in stamped:
                serialise = (
                    messages.store.serialize_ros1 if messages.ros1 else messages.store.serialize_cdr
                )
                writer.write(connection, round(received * 1e9), serialise(message, kind))
    return target


def poses(kind, path, form="bag", late=0.03):
    """Each pose of a path as a message, received a little later than its stamp."""
    messages = Messages(form == "bag")
    late = 0 if kind == POSES[0] else late
    return [(s + late, messages.message(kind, s, p, q)) for s, p, q in rows_of(path)]


@pytest.fixture
def path():
    path = winding(20)
    path.timestamps = path.timestamps + 1_600_000_000
    return path


@pytest.mark.parametrize("form", ["bag", "mcap", "db3"])
@pytest.mark.parametrize("kind", POSES)
def test_any_pose_topic_of_a_bag_is_read(tmp_path, path, kind, form):
    bag = write_bag(tmp_path / f"run.{form}", [("/pose", kind, poses(kind, path, form))], form)
    assert same(read_trajectory(bag), path)
    if bag.is_dir():
        (file,) = bag.glob(f"*.{form}")
        assert same(read_trajectory(file), path)


def test_of_a_topic_of_paths_the_last_counts(tmp_path, path):
    messages, kind = Messages(True), "nav_msgs/msg/Path"
    stamped = [m for _, m in poses("geometry_msgs/msg/PoseStamped", path)]
    grown = [
        (1.6e9 + n, messages.make(kind, messages.header(1.6e9 + n), stamped[:n])) for n in (5, 20)
    ]
    assert same(read_trajectory(write_bag(tmp_path / "run.bag", [("/path", kind, grown)])), path)


def test_one_of_several_topics_must_be_named(tmp_path, path):
    kind = "geometry_msgs/msg/Pose"
    other = winding(20, seed=3)
    other.timestamps = path.timestamps
    text = get_typestore(Stores.ROS1_NOETIC).types["std_msgs/msg/String"]("hello")
    topics = [
        ("/estimate", kind, poses(kind, path)),
        ("/odometry", kind, poses(kind, other)),
        ("/talk", "std_msgs/msg/String", [(1.6e9, text)]),
    ]
    bag = write_bag(tmp_path / "run.bag", topics)
    with pytest.raises(FileError, match=r"several topics with poses.*: /estimate, /odometry"):
        read_trajectory(bag)
    with pytest.raises(FileError, match=r"no topic /pose.*/talk \(std_msgs/msg/String\)"):
        read_trajectory(bag, "/pose")
    with pytest.raises(FileError, match="/talk carries std_msgs/msg/String"):
        read_trajectory(bag, "/talk")
    assert same(read_trajectory(bag, "/odometry"), other)
    only = write_bag(tmp_path / "talk.bag", topics[2:])
    with pytest.raises(FileError, match="no topic with poses; topics with poses: none"):
        read_trajectory(only)


def test_poses_of_a_bag_are_put_in_the_order_of_their_stamps(tmp_path, path, caplog):
    kind = "geometry_msgs/msg/PoseStamped"
    sent = poses(kind, path)
    order = [1, 0, *range(2, 20)]
    received = [(sent[i][0], sent[j][1]) for i, j in enumerate(order)]
    with caplog.at_level(logging.WARNING):
        assert same(
            read_trajectory(write_bag(tmp_path / "run.bag", [("/a", kind, received)])), path
        )
    assert "came after later ones: 1" in caplog.text


def test_no_number_in_a_bag_is_an_error(tmp_path, path):
    path.positions_xyz[3] = np.nan
    kind = "nav_msgs/msg/Odometry"
    bag = write_bag(tmp_path / "run.bag", [("/odom", kind, poses(kind, path))])
    with pytest.raises(FileError, match=r"run\.bag, topic /odom: 1 of 20 rows hold NaN"):
        read_trajectory(bag)


def test_damaged_bags_are_named(tmp_path, path):
    kind = "nav_msgs/msg/Odometry"
    bag = write_bag(tmp_path / "run.bag", [("/odom", kind, poses(kind, path))])
    cut = write(tmp_path / "cut.bag", bag.read_bytes()[:300])
    with pytest.raises(FileError, match=r"cut\.bag can't be read as a bag"):
        read_trajectory(cut)
    with pytest.raises(FileError, match="can't be read as a bag"):
        read_trajectory(tmp_path)  # a folder without a bag


# comma-separated

START = 1_700_000_000


def csv_of(path, heading, names, stamps, *, more=()):
    """Write a drive as CSV with columns of these names; return it as it should be read."""
    drive = winding(len(stamps), 1.0)
    xyzw = np.roll(drive.orientations_quat_wxyz, -1, axis=1)
    columns = {"t": stamps, **dict(zip("xyz", drive.positions_xyz.T, strict=True))}
    columns |= dict(zip(("qx", "qy", "qz", "qw"), xyzw.T, strict=True))
    columns |= {"n": range(len(stamps)), "v": np.full(len(stamps), 7.0), "s": ["map"] * len(stamps)}
    rows = zip(*([str(value) for value in columns[name]] for name in names), strict=True)
    write(path, "\n".join([*heading, *(",".join(row) for row in rows)]) + "\n")
    return drive


@pytest.mark.parametrize(
    ("heading", "names"),
    [
        ("num,t,x,y,z,qx,qy,qz,qw", "n t x y z qx qy qz qw"),
        ("timestamp,tx,ty,tz,qw,qx,qy,qz", "t x y z qw qx qy qz"),
        ("# time [s], q_x, q_y, q_z, q_w, p_x, p_y, p_z", "t qx qy qz qw x y z"),
        ("frame_id,Stamp(s),pos_x,pos_y,pos_z,vx,quat_w,quat_x,quat_y,quat_z",
         "s t x y z v qw qx qy qz"),
        ("%time,header.frame_id,pose.position.x,pose.position.y,pose.position.z,"
         "pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w,twist.linear.x",
         "t s x y z qx qy qz qw v"),
        ("#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [],"
         " q_RS_z [], v_RS_R_x [m s^-1], b_w_RS_S_x [rad s^-1]", "t x y z qw qx qy qz v v"),
    ],
    ids=["mcd", "w first", "orientation first", "text between", "ros", "euroc"],
)  # fmt: skip
@pytest.mark.parametrize("scale", [1.0, 1e3, 1e6, 1e9])
def test_columns_are_found_by_the_headings_names(tmp_path, heading, names, scale):
    stamps = START + np.arange(40) * 0.1 + 0.05
    if scale > 1:
        heading = heading.replace("[s]", "").replace("(s)", "")
        counts = [f"{stamp * scale:.0f}" for stamp in stamps]
    else:
        counts = [f"{stamp:.3f}" for stamp in stamps]
    drive = csv_of(tmp_path / "a.csv", [heading], names.split(), counts)
    drive.timestamps = stamps
    assert same(read_trajectory(tmp_path / "a.csv"), drive)


@pytest.mark.parametrize(
    ("heading", "scale"), [("timestamp [ns]", 1e9), ("t_ms", 1e3), ("time (us)", 1e6)]
)
def test_the_heading_says_the_unit(tmp_path, heading, scale):
    stamps = np.arange(40) * 1000.0  # of no plausible unit, or of several
    names = "x,y,z,qx,qy,qz,qw"
    drive = csv_of(tmp_path / "a.csv", [f"{heading},{names}"], ["t", *names.split(",")], stamps)
    drive.timestamps = stamps / scale
    assert same(read_trajectory(tmp_path / "a.csv"), drive)


ROW = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]


@pytest.mark.parametrize("first", [0, START])
@pytest.mark.parametrize("step", [1, 2, 10])
def test_whole_seconds_without_a_heading(tmp_path, first, step, caplog):
    stamps = first + step * np.arange(40)
    drive = csv_of(tmp_path / "a.csv", [], ROW, stamps)
    drive.timestamps = stamps.astype(float)
    assert same(read_trajectory(tmp_path / "a.csv"), drive)
    assert "taken for seconds" in caplog.text


@pytest.mark.parametrize("first", [0, 1_403_636_579_758_555_392])
@pytest.mark.parametrize("interval", [1_000_000, 5_000_000, 100_000_000, 1_000_000_000])
def test_whole_nanoseconds_stay_so(tmp_path, first, interval, caplog):
    stamps = first + interval * np.arange(40)
    drive = csv_of(tmp_path / "a.csv", [], [*ROW[:4], "qw", *ROW[4:7]], stamps)
    drive.timestamps = stamps / 1e9
    assert same(read_trajectory(tmp_path / "a.csv"), drive)
    assert caplog.text == ""
