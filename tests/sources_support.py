"""What the tests of the sources share: clouds as messages, bags written in all three formats."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
)
START = 1_700_000_000_000_000_000
PERIOD = 100_000_000
FORMATS = ("ros1", "ros1_bz2", "ros1_lz4", "db3", "mcap", "mcap_zstd")
CLOUD = "sensor_msgs/msg/PointCloud2"
_CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def store(ros1):
    return ROS1 if ros1 else ROS2


def header(stamp, ros1=False, frame="lidar"):
    types = store(ros1).types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    extra = {"seq": 0} if ros1 else {}
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **extra)


def cloud_message(
    columns,
    stamp=START,
    ros1=False,
    frame="lidar",
    big_endian=False,
    gaps=None,
    point_padding=0,
    row_padding=0,
    height=1,
):
    """Encode {name: array} as PointCloud2; `gaps` are bytes before each field."""
    order = ">" if big_endian else "<"
    gaps = gaps or [0] * len(columns)
    types, offset, fields, layout = store(ros1).types, 0, [], []
    for (name, values), gap in zip(columns.items(), gaps, strict=True):
        offset += gap
        kind = values.dtype.str[1:]
        fields.append(
            types["sensor_msgs/msg/PointField"](
                name=name, offset=offset, datatype=_CODES[kind], count=1
            )
        )
        layout.append((name, order + kind, offset))
        offset += values.dtype.itemsize
    step = offset + point_padding
    count = len(next(iter(columns.values())))
    width = count // height
    row_step = width * step + row_padding
    data = np.full(height * row_step, 0xAB, np.uint8)
    names, formats, offsets = zip(*layout, strict=True)
    dtype = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": max(step, 1)}
    )
    if count:
        view = np.ndarray((height, width), dtype, buffer=data.data, strides=(row_step, step))
        for name, values in columns.items():
            view[name] = values.reshape(height, width)
    return types[CLOUD](
        header=header(stamp, ros1, frame),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=big_endian,
        point_step=step,
        row_step=row_step,
        data=data,
        is_dense=True,
    )


def xyz(count=40, seed=0):
    values = np.random.default_rng(seed).normal(scale=10, size=(3, count)).astype(np.float32)
    return dict(zip("xyz", values, strict=True))


def sweep(index, count=40):
    """Columns of a sweep with Ouster-like times."""
    return xyz(count, index) | {"t": np.linspace(0, 99_000_000, count).astype(np.uint32)}


def pose_types(ros1):
    return store(ros1).types


def odometry(stamp, x, ros1=False, child="base_link"):
    types = pose_types(ros1)
    point, quaternion = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    vector = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    pose = types["geometry_msgs/msg/Pose"](
        position=point(x=x, y=0.0, z=0.0), orientation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    )
    zeros = np.zeros(36)
    return types["nav_msgs/msg/Odometry"](
        header=header(stamp, ros1, "map"),
        child_frame_id=child,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=zeros),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=vector, angular=vector),
            covariance=zeros,
        ),
    )


def static_transforms(links, ros1=False):
    """Build a TFMessage of (parent, child, (x, y, z), (qx, qy, qz, qw))."""
    types = pose_types(ros1)
    stamped = [
        types["geometry_msgs/msg/TransformStamped"](
            header=header(START, ros1, parent),
            child_frame_id=child,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](**dict(zip("xyz", p, strict=True))),
                rotation=types["geometry_msgs/msg/Quaternion"](**dict(zip("xyzw", q, strict=True))),
            ),
        )
        for parent, child, p, q in links
    ]
    return types["tf2_msgs/msg/TFMessage"](transforms=stamped)


def write_bag(folder: Path, kind: str, messages, name="bag", typestore=None) -> Path:
    """Write [(topic, type, receive time, message)] and return the path to open."""
    ros1 = kind.startswith("ros1")
    typestore = typestore or store(ros1)
    if ros1:
        path = folder / f"{name}.bag"
        writer = Writer1(path)
        if compression := kind.partition("_")[2]:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        path = folder / name
        plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if kind == "mcap_zstd":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, msgtype, receive_time, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=typestore)
            serialize = typestore.serialize_ros1 if ros1 else typestore.serialize_cdr
            writer.write(connections[topic], receive_time, bytes(serialize(message, msgtype)))
    return path


def sweeps(kind, count=12, points=40, topic="/lidar"):
    """Return messages of `count` sweeps for `write_bag`."""
    ros1 = kind.startswith("ros1")
    stamps = [START + i * PERIOD for i in range(count)]
    return [
        (topic, CLOUD, stamp, cloud_message(sweep(i, points), stamp, ros1))
        for i, stamp in enumerate(stamps)
    ]


def storage_file(path: Path) -> Path:
    """Return the file that holds a bag's messages."""
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")


def assert_same(scans, others):
    scans, others = list(scans), list(others)
    assert [s.stamp for s in scans] == [s.stamp for s in others]
    for a, b in zip(scans, others, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
        assert (a.offsets is None) == (b.offsets is None)
        if a.offsets is not None:
            np.testing.assert_array_equal(a.offsets, b.offsets)
