"""rosbags' reader of bags, kept from unpacking more than a file can hold.

It decompresses chunks, messages and whole files without a limit. Here each of them gets one, and what
all chunks of a file claim together is checked before anything is unpacked.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import reader as rosbag2_reader
from rosbags.rosbag2 import storage_mcap
from rosbags.typesys.store import Typestore

from formats.bounded import check_plausible, inflate, most_plain

ROS1_MAGIC = b"#ROSBAG V2.0\n"
MCAP_MAGIC = b"\x89MCAP0\r\n"

_ROS1_CHUNK = b"\x05"
_MCAP_CHUNK = 6
_uint32 = struct.Struct("<I")
_record = struct.Struct("<BQ")  # of MCAP: kind, length
_chunk = struct.Struct(
    "<QQQII"
)  # of MCAP: first and last time, plain size, checksum, length of a name


def open_bag(paths: Sequence[Path], typestore: Typestore) -> AnyReader:
    """Return rosbags' reader of one bag; as a context manager it opens the files.

    Args:
        paths: a file, a ROS 2 folder, or the parts of a split ROS 1 bag.
        typestore: definitions for bags without their own.
    """
    return AnyReader(paths, default_typestore=typestore)


def check_chunks(path: Path) -> None:
    """Check the sizes that the chunks of a bag claim, a file or a folder; not all kinds have some.

    Raises:
        ValueError: one of them, or all of a file together, can't hold as much.
    """
    for file in path.iterdir() if path.is_dir() else (path,):
        total = 0
        for packed, plain in _chunks(file):
            check_plausible(plain, packed)
            total += plain
        check_plausible(total, file.stat().st_size)


def _chunks(path: Path) -> Iterator[tuple[int, int]]:
    """Yield compressed and plain size of each compressed chunk, up to where a file is damaged."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        magic = file.read(len(ROS1_MAGIC))
        if magic == ROS1_MAGIC:
            yield from _ros1_chunks(file)
        elif magic.startswith(MCAP_MAGIC):
            file.seek(len(MCAP_MAGIC))
            yield from _mcap_chunks(file)


def _ros1_chunks(file: BinaryIO) -> Iterator[tuple[int, int]]:
    while len(length := file.read(4)) == 4:
        fields = _ros1_fields(file.read(min(_uint32.unpack(length)[0], 1 << 16)))
        if len(length := file.read(4)) < 4:
            return
        size = _uint32.unpack(length)[0]
        if fields.get(b"op") == _ROS1_CHUNK and fields.get(b"compression") != b"none":
            yield size, _uint32.unpack(fields.get(b"size", b"")[:4].ljust(4, b"\0"))[0]
        file.seek(size, 1)


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, position = {}, 0
    while position + 4 <= len(header):
        end = position + 4 + _uint32.unpack_from(header, position)[0]
        name, _, value = header[position + 4 : end].partition(b"=")
        fields[name] = value
        position = end
    return fields


def _mcap_chunks(file: BinaryIO) -> Iterator[tuple[int, int]]:
    while len(head := file.read(_record.size)) == _record.size:
        kind, length = _record.unpack(head)
        after = file.tell() + length
        if kind == _MCAP_CHUNK and len(head := file.read(_chunk.size)) == _chunk.size:
            *_, plain, _, name = _chunk.unpack(head)
            if name:  # of the compression
                yield length, plain
        if after > (1 << 62):
            return
        file.seek(after)


class _BoundedZstd:
    """What rosbags uses of the module `zstd` for ROS 2 folders whose messages or files are compressed."""

    ZstdError = zstandard.ZstdError

    @staticmethod
    def decompress(data: bytes) -> bytes:
        return inflate(data, "zstd")

    @staticmethod
    def open(file: BinaryIO, _mode: str) -> "_BoundedStream":
        return _BoundedStream(file)


class _BoundedStream:
    """A compressed file, read up to what it can plausibly hold."""

    def __init__(self, file: BinaryIO) -> None:
        self._left = most_plain(file.seek(0, 2))
        file.seek(0)
        decompressor = zstandard.ZstdDecompressor()
        self._stream: Any = decompressor.stream_reader(file, read_across_frames=True)

    def read(self, length: int) -> bytes:
        data = bytes(self._stream.read(length))
        self._left -= len(data)
        if self._left < 0:
            raise ValueError("the file unpacks to more than it can hold")
        return data

    def __enter__(self) -> "_BoundedStream":
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()


def _bound_rosbags() -> None:
    """Put bounded decompression in the places where rosbags looks it up."""
    ros1: dict[str, Callable[[bytes], bytes]] = rosbag1_reader.decompressors
    ros1.update({name: partial(inflate, compression=name) for name in ("bz2", "lz4")})
    mcap: dict[str, Callable[[bytes, int], bytes]] = storage_mcap.DECOMPRESSORS
    for name in ("lz4", "zstd"):
        mcap[name] = partial(_inflate_chunk, name)
    rosbag2_reader.zstd = _BoundedZstd


def _inflate_chunk(compression: str, data: bytes, size: int) -> bytes:
    return inflate(data, compression, size)


_bound_rosbags()
