"""Message definitions for recordings that don't carry their own."""

import logging
from collections.abc import Iterable

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lifelong_slam.sources.channel import Channel
from lifelong_slam.sources.livox import LIVOX_PACKAGES

_log = logging.getLogger(__name__)

_LIVOX_POINT = """
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_LIVOX_CLOUD = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""


def default_typestore(ros1: bool) -> Typestore:
    """Return the definitions of a ROS distribution, and Livox's beside them."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for package in LIVOX_PACKAGES:
        store.register(get_types_from_msg(_LIVOX_POINT, f"{package}/msg/CustomPoint"))
        store.register(get_types_from_msg(_LIVOX_CLOUD, f"{package}/msg/CustomMsg"))
    return store


def merged_typestore(channels: Iterable[Channel]) -> Typestore:
    """Return the definitions that a recording's channels carry, over the default ones.

    A definition that can't be parsed is left to the default: damaged files have damaged texts.
    """
    channels = list(channels)
    types = dict(default_typestore(any(channel.ros1 for channel in channels)).fielddefs)
    for channel in channels:
        if channel.definition:
            try:
                types.update(_parsed(channel))
            except Exception as error:  # the parser's errors are of many kinds
                _log.warning("definition of %s can't be parsed: %s", channel.msgtype, error)
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _parsed(channel: Channel) -> Typesdict:
    if not channel.idl:
        return get_types_from_msg(channel.definition, channel.msgtype)
    types: Typesdict = {}
    for part in channel.definition.split("=" * 80 + "\n"):
        types.update(
            get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL:") else part)
        )
    return types
