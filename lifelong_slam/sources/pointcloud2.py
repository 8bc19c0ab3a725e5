"""Decoding of sensor_msgs/PointCloud2 into points and raw point times."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.sources.point_times import Values, is_time_field

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_SAMPLE = 1000  # points of a cloud to judge its byte order by
_SHORTEST, _LONGEST = 1e-6, 1e9  # a micrometre in metres; 1000 km in millimetres


@dataclass(frozen=True, slots=True)
class Cloud:
    """A decoded cloud.

    Attributes:
        points: (N, 3) float64 metres, as the message holds them (NaN included).
        times: raw values (N,) of every field that may hold point times, by field name.
        swapped: the bytes were in the other order than the message says.
    """

    points: NDArray[np.float64]
    times: dict[str, Values]
    swapped: bool = False


def decode(message: Any) -> Cloud:
    """Decode a deserialised PointCloud2 of any field layout, byte order and padding.

    Coordinates that make no sense in the byte order that the message states, but do in the other one,
    are read in that.

    Raises:
        SourceError: there are no x, y, z fields.
        ValueError: the data don't fit the sizes that the message declares.
    """
    names = [field.name for field in message.fields]
    if not names and not int(message.height) * int(message.width):
        return Cloud(np.empty((0, 3)), {})  # a message as the driver's constructor left it
    if missing := [name for name in "xyz" if name not in names]:
        raise SourceError(
            f"a cloud without {', '.join(missing)}: it can't be used as a LiDAR scan; "
            f"its fields are {', '.join(names) or '(none)'}"
        )
    records = _records(message, [n for n in names if n in ("x", "y", "z") or is_time_field(n)])
    if swapped := _in_other_order(records):
        records = records.view(records.dtype.newbyteorder())
    points = np.empty((records.size, 3))
    with np.errstate(invalid="ignore"):  # NaN of unusual bits are for cleaning to drop
        for axis, name in enumerate("xyz"):
            points[:, axis].reshape(records.shape)[...] = records[name]
    times = {n: records[n].ravel() for n in records.dtype.names or () if n not in ("x", "y", "z")}
    return Cloud(
        points,
        {n: v.astype(v.dtype.newbyteorder("="), copy=False) for n, v in times.items()},
        swapped,
    )


def _in_other_order(records: NDArray[np.void]) -> bool:
    """Tell whether the coordinates are lengths in the other byte order only."""
    sample = records[:, :: max(1, records.size // _SAMPLE)]
    if _share(sample) >= 0.5:
        return False
    return _share(sample.view(records.dtype.newbyteorder())) > 0.9


def _share(records: NDArray[np.void]) -> float:
    with np.errstate(invalid="ignore"):  # NaN of unusual bits
        axes = [records[axis].ravel().astype(np.float64) for axis in "xyz"]
    return share_of_lengths(np.concatenate(axes))


def share_of_lengths(coordinates: NDArray[np.floating[Any]]) -> float:
    """Return the share of (N,) coordinates, zeros and NaN aside, that some unit makes a length.

    Bytes that aren't those of a float give it any exponent: one in six is as large as a length then.
    """
    sizes = np.abs(coordinates)
    sizes = sizes[sizes > 0]
    return float(np.mean((sizes > _SHORTEST) & (sizes < _LONGEST))) if len(sizes) else 1.0


def _records(message: Any, wanted: list[str]) -> NDArray[np.void]:
    """Return a (height, width) view of the wanted fields in the message's bytes."""
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    dtype = _record_type(message, wanted)
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    row = int(message.row_step)
    if height <= 1 or (row < width * step and len(data) == height * width * step):
        row = width * step  # some drivers leave row_step unset
    needed = (height - 1) * row + width * step if height and width else 0
    if row < width * step or len(data) < needed:
        raise ValueError(f"{height} x {width} points of {step} bytes in {len(data)} bytes of data")
    if needed == 0:
        return np.empty((0, 0), dtype)
    return np.ndarray((height, width), dtype, buffer=data.data, strides=(row, step))


def _record_type(message: Any, wanted: list[str]) -> np.dtype[np.void]:
    """Return the structured type of one point with its wanted fields."""
    order = ">" if message.is_bigendian else "<"
    fields = {}
    for field in message.fields:
        if field.name in wanted and field.datatype in _DATATYPES:
            kind = np.dtype(order + _DATATYPES[field.datatype])
            if field.offset + kind.itemsize > message.point_step:
                raise ValueError(f"field '{field.name}' ends beyond its point")
            fields[field.name] = (kind, int(field.offset))
    if unknown := [name for name in "xyz" if name not in fields]:
        raise ValueError(f"field '{unknown[0]}' has a datatype that PointCloud2 doesn't define")
    formats = [kind for kind, _ in fields.values()]
    offsets = [offset for _, offset in fields.values()]
    return np.dtype(
        {
            "names": list(fields),
            "formats": formats,
            "offsets": offsets,
            "itemsize": int(message.point_step),
        }
    )
