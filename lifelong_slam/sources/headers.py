"""The std_msgs/Header at the start of a serialised message, without decoding the rest."""

import struct
from dataclasses import dataclass

from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.sources.static_frames import bare

CDR_PREFIX = 4  # bytes before the content of a CDR message; they tell its byte order


@dataclass(frozen=True, slots=True)
class Header:
    """A header, and where it ends.

    Attributes:
        stamp: integer nanoseconds.
        frame: frame_id, without a leading slash.
        end: number of bytes from the start of the message to the end of the header.
    """

    stamp: int
    frame: str
    end: int


@dataclass(frozen=True, slots=True)
class Arrival:
    """A serialised message that begins with a header.

    Attributes:
        receive_time: when the recorder got it, integer nanoseconds.
        header: its header.
        raw: its bytes.
    """

    receive_time: int
    header: Header
    raw: bytes

    @property
    def body(self) -> bytes:
        """What follows the header."""
        return self.raw[self.header.end :]


def byte_order(raw: bytes, ros1: bool) -> str:
    """Return the byte order of a serialised message, as `struct` writes it."""
    return "<" if ros1 or raw[1] & 1 else ">"


def read_header(raw: bytes, ros1: bool) -> Header:
    """Read the header of a message of any type that begins with one.

    Raises:
        ValueError: the message ends within the header.
        struct.error: so it does.
        IndexError: it has less than two bytes.
    """
    start = 4 if ros1 else CDR_PREFIX  # ROS 1 headers start with a sequence number
    seconds, nanoseconds, count = struct.unpack_from(f"{byte_order(raw, ros1)}III", raw, start)
    end = start + 12 + count
    if end > len(raw):
        raise ValueError(f"a frame_id of {count} bytes in a message of {len(raw)}")
    frame = raw[start + 12 : end].rstrip(b"\0").decode(errors="replace")
    return Header(seconds * NANOSECONDS + nanoseconds, bare(frame), end)
