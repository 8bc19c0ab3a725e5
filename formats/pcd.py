"""PCD files of any fields: ascii, binary and binary_compressed.

Format: the Point Cloud Library's documentation, "The PCD file format". Written here because the
readers at hand refuse, or corrupt memory on, the padding fields that PCL itself writes.
"""

import math
import struct
from collections.abc import Collection
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.bounded import check_plausible

_KINDS = {"F": "f", "U": "u", "I": "i"}


def read_pcd(path: Path, wanted: Collection[str] | None = None) -> NDArray[np.void]:
    """Return (N,) records with the file's fields; padding fields are named ``_0``, ``_1``, ...

    Args:
        path: of the file.
        wanted: fields that matter; text in the columns of others need not fit their types.

    Raises:
        ValueError: the file is damaged or cut short.
    """
    data = path.read_bytes()
    header, body = _split(data)
    dtype = _record_type(header)
    count = int(header["POINTS"][0] if "POINTS" in header else 0)
    if "POINTS" not in header:
        count = int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    encoding = header["DATA"][0].lower()
    if encoding == "ascii":
        return read_rows(body, dtype, count, wanted)
    if encoding == "binary":
        return read_records(body, dtype, count)
    if encoding == "binary_compressed":
        return _compressed(body, dtype, count)
    raise ValueError(f"DATA {encoding} is not a PCD encoding")


def read_rows(
    text: bytes, dtype: np.dtype[np.void], count: int, wanted: Collection[str] | None = None
) -> NDArray[np.void]:
    """Parse `count` rows of numbers in columns, those of the wanted fields or of all.

    Raises:
        ValueError: there are fewer rows, or a row doesn't fit.
    """
    if count == 0:
        return np.empty(0, dtype)
    if not 0 < 2 * count <= len(text) + 1:  # a digit and what parts it from the next
        raise ValueError(f"{count} points aren't in {len(text)} bytes of text")
    dtype, columns = _wanted_columns(dtype, wanted)
    rows = np.loadtxt(BytesIO(text), dtype, comments=None, max_rows=count, ndmin=1, usecols=columns)
    if len(rows) != count:
        raise ValueError(f"{len(rows)} of {count} rows of points are there")
    return rows


def _wanted_columns(
    dtype: np.dtype[np.void], wanted: Collection[str] | None
) -> tuple[np.dtype[np.void], list[int] | None]:
    """Return the type of the wanted fields and the columns of text that they are in."""
    if wanted is None:
        return dtype, None
    fields: list[tuple[str, np.dtype[Any]]] = []
    columns: list[int] = []
    first = 0
    for name in dtype.names or ():
        size = math.prod(dtype[name].shape)
        if name in wanted:
            fields.append((name, dtype[name]))
            columns += range(first, first + size)
        first += size
    return np.dtype(fields), columns


def read_records(
    body: bytes | memoryview, dtype: np.dtype[np.void], count: int
) -> NDArray[np.void]:
    """Return the first `count` records of a binary body.

    Raises:
        ValueError: there are fewer.
    """
    if not 0 <= count * dtype.itemsize <= len(body):
        raise ValueError(f"{count} points of {dtype.itemsize} bytes aren't in {len(body)} bytes")
    return np.frombuffer(body, dtype, count)


def _split(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Return the header's entries and the bytes after it."""
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header:
        end = data.find(b"\n", position)
        if end < 0:
            raise ValueError("its PCD header is not complete")
        words = data[position:end].decode("ascii").split()
        position = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    if missing := {"FIELDS", "SIZE", "TYPE"} - header.keys():
        raise ValueError(f"its PCD header has no {', '.join(sorted(missing))}")
    return header, data[position:]


def _record_type(header: dict[str, list[str]]) -> np.dtype[np.void]:
    names = [f"_{i}" if name == "_" else name for i, name in enumerate(header["FIELDS"])]
    counts = header.get("COUNT", ["1"] * len(names))
    columns = zip(names, header["TYPE"], header["SIZE"], counts, strict=True)
    fields = [
        (name, f"<{_KINDS[kind]}{size}", (int(count),) if count != "1" else ())
        for name, kind, size, count in columns
        if int(count)
    ]
    return np.dtype(fields)


def _compressed(body: bytes, dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Decode a binary_compressed body: all of the first field, all of the second, and so on."""
    size, full = struct.unpack_from("<II", body)
    if len(body) < 8 + size:
        raise ValueError(f"{len(body)} of {8 + size} bytes of points are there")
    check_plausible(full, size)
    if not 0 <= count * dtype.itemsize <= full:
        raise ValueError(f"{count} points of {dtype.itemsize} bytes aren't in {full} bytes")
    flat = _decompress_lzf(body[8 : 8 + size], full)
    records, position = np.empty(count, dtype), 0
    for name in dtype.names or ():
        column = records[name]
        column[...] = np.frombuffer(flat, column.dtype, column.size, position).reshape(column.shape)
        position += column.nbytes
    return records


def _decompress_lzf(data: bytes, size: int) -> bytes:
    """Undo LibLZF's compression: runs of literals, and references to what came before."""
    out, position = bytearray(), 0
    while position < len(data):
        control = data[position]
        position += 1
        if control < 32:
            out += data[position : position + control + 1]
            position += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[position]
            position += 1
        start = len(out) - ((control & 31) << 8) - data[position] - 1
        position += 1
        if start < 0:
            raise ValueError("its compressed data are corrupt")
        piece = out[start : start + length + 2]
        while len(piece) < length + 2:  # the reference reaches into what it produces
            piece += piece[: length + 2 - len(piece)]
        out += piece
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError("its compressed data are corrupt")
    return bytes(out)
