"""PLY files: the vertices of ascii, little-endian and big-endian ones.

Format: Greg Turk, "The PLY polygon file format" (1994).
"""

from io import BytesIO
from itertools import chain, islice, repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.pcd import read_records, read_rows

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
_Property = tuple[
    Any, ...
]  # a name and the type of its value, or those of a list's length and items


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
    body = memoryview(data)[end:]
    for name, count, properties in _elements(header, _ORDERS[encoding]):
        if name == "vertex" and encoding == "ascii":
            return read_rows(bytes(body), _record_type(properties), count)
        if name == "vertex":
            records = read_records(body, _record_type(properties), count)
            return records.astype(records.dtype.newbyteorder("="), copy=False)
        body = (_after_lines if encoding == "ascii" else _after)(body, count, properties)
    raise ValueError("it has no vertices")


def _elements(header: list[list[str]], order: str) -> list[tuple[str, int, list[_Property]]]:
    """Return name, number and properties of the elements up to the vertices."""
    elements: list[tuple[str, int, list[_Property]]] = []
    for words in header:
        if words[:1] == ["element"]:
            if elements and elements[-1][0] == "vertex":
                break
            if int(words[2]) < 0:
                raise ValueError(f"it has {words[2]} elements '{words[1]}'")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            *kinds, name = words[2:] if words[1] == "list" else words[1:]
            elements[-1][2].append((name, *(np.dtype(order + _KINDS[kind]) for kind in kinds)))
    return elements


def _record_type(properties: list[_Property]) -> np.dtype[np.void]:
    if any(len(kinds) != 1 for _, *kinds in properties):
        raise ValueError("lists among its vertices are not supported")
    return np.dtype([(name, kind) for name, kind, *_ in properties])


def _after_lines(body: memoryview, count: int, _: list[_Property]) -> memoryview:
    """Return what follows so many lines."""
    lines = BytesIO(body)
    for _line in islice(lines, count):
        pass
    return body[lines.tell() :]


def _after(body: memoryview, count: int, properties: list[_Property]) -> memoryview:
    """Return what follows so many binary elements, whose lists start with their length."""
    if all(len(kinds) == 1 for _, *kinds in properties):
        return body[count * _record_type(properties).itemsize :]
    position = 0
    for _, *kinds in chain.from_iterable(repeat(properties, count)):
        if position >= len(body):
            raise ValueError("it ends before its vertices")
        length = 1
        if len(kinds) == 2:
            length = int(np.frombuffer(body, kinds[0], 1, position)[0])
            position += kinds[0].itemsize
        position += max(length, 0) * kinds[-1].itemsize
    return body[position:]
