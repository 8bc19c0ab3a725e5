"""Walk through an MCAP file record by record, without its summary."""

import logging
import struct
from collections.abc import Iterator
from dataclasses import replace
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.typesys.msg import normalize_msgtype

from formats.bags import MCAP_MAGIC
from formats.bounded import Inflater
from lifelong_slam.sources.channel import CDR, Channel

_log = logging.getLogger(__name__)

MAGIC = MCAP_MAGIC

_CUT = (McapError, struct.error, ValueError, MemoryError)


def walk(path: Path) -> Iterator[tuple[Channel, int, bytes]]:
    """Yield channel, receive time in ns and raw message, as far as records are whole.

    Of a chunk that is cut, the messages before the cut come out too; a chunk that doesn't
    decompress or fails its checksum is left out with a warning.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in _records(path):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, ChannelRecord):
            channels[record.id] = _channel(record, schemas.get(record.schema_id))
        elif isinstance(record, Message) and record.channel_id in channels:
            yield channels[record.channel_id], record.log_time, record.data


def stated_count(path: Path) -> int:
    """Return the number of messages that an MCAP file's summary states, -1 if there is none."""
    try:
        with path.open("rb") as file:
            summary = SeekingReader(file, record_size_limit=path.stat().st_size).get_summary()
    except (*_CUT, OSError, EOFError, OverflowError) as error:
        _log.debug("%s: no summary: %r", path, error)
        return -1
    return summary.statistics.message_count if summary and summary.statistics else -1


def _records(path: Path) -> Iterator[McapRecord]:
    """Yield the records of a file up to where it is cut, those inside chunks as well."""
    end = len(MAGIC)
    inflater = Inflater(path.stat().st_size)
    with path.open("rb") as file:
        reader = StreamReader(_WholeReads(file), emit_chunks=True)
        try:
            for record in reader.records:
                end = file.tell()
                if isinstance(record, Chunk):
                    yield from _inside(record, path, inflater)
                else:
                    yield record
        except _CUT as error:
            _log.debug("%s: end of what is readable: %r", path, error)
            file.seek(end)
            yield from _inside_cut_chunk(file, inflater)


def _inside(chunk: Chunk, path: Path, inflater: Inflater) -> list[McapRecord]:
    try:
        return list(breakup_chunk(_inflated(chunk, inflater), validate_crc=True))
    except Exception as error:  # damaged records raise whatever the parser met first
        _log.warning("%s: a corrupt chunk of %d bytes left out: %s", path, len(chunk.data), error)
        return []


def _inside_cut_chunk(file: BinaryIO, inflater: Inflater) -> Iterator[McapRecord]:
    """Yield the whole records of a last chunk whose end is missing, if it is a chunk."""
    stream = ReadDataStream(BytesIO(file.read()))
    try:
        opcode, _ = stream.read1(), stream.read8()
        if opcode != Opcode.CHUNK:
            return
        inner = BytesIO(_inflated(Chunk.read(stream), inflater).data)
        yield from StreamReader(_WholeReads(inner), skip_magic=True).records
    except _CUT as error:
        _log.debug("end of the last chunk: %r", error)


def _inflated(chunk: Chunk, inflater: Inflater) -> Chunk:
    """Return a chunk with what is there of its content decompressed."""
    plain = inflater(chunk.data, chunk.compression, chunk.uncompressed_size)
    return replace(chunk, compression="", data=plain)


def _channel(record: ChannelRecord, schema: Schema | None) -> Channel:
    encoding = schema.encoding if schema else ""
    return Channel(
        topic=record.topic,
        msgtype=_msgtype(schema.name) if schema else "",
        definition=schema.data.decode(errors="replace") if schema else "",
        idl="idl" in encoding,
        encoding=record.message_encoding or CDR,
    )


def _msgtype(name: str) -> str:
    """Return a ROS type in ROS 2 notation, and one of another kind as it is."""
    return str(normalize_msgtype(name)) if "/" in name else name


class _WholeReads:
    """A file whose last read gives nothing rather than less than what was asked for.

    Lengths come from a damaged file: none larger than the file may lead to an allocation.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = file.seek(0, SEEK_END)
        file.seek(0)

    def read(self, length: int) -> bytes:
        """Read exactly `length` bytes, or nothing."""
        return self._file.read(length) if length <= self._size - self._file.tell() else b""
