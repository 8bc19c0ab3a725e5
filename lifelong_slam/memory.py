"""Where a run keeps what it keeps, so that it can last for days in the same memory.

A C library puts a block wherever another one has just been freed. What stays for long comes to lie between
what a scan takes for a moment, and once that is freed there are holes, into which the next scan's arrays
hardly fit: the heap grows with every lap of the same place, though nothing is held for longer. Blocks that
belong together lie scattered over it, and searches through them take longer. So what stays is kept apart:
arrays in pages of their own, structures of many small blocks in heaps of their own.
"""

import math
import mmap
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

P = ParamSpec("P")
T = TypeVar("T")
Scalar = TypeVar("Scalar", bound=np.generic)

_LARGE = 1 << 15  # bytes; what is smaller fits into most holes, and isn't worth pages of its own


class Heap:
    """A part of memory for one structure of many small blocks that come and go, such as a voxel map.

    In a heap that all share, neighbours in space lie scattered over memory after some laps, and every
    search through them takes longer: by a sixth from lap 3 to lap 20 (`benchmarks/laps.py`). glibc gives
    each thread a heap of its own, an arena, where blocks of the same few sizes take each other's
    places. So whatever allocates blocks of the structure is called in a thread that does nothing else.
    With other C libraries that does no harm.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="heap")

    def call(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function that allocates, wait for it, and return or raise what it does."""
        return self._thread.submit(function, *args, **kwargs).result()


class GrowingArray:
    """Rows of a kind that stay for long, with room for more."""

    def __init__(self, rows: NDArray[Any]) -> None:
        """Start with copies of (N, *shape) rows, which may be none."""
        self._room = kept(rows)
        self._count = len(rows)

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> NDArray[Any]:
        """(N, *shape) view of all rows, until they become more or others."""
        return self._room[: self._count]

    def append(self, row: ArrayLike) -> None:
        """Add a row."""
        self.extend(np.asarray(row)[None])

    def extend(self, rows: NDArray[Any]) -> None:
        """Add (M, *shape) rows."""
        count = self._count + len(rows)
        if count > len(self._room):
            room = self._larger(count)
            room[: self._count] = self.rows
            self._room = room
        self._room[self._count : count] = rows
        self._count = count

    def replace(self, rows: NDArray[Any]) -> None:
        """Have (M, *shape) other rows."""
        if len(rows) > len(self._room):
            self._room = self._larger(len(rows))
        self._room[: len(rows)] = rows
        self._count = len(rows)

    def _larger(self, count: int) -> NDArray[Any]:
        return _empty((2 * count, *self._room.shape[1:]), self._room.dtype)


def kept(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a copy of an array that is to stay for long."""
    copy = _empty(array.shape, array.dtype)
    copy[...] = array
    return copy


def _empty(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return an array to be filled; the system gives pages to the part that is."""
    size = math.prod(shape) * dtype.itemsize
    if size < _LARGE:
        return np.empty(shape, dtype)
    try:
        pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    except OSError:  # so many of them as there may be: Linux allows 65,530
        return np.empty(shape, dtype)
    return np.ndarray(shape, dtype, pages)
