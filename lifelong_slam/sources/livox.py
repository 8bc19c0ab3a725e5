"""Livox CustomMsg, decoded straight from its bytes: an object a point would take 50 ms a message.

Layout, the same in all of Livox's driver packages: header, uint64 timebase, uint32 point_num,
uint8 lidar_id, uint8[3] rsvd, then a counted list of points: uint32 offset_time (ns from the
header's stamp), float32 x, y, z, uint8 reflectivity, tag, line. CDR pads each point to 4 bytes,
ROS 1 doesn't.
"""

import struct

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.sources.headers import CDR_PREFIX, byte_order, read_header
from lifelong_slam.sources.pointcloud2 import Cloud

LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
LIVOX_TYPES = tuple(f"{package}/msg/CustomMsg" for package in LIVOX_PACKAGES)

_POINT_BYTES = 19
_FIXED_BYTES = 16  # timebase, point_num, lidar_id, rsvd


def decode_livox(raw: bytes, ros1: bool) -> Cloud:
    """Return the cloud of a serialised message.

    Raises:
        ValueError: the message is cut short.
        struct.error: so is what comes before its points.
    """
    order, position = byte_order(raw, ros1), read_header(raw, ros1).end
    if not ros1:
        position += -(position - CDR_PREFIX) % 8
    (count,) = struct.unpack_from(f"{order}I", raw, position + _FIXED_BYTES)
    position += _FIXED_BYTES + 4
    stride = _POINT_BYTES if ros1 else _POINT_BYTES + 1
    if count and position + (count - 1) * stride + _POINT_BYTES > len(raw):
        raise ValueError(f"{count} points in {len(raw) - position} bytes of data")
    kind = np.dtype([("t", f"{order}u4"), ("xyz", f"{order}f4", (3,)), ("rest", "u1", (3,))])
    points: NDArray[np.void] = np.ndarray((count,), kind, raw, position, (stride,))
    times = points["t"].astype(np.uint32)
    return Cloud(points["xyz"].astype(np.float64), {"offset_time": times})
