"""Arrays as checked, compressed blobs.

A blob is a CRC-32 and what it covers: for a pose or a covariance the plain float64, for everything
else one zstandard frame with a JSON header (name, type and shape of each array) and the arrays' bytes.
Bytes of equal significance lie together, and int64, which hold sorted keys and stamps, are stored as
differences; both make them compress well.

Point clouds are sets: their order isn't kept. Coordinates are rounded to `POINT_RESOLUTION`, a thirtieth
of a LiDAR's range noise, and interleaved bit by bit into Morton codes (Morton, 1966). Sorted, neighbours
in space are neighbours in the list, and a point takes a third of its 12 bytes of float32.
"""

import json
import math
import struct
import zlib
from collections.abc import Mapping

import numpy as np
import zstandard
from numpy.typing import NDArray
from pydantic import NonNegativeInt, TypeAdapter, ValidationError

from formats.bounded import inflate

Layout = Mapping[str, tuple[str, tuple[int, ...]]]

POINT_RESOLUTION = 0.001  # metres
_EXTENT = 1 << 21  # steps that a cloud may extend over along an axis, 63 bits for three of them
_LEVEL = 3
_CHECKSUM = struct.Struct("<I")
_LENGTH = struct.Struct("<I")
_HEADER = TypeAdapter(dict[str, tuple[str, list[NonNegativeInt]]])
_POINTS: Layout = {"low": ("<i8", ()), "codes": ("<i8", ())}
# Masks that spread 21 bits to every third of 63, each after a shift by the number beside it.
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
_GATHER = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x001F0000FF0000FF),
    (16, 0x001F00000000FFFF),
    (32, 0x00000000001FFFFF),
)


def pack(arrays: Mapping[str, NDArray[np.generic]]) -> bytes:
    """Turn named arrays of numbers into a blob, without loss."""
    parts = []
    header = {}
    for name, array in arrays.items():
        little = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
        header[name] = [little.dtype.str, little.shape]
        parts.append(_planes(_differences(little)))
    text = json.dumps(header).encode()
    plain = b"".join([_LENGTH.pack(len(text)), text, *parts])
    return _sealed(zstandard.ZstdCompressor(level=_LEVEL).compress(plain))


def unpack(blob: bytes, layout: Layout) -> dict[str, NDArray[np.generic]]:
    """Undo `pack`.

    Args:
        blob: what it returned.
        layout: what it must hold, type and shape of a row of each array by its name.

    Raises:
        ValueError: the blob is damaged, or holds something else.
    """
    plain = memoryview(inflate(_opened(blob), "zstd"))
    header, position = _header(plain)
    if header.keys() != layout.keys():
        raise ValueError(
            f"it holds {', '.join(header)[:80] or 'nothing'} instead of {', '.join(layout)}"
        )
    arrays = {}
    for name, (code, shape) in header.items():
        kind, row = np.dtype(layout[name][0]), layout[name][1]
        if (code, shape[1:]) != (kind.str, [*row]):
            raise ValueError(f"its array '{name}' is {code} {shape}")
        count = math.prod(shape)
        if count * kind.itemsize > len(plain) - position:
            raise ValueError(f"its array '{name}' isn't whole")
        planes = np.frombuffer(plain, np.uint8, count * kind.itemsize, position)
        position += count * kind.itemsize
        rows = planes.reshape(kind.itemsize, count).T.copy(order="C")
        arrays[name] = _sums(rows.view(kind).reshape(shape))
    return arrays


def pack_points(points: NDArray[np.float32]) -> bytes:
    """Turn (N, 3) points in metres into a blob, rounded to `POINT_RESOLUTION` and sorted by place.

    Raises:
        ValueError: a point isn't finite, or they extend over more than 2 km along an axis.
    """
    if not np.isfinite(points).all():
        raise ValueError("a point is not finite")
    steps = np.rint(points.astype(np.float64) / POINT_RESOLUTION)
    low = steps.min(axis=0) if len(steps) else np.zeros(3)
    if np.any(steps - low >= _EXTENT):
        raise ValueError(f"points extend over more than {_EXTENT * POINT_RESOLUTION:.0f} m")
    codes = np.zeros(len(steps), dtype=np.int64)
    for axis, column in enumerate((steps - low).T):
        codes |= _spread(column.astype(np.int64)) << axis
    return pack({"low": low.astype(np.int64), "codes": np.sort(codes)})


def unpack_points(blob: bytes) -> NDArray[np.float32]:
    """Undo `pack_points`; the order of the (N, 3) points is another.

    Raises:
        ValueError: the blob is damaged.
    """
    arrays = unpack(blob, _POINTS)
    codes, low = arrays["codes"].astype(np.int64), arrays["low"].astype(np.int64)
    if low.shape != (3,):
        raise ValueError("its cloud has no corner")
    points = np.empty((len(codes), 3), np.float32)
    for axis in range(3):  # one by one, to take less memory
        points[:, axis] = (_gather(codes >> axis) + low[axis]) * POINT_RESOLUTION
    return points


def pack_matrix(matrix: NDArray[np.float64]) -> bytes:
    """Turn a (n, n) matrix into a blob, without loss."""
    return _sealed(matrix.astype("<f8").tobytes())


def unpack_matrix(blob: bytes, size: int) -> NDArray[np.float64]:
    """Undo `pack_matrix`.

    Args:
        blob: what it returned.
        size: rows, and columns, of the matrix.

    Raises:
        ValueError: the blob is damaged.
    """
    return np.frombuffer(_opened(blob), "<f8").astype(np.float64).reshape(size, size)


def _header(plain: memoryview) -> tuple[dict[str, tuple[str, list[int]]], int]:
    """Return type and shape of each array by name, and where their bytes begin."""
    try:
        end = _LENGTH.size + int(_LENGTH.unpack_from(plain)[0])
        if end > len(plain):
            raise ValueError("its header isn't whole")
        return _HEADER.validate_json(bytes(plain[_LENGTH.size : end])), end
    except struct.error as error:
        raise ValueError("its header isn't whole") from error
    except ValidationError as error:
        raise ValueError(f"its header is damaged: {error.errors()[0]['msg']}") from error


def _sealed(data: bytes) -> bytes:
    return _CHECKSUM.pack(zlib.crc32(data)) + data


def _opened(blob: bytes) -> bytes:
    if not isinstance(blob, bytes):
        raise ValueError("it is no blob")
    data = blob[_CHECKSUM.size :]
    if blob[: _CHECKSUM.size] != _CHECKSUM.pack(zlib.crc32(data)):
        raise ValueError("the checksum is wrong")
    return data


def _planes(array: NDArray[np.generic]) -> bytes:
    """Return all first bytes of the elements, then all second ones, and so on."""
    rows = array.reshape(-1).view(np.uint8).reshape(array.size, array.itemsize)
    return rows.T.tobytes()


def _differences(array: NDArray[np.generic]) -> NDArray[np.generic]:
    return np.diff(array, axis=0, prepend=array.dtype.type(0)) if _summed(array) else array


def _sums(array: NDArray[np.generic]) -> NDArray[np.generic]:
    return np.cumsum(array, axis=0) if _summed(array) else array


def _summed(array: NDArray[np.generic]) -> bool:
    return array.dtype == np.int64 and array.ndim == 1


def _spread(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Move bit i of 21-bit values to bit 3 i."""
    for shift, mask in _SPREAD:
        values = (values | values << shift) & mask
    return values


def _gather(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Undo `_spread`, whatever the other bits are."""
    codes = codes & _SPREAD[-1][1]
    for shift, mask in _GATHER:
        codes = (codes | codes >> shift) & mask
    return codes
