"""PLY files: the vertices of ascii, little-endian and big-endian ones.

Format: Greg Turk, "The PLY polygon file format" (1994).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.sources.pcd import read_rows

_KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    "int64": "i8",
    "uint64": "u8",
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = b"end_header"


def read_ply(path: Path) -> NDArray[np.void]:
    """Return (N,) records with the vertices' properties.

    Raises:
        ValueError: the file is damaged, cut short, or has no plain list of vertices.
    """
    data = path.read_bytes()
    end = data.find(b"\n", data.find(_END)) + 1
    if not data.startswith(b"ply") or _END not in data or end == 0:
        raise ValueError("its PLY header is not complete")
    header = [line.split() for line in data[:end].decode("ascii").splitlines()]
    encoding = next((words[1] for words in header if words[:1] == ["format"]), "")
    if encoding not in _ORDERS:
        raise ValueError(f"format {encoding} is not a PLY encoding")
    for name, count, dtype in _elements(header, _ORDERS[encoding]):
        if name == "vertex":
            body = data[end:]
            if encoding == "ascii":
                return read_rows(body, dtype, count)
            records = np.frombuffer(body, dtype, count)
            return records.astype(dtype.newbyteorder("="), copy=False)
        if encoding == "ascii":
            end += sum(len(line) for line in data[end:].splitlines(keepends=True)[:count])
        else:
            end += count * dtype.itemsize
    raise ValueError("it has no vertices")


def _elements(header: list[list[str]], order: str) -> list[tuple[str, int, np.dtype[np.void]]]:
    """Return name, number and record type of the elements up to the vertices."""
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for words in header:
        if words[:1] == ["element"]:
            if elements and elements[-1][0] == "vertex":
                break
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            if words[1] == "list":
                raise ValueError("lists among or before the vertices are not supported")
            elements[-1][2].append((words[2], order + _KINDS[words[1]]))
    return [(name, count, np.dtype(fields)) for name, count, fields in elements]
