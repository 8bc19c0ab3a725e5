"""Keeps structures of many small parts together in memory over long runs."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Heap:
    """A part of memory for one structure of many small blocks that come and go, such as a voxel map.

    In a heap that all share, a block goes wherever another one has just been freed. After some laps of the
    same place, neighbours in space lie scattered over memory, and every search through them takes longer:
    by a sixth from lap 3 to lap 20 (`benchmarks/laps.py`). glibc gives each thread a heap of its own, an
    arena, where blocks of the same few sizes take each other's places. So whatever allocates blocks of
    the structure is called in a thread that does nothing else. With other C libraries that does no harm.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="heap")

    def call(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function that allocates, wait for it, and return or raise what it does."""
        return self._thread.submit(function, *args, **kwargs).result()
