"""Reads trajectories: TUM, KITTI, EuRoC and CSV files, and topics of ROS 1 and ROS 2 bags and MCAP.

What a file is shows in its content, whatever its name. Trajectories are evo's types, named by their
path. Text is read by NumPy: evo's CSV readers take ten times as long.
"""

import logging
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from eval.csv_columns import UNITS, find_columns, guess_rate
from eval.errors import FileError
from eval.text_table import check_finite, first_row, heading_of, read_table
from formats.bags import check_chunks, open_bag

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_NANOSECONDS = 1e9
_BAGS = (b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\x00")
_TUM_COLUMNS = 8
_KITTI_COLUMNS = 12
_EUROC_COLUMNS = 8  # those of the pose; velocities and biases may follow
_ROUNDED = 1e-3  # four printed digits move the length of a quaternion by less
_WRONG = 0.1  # no rounding does that

# A Pose has no header: its stamp is the time at which it was recorded.
_STAMPLESS = "geometry_msgs/msg/Pose"
_PATH = "nav_msgs/msg/Path"
_POSE_OF: dict[str, Callable[[Any], Any]] = {
    _STAMPLESS: lambda message: message,
    "geometry_msgs/msg/PoseStamped": attrgetter("pose"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": attrgetter("pose.pose"),
    "geometry_msgs/msg/TransformStamped": attrgetter("transform"),
    "nav_msgs/msg/Odometry": attrgetter("pose.pose"),
}


def read_trajectory(path: Path, topic: str | None = None) -> PosePath3D:
    """Read a trajectory of any kind that this module knows.

    Args:
        path: a file, or the folder of a ROS 2 bag.
        topic: of a bag, as for `read_bag`; files have none.

    Returns:
        A `PoseTrajectory3D`, or a `PosePath3D` where the file has no stamps (KITTI).

    Raises:
        FileError: the file is missing, of another kind, or malformed.
    """
    if path.is_dir() or _starts_as_bag(path):
        return read_bag(path, topic)
    _, row = first_row(path, "trajectory")
    if "," in row:
        return read_euroc(path)
    columns = len(row.split())
    if columns == _TUM_COLUMNS:
        return read_tum(path)
    if columns == _KITTI_COLUMNS:
        return read_kitti(path)
    raise FileError(
        f"{path} is not a trajectory: its first row has {columns} columns; TUM has {_TUM_COLUMNS},"
        f" KITTI {_KITTI_COLUMNS}, EuRoC at least {_EUROC_COLUMNS} with commas"
    )


def read_tum(path: Path) -> PoseTrajectory3D:
    """Read a TUM trajectory, ``stamp[s] x y z qx qy qz qw`` a line.

    Raises:
        FileError: the file is missing or malformed, holds NaN, or its stamps run back.
    """
    return _ordered(path, read_table(path, "TUM trajectory", _TUM_COLUMNS), UNITS["s"])


def read_euroc(path: Path) -> PoseTrajectory3D:
    """Read a comma-separated trajectory by the names in its heading, or as EuRoC's ground truth.

    EuRoC has ``stamp[ns],x,y,z,qw,qx,qy,qz`` a line; more columns may follow. Whole stamps that come too
    close for nanoseconds are taken for seconds, and the rows for TUM's then, with qw last.

    Raises:
        FileError: the file is missing or malformed, holds NaN, or its stamps run back.
    """
    skip, _ = first_row(path, "EuRoC trajectory")
    if named := find_columns(heading_of(path, skip)):
        count = max(named.indices) + 1
        rows = read_table(path, "CSV trajectory", count, ",", named.indices)
        return _ordered(path, rows, named.rate or guess_rate(rows[:, 0]))
    rows = read_table(path, "EuRoC trajectory", _EUROC_COLUMNS, ",")
    if (rows[:, 0] % 1 != 0).any():
        raise FileError(
            f"{path} is not a EuRoC trajectory: its stamps are whole nanoseconds, and w leads its"
            " quaternions; TUM's seconds and quaternions are separated by spaces"
        )
    rate = guess_rate(rows[:, 0])
    if rate == UNITS["s"]:
        _log.warning(
            "%s: stamps taken for seconds, and quaternions for qx qy qz qw as in TUM", path
        )
    else:
        rows[:, 4:] = np.roll(rows[:, 4:], -1, axis=1)
    return _ordered(path, rows, rate)


def _ordered(path: Path, rows: Array, rate: int) -> PoseTrajectory3D:
    """Make a trajectory of ``stamp x y z qx qy qz qw`` rows; `rate` counts of a stamp are a second."""
    stamps = rows[:, 0] / rate
    _check_order(path, stamps)
    return _trajectory(str(path), stamps, rows[:, 1:4], rows[:, 4:])


def read_kitti(path: Path) -> PosePath3D:
    """Read a KITTI trajectory: the 12 numbers of a 3x4 pose a line, no stamps.

    Raises:
        FileError: the file is missing or malformed, holds NaN, or what is no rotation.
    """
    T = read_table(path, "KITTI trajectory", _KITTI_COLUMNS).reshape(-1, 3, 4)
    R = T[:, :, :3]
    skewed = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > _WRONG
    skewed |= np.linalg.det(R) < 0
    if skewed.any():
        raise FileError(
            f"{path}: pose {int(np.argmax(skewed)) + 1} is not a rotation and a position"
        )
    wxyz = Rotation.from_matrix(R).as_quat(scalar_first=True)
    return PosePath3D(T[:, :, 3], wxyz, name=str(path))


def read_bag(path: Path, topic: str | None = None) -> PoseTrajectory3D:
    """Read a topic of a ROS 1 bag, a ROS 2 bag (its folder or file) or an MCAP file.

    It may carry Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped or Pose, one pose
    a message, or Path, of which the last message counts. Poses are put in the order of their stamps.

    Args:
        path: the bag.
        topic: may be left out where only one topic carries poses.

    Raises:
        FileError: the bag is missing or damaged, has no such topic, or holds NaN.
    """
    _require(path)
    try:
        store = get_typestore(Stores.LATEST)  # for bags without definitions
        check_chunks(path)
        with open_bag([path], store) as reader:
            topic = _choose(path, reader, topic)
            rows = np.array(list(_rows(reader, topic)), dtype=np.float64)
    except FileError:
        raise
    except Exception as error:  # damaged files raise whatever the parser met first
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{path} can't be read as a bag: {reason}") from error
    where = f"{path}, topic {topic}"
    if len(rows) == 0:
        raise FileError(f"{where} holds no poses")
    late = int((np.diff(rows[:, 0]) < 0).sum())
    if late:
        _log.warning("%s: poses sorted by stamp, as some came after later ones: %d", where, late)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return _trajectory(where, rows[:, 0], rows[:, 1:4], rows[:, 4:])


def _choose(path: Path, reader: AnyReader, topic: str | None) -> str:
    """Return the topic to read."""
    kinds = {name: info.msgtype for name, info in reader.topics.items() if info.msgcount}
    usable = sorted(name for name, kind in kinds.items() if kind == _PATH or kind in _POSE_OF)
    if topic is None and len(usable) == 1:
        return str(usable[0])
    if topic in usable:
        return str(topic)
    listed = ", ".join(usable) or "none"
    if topic is None and usable:
        raise FileError(f"{path} has several topics with poses, name one: {listed}")
    if topic is not None and topic in kinds:
        raise FileError(
            f"{path}: {topic} carries {kinds[topic]}, no poses; topics with poses: {listed}"
        )
    asked = "no topic with poses" if topic is None else f"no topic {topic}"
    everything = ", ".join(f"{name} ({kind})" for name, kind in sorted(kinds.items())) or "none"
    raise FileError(f"{path} has {asked}; topics with poses: {listed}; all topics: {everything}")


def _rows(reader: AnyReader, topic: str) -> Iterator[tuple[float, ...]]:
    """Yield stamp[s] x y z qx qy qz qw of every pose of a topic."""
    path = None
    for connection, received, raw in reader.messages(
        [connection for connection in reader.connections if connection.topic == topic]
    ):
        kind = connection.msgtype
        if kind == _PATH:
            path = connection, raw
            continue
        message = reader.deserialize(raw, kind)
        stamp = received / _NANOSECONDS if kind == _STAMPLESS else _seconds(message)
        yield stamp, *_numbers(_POSE_OF[kind](message))
    if path is not None:
        last: Any = reader.deserialize(path[1], path[0].msgtype)
        yield from ((_seconds(stamped), *_numbers(stamped.pose)) for stamped in last.poses)


def _seconds(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec + stamp.nanosec / _NANOSECONDS)


def _numbers(pose: Any) -> tuple[float, ...]:
    """Return x y z qx qy qz qw of a Pose or a Transform."""
    if hasattr(pose, "translation"):
        p, q = pose.translation, pose.rotation
    else:
        p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def _require(path: Path) -> None:
    if not path.exists():
        raise FileError(f"no such trajectory: {path}")


def _starts_as_bag(path: Path) -> bool:
    _require(path)
    with path.open("rb") as file:
        return file.read(20).startswith(_BAGS)


def _check_order(path: Path, stamps: Array) -> None:
    back = np.diff(stamps) < 0
    if back.any():
        raise FileError(
            f"{path}: stamps run back after pose {int(np.argmax(back)) + 1}; poses must be in order"
            " of time"
        )


def _trajectory(where: str, stamps: Array, positions: Array, xyzw: Array) -> PoseTrajectory3D:
    """Check poses in order of time, and give their quaternions unit length."""
    check_finite(where, np.column_stack([stamps, positions, xyzw]))
    lengths = np.linalg.norm(xyzw, axis=1)
    off = np.abs(lengths - 1)
    if off.max() > _WRONG:
        worst = int(np.argmax(off > _WRONG))
        raise FileError(
            f"{where}: the quaternion of pose {worst + 1} has length {lengths[worst]:.3g} instead"
            " of 1"
        )
    if off.max() > _ROUNDED:
        _log.warning(
            "%s: %d quaternions are up to %.1f %% longer or shorter than 1; normalised",
            *(where, int((off > _ROUNDED).sum()), 100 * off.max()),
        )
    repeated = int((np.diff(stamps) == 0).sum())
    if repeated:
        _log.warning("%s: poses with the stamp of the one before: %d", where, repeated)
    wxyz = np.roll(xyzw / lengths[:, None], 1, axis=1)
    return PoseTrajectory3D(positions, wxyz, stamps, name=where)
