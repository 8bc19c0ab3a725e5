"""Poses and maps as ROS 1 bags (paper 000, section 3.3.2)."""

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from lifelong_slam.files import atomic_path
from lifelong_slam.geometry import to_quaternion
from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.trajectory import Trajectory

_log = logging.getLogger(__name__)

_POSE = "geometry_msgs/msg/Pose"
_CLOUD = "sensor_msgs/msg/PointCloud2"
_LATEST = 2**32 * NANOSECONDS  # a ROS 1 time has 32 bits of seconds


def write_pose_bag(path: Path, trajectories: Mapping[str, Trajectory]) -> None:
    """Write one geometry_msgs/Pose a stamp on each trajectory's topic, in order of time.

    A Pose has no header, so the message's receive time is the pose's stamp. Poses that a ROS time
    can't hold (before 1970 or after 2106) are left out with a warning.
    """
    store = get_typestore(Stores.ROS1_NOETIC)
    names = list(trajectories)
    topic = np.repeat(np.arange(len(names)), [len(trajectories[name]) for name in names])
    stamps = np.concatenate([t.stamps for t in trajectories.values()] or [np.zeros(0, np.int64)])
    rows = [row for t in trajectories.values() for row in _serialize_poses(t)]
    order = np.argsort(stamps, kind="stable")
    valid = order[(stamps[order] >= 0) & (stamps[order] < _LATEST)]
    if len(valid) < len(order):
        _log.warning("%s: %d poses have no valid ROS time", path.name, len(order) - len(valid))
    with atomic_path(path) as temporary, Writer(temporary) as bag:
        connections = [bag.add_connection(name, _POSE, typestore=store) for name in names]
        for index in valid.tolist():
            bag.write(connections[topic[index]], int(stamps[index]), rows[index])


def write_cloud_bag(
    path: Path, topic: str, frame: str, stamp: int, points: NDArray[np.float32]
) -> None:
    """Write (N, 3) points as a single sensor_msgs/PointCloud2 (float32 x y z) at `stamp`, in ns."""
    store = get_typestore(Stores.ROS1_NOETIC)
    stamp = min(max(stamp, 0), _LATEST - 1)
    with atomic_path(path) as temporary, Writer(temporary) as bag:
        connection: Connection = bag.add_connection(topic, _CLOUD, typestore=store)
        message = _cloud_message(store.types, frame, stamp, points)
        bag.write(connection, stamp, store.serialize_ros1(message, _CLOUD))


def _serialize_poses(trajectory: Trajectory) -> list[bytes]:
    """Return each pose as ROS 1 serialises it: position x y z, orientation x y z w, float64."""
    if len(trajectory) == 0:
        return []
    values = np.hstack([trajectory.positions, to_quaternion(trajectory.poses)])
    return [row.tobytes() for row in values.astype("<f8")]


def _cloud_message(
    types: Mapping[str, type], frame: str, stamp: int, points: NDArray[np.float32]
) -> object:
    header = types["std_msgs/msg/Header"](
        seq=0,
        stamp=types["builtin_interfaces/msg/Time"](*divmod(stamp, NANOSECONDS)),
        frame_id=frame,
    )
    field = types["sensor_msgs/msg/PointField"]
    data = np.ascontiguousarray(points, dtype="<f4")
    return types[_CLOUD](
        header=header,
        height=1,
        width=len(points),
        fields=[field(name, 4 * i, 7, 1) for i, name in enumerate("xyz")],  # 7: FLOAT32
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=data.view(np.uint8).reshape(-1),
        is_dense=True,
    )
