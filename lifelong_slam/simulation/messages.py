"""ROS 1 messages of a campaign: clouds, odometry and the sensors' mounting."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lifelong_slam.geometry import to_quaternion
from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.simulation.returns import Returns
from lifelong_slam.simulation.sensors import Sensor

Array = NDArray[np.float64]

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
TF_TYPE = "tf2_msgs/msg/TFMessage"
BASE_FRAME = "base_link"
WORLD_FRAME = "odom"

TYPESTORE = get_typestore(Stores.ROS1_NOETIC)
# Not among the types that rosbags knows of ROS 1.
TYPESTORE.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_TYPE))

POINT = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("ring", "<u2"),
        ("time", "<f4"),
    ]
)
_FIELD_CODES = {"f4": 7, "u2": 4}  # PointField's FLOAT32 and UINT16


def cloud_message(
    returns: Returns,
    sensor: Sensor,
    directions: NDArray[np.float32],
    offsets: NDArray[np.float32],
    stamp: int,
    sequence: int,
) -> bytes:
    """Serialise a sweep as sensor_msgs/PointCloud2.

    Args:
        returns: the points.
        sensor: whose frame they are in.
        directions: (C, R, 3) unit vectors of the beams in that frame.
        offsets: (C,) seconds after `stamp` of each column.
        stamp: of the sweep's start, nanoseconds.
        sequence: the header's count.
    """
    points = np.empty(len(returns.distance), dtype=POINT)
    xyz = directions[returns.column, returns.ring] * returns.distance[:, None]
    points["x"], points["y"], points["z"] = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    points["intensity"] = returns.intensity
    points["ring"] = sensor.rings[returns.ring]
    points["time"] = offsets[returns.column]
    message = _new(
        CLOUD_TYPE,
        header=_header(stamp, sensor.frame, sequence),
        height=1,
        width=len(points),
        fields=_fields(),
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=POINT.itemsize * len(points),
        data=points.view(np.uint8),
        is_dense=True,
    )
    return bytes(TYPESTORE.serialize_ros1(message, CLOUD_TYPE))


def odometry_message(
    T_world_base: Array, twist: Array, deviations: Array, stamp: int, sequence: int
) -> bytes:
    """Serialise a pose (4, 4) and a twist (6,), linear first, as nav_msgs/Odometry.

    Args:
        T_world_base: pose of the car.
        twist: m/s and rad/s in the base frame.
        deviations: (12,) standard deviations of pose and twist, in the message's order.
        stamp: nanoseconds.
        sequence: the header's count.
    """
    variance = np.asarray(deviations) ** 2
    message = _new(
        ODOMETRY_TYPE,
        header=_header(stamp, WORLD_FRAME, sequence),
        child_frame_id=BASE_FRAME,
        pose=_new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=_new(
                "geometry_msgs/msg/Pose",
                position=_new("geometry_msgs/msg/Point", **_xyz(T_world_base[:3, 3])),
                orientation=_quaternion(T_world_base),
            ),
            covariance=np.diag(variance[:6]).ravel(),
        ),
        twist=_new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=_new(
                "geometry_msgs/msg/Twist",
                linear=_new("geometry_msgs/msg/Vector3", **_xyz(twist[:3])),
                angular=_new("geometry_msgs/msg/Vector3", **_xyz(twist[3:])),
            ),
            covariance=np.diag(variance[6:]).ravel(),
        ),
    )
    return bytes(TYPESTORE.serialize_ros1(message, ODOMETRY_TYPE))


def mounting_message(sensors: Sequence[Sensor], stamp: int) -> bytes:
    """Serialise the sensors' poses on the car as tf2_msgs/TFMessage."""
    transforms = [
        _new(
            "geometry_msgs/msg/TransformStamped",
            header=_header(stamp, BASE_FRAME, 0),
            child_frame_id=sensor.frame,
            transform=_new(
                "geometry_msgs/msg/Transform",
                translation=_new("geometry_msgs/msg/Vector3", **_xyz(sensor.T_base_sensor[:3, 3])),
                rotation=_quaternion(sensor.T_base_sensor),
            ),
        )
        for sensor in sensors
    ]
    return bytes(TYPESTORE.serialize_ros1(_new(TF_TYPE, transforms=transforms), TF_TYPE))


def _new(kind: str, **values: Any) -> Any:
    return TYPESTORE.types[kind](**values)


def _header(stamp: int, frame: str, sequence: int) -> Any:
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    time = _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _new("std_msgs/msg/Header", seq=sequence, stamp=time, frame_id=frame)


def _fields() -> list[Any]:
    return [
        _new(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=POINT.fields[name][1],
            datatype=_FIELD_CODES[POINT[name].str[1:]],
            count=1,
        )
        for name in POINT.names or ()
        if POINT.fields is not None
    ]


def _xyz(vector: Array) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


def _quaternion(T: Array) -> Any:
    x, y, z, w = to_quaternion(T[None])[0].tolist()
    return _new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
