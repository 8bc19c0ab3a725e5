"""Walk through a ROS 1 bag (format 2.0) record by record, without its index.

A bag is a list of records, each ``length, header, length, data`` with little-endian 32-bit lengths;
a header is a list of ``length, name=value``. Chunks hold, compressed, the records of connections
and messages. A bag cut short lacks the index at its end, but its chunks up to the cut are there.
"""

import logging
import struct
from collections.abc import Iterator
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import BinaryIO

from rosbags.typesys.msg import normalize_msgtype

from formats.bags import ROS1_MAGIC
from formats.bounded import Inflater
from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.sources.channel import ROS1, Channel

_log = logging.getLogger(__name__)

MAGIC = ROS1_MAGIC

_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_uint32 = struct.Struct("<I")
_time = struct.Struct("<II")


def walk(path: Path) -> Iterator[tuple[Channel, int, bytes]]:
    """Yield channel, receive time in ns and raw message, as far as records are whole.

    Of a chunk that is cut, the messages before the cut come out too; a chunk that doesn't
    decompress is left out with a warning.
    """
    channels: dict[int, Channel] = {}
    inflater = Inflater(path.stat().st_size)
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        for header, data in _records(file):
            if header["op"][0] == _CHUNK:
                inner = BytesIO(_inflated(header, data, path, inflater))
                for inner_header, inner_data in _records(inner):
                    yield from _message(inner_header, inner_data, channels)
            else:
                yield from _message(header, data, channels)


def _records(stream: BinaryIO) -> Iterator[tuple[dict[str, bytes], bytes]]:
    """Yield headers and data; a chunk may come with less data than it had."""
    start = stream.tell()
    size = stream.seek(0, SEEK_END)
    stream.seek(start)
    while True:
        try:
            header = _fields(_exactly(stream, min(_length(stream), size)))
            length = _length(stream)
            data = stream.read(min(length, size))  # no allocation by a damaged length
        except EOFError:
            return
        if len(header.get("op", b"")) != 1 or (len(data) < length and header["op"][0] != _CHUNK):
            return
        yield header, data


def _message(
    header: dict[str, bytes], data: bytes, channels: dict[int, Channel]
) -> Iterator[tuple[Channel, int, bytes]]:
    """Note a connection, or yield a message; other records are of no use here."""
    operation = header["op"][0]
    if operation not in (_CONNECTION, _MESSAGE) or len(header.get("conn", b"")) != 4:
        return
    number = _uint32.unpack(header["conn"])[0]
    if operation == _CONNECTION:
        try:
            about = _fields(data)
        except EOFError:
            return
        channels[number] = Channel(
            topic="/" + "/".join(p for p in _text(header, "topic").split("/") if p),
            msgtype=str(normalize_msgtype(_text(about, "type"))),
            definition=_text(about, "message_definition"),
            encoding=ROS1,
        )
    elif number in channels and len(header.get("time", b"")) == 8:
        seconds, nanoseconds = _time.unpack(header["time"])
        yield channels[number], seconds * NANOSECONDS + nanoseconds, data


def _inflated(header: dict[str, bytes], data: bytes, path: Path, inflater: Inflater) -> bytes:
    """Decompress a chunk as far as its bytes go; nothing of it where it is corrupt."""
    try:
        (size,) = _uint32.unpack(header.get("size", b""))
        return inflater(data, _text(header, "compression"), size)
    except (ValueError, struct.error) as error:
        _log.warning("%s: a corrupt chunk of %d bytes left out: %s", path, len(data), error)
        return b""


def _fields(header: bytes) -> dict[str, bytes]:
    fields, position = {}, 0
    while position + 4 <= len(header):
        end = position + 4 + _uint32.unpack_from(header, position)[0]
        name, equals, value = header[position + 4 : end].partition(b"=")
        if not equals or end > len(header):
            raise EOFError
        fields[name.decode(errors="replace")] = value
        position = end
    return fields


def _text(fields: dict[str, bytes], name: str) -> str:
    return fields.get(name, b"").decode(errors="replace")


def _length(stream: BinaryIO) -> int:
    return int(_uint32.unpack(_exactly(stream, 4))[0])


def _exactly(stream: BinaryIO, length: int) -> bytes:
    data = stream.read(length)
    if len(data) < length:
        raise EOFError
    return data
