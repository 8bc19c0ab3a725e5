"""Whether a LAS or LAZ file can hold what its header declares, before a reader believes it.

Format: ASPRS, LAS Specification 1.4 R15, tables 3 (header) and 7 (variable-length records); for LAZ the
chunk table of Isenburg's LASzip.
"""

import struct
from pathlib import Path
from typing import BinaryIO

from formats.bounded import check_plausible

_HEADER = struct.Struct("<HIIBHI")  # from byte 94: header size, offset of points, VLRs, format, ...
_EXTENDED = struct.Struct("<QIQ")  # from byte 235 of LAS 1.4: first EVLR, EVLRs, points
_VLR, _EVLR = 54, 60  # bytes of their headers
_COMPRESSED = 0x80  # flag of the point format
_CHUNK_TABLE = struct.Struct("<II")  # version, chunks


def check_las(path: Path) -> None:
    """Check the counts that a header declares against the size of the file.

    Raises:
        ValueError: the file is too small for them, or is no LAS at all.
        struct.error: the header isn't whole.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(375)
        if header[:4] != b"LASF":
            raise ValueError("it doesn't begin as LAS does")
        header_size, start, vlrs, form, record_size, points = _HEADER.unpack_from(header, 94)
        if header[25] >= 4:
            evlr_start, evlrs, points = _EXTENDED.unpack_from(header, 235)
            _check_room("extended records", evlrs * _EVLR, evlr_start, size)
        _check_room("variable-length records", vlrs * _VLR, header_size, start)
        if not form & _COMPRESSED:
            if start + points * record_size > size:
                there = max(size - start, 0) // max(record_size, 1)
                raise ValueError(f"it has {there} points of the {points} in its header")
            return
        check_plausible(points * record_size, size - start)
        _check_chunk_table(file, start, size)


def _check_room(what: str, needed: int, start: int, end: int) -> None:
    if needed and start + needed > end:
        raise ValueError(f"its {what} need {needed} bytes from {start}, and {end} are there")


def _check_chunk_table(file: BinaryIO, start: int, size: int) -> None:
    file.seek(start)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # its place is at the end of the file, as the writer couldn't go back
        file.seek(-8, 2)
        (table,) = struct.unpack("<q", file.read(8))
    if not start + 8 <= table <= size - _CHUNK_TABLE.size:
        raise ValueError("its chunk table lies outside")
    file.seek(table)
    _, chunks = _CHUNK_TABLE.unpack(file.read(_CHUNK_TABLE.size))
    if chunks > size:
        raise ValueError(f"{chunks} chunks aren't in {size} bytes")
