"""Where a run keeps what it keeps."""

import itertools
import mmap
import subprocess
import sys
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifelong_slam.geometry import exp
from lifelong_slam.memory import GrowingArray, Heap, kept
from lifelong_slam.odometry.recent_map import STRETCH, RecentMap
from lifelong_slam.odometry.surface_refinement import SurfaceRefinement
from lifelong_slam.registration import Cloud


def test_all_calls_to_a_heap_are_made_by_one_thread_and_each_heap_has_its_own():
    heap, other = Heap(), Heap()
    threads = {heap.call(threading.get_ident) for _ in range(10)}
    assert len(threads) == 1
    assert not threads & {threading.get_ident(), other.call(threading.get_ident)}


def test_what_a_call_returns_or_raises_comes_through():
    heap = Heap()
    assert heap.call(divmod, 17, 5) == (3, 2)
    assert heap.call(sorted, [1, 2], reverse=True) == [2, 1]
    with pytest.raises(ZeroDivisionError):
        heap.call(divmod, 1, 0)
    assert heap.call(len, "abc") == 3


def test_the_thread_of_a_heap_ends_with_it():
    heap = Heap()
    ident = heap.call(threading.get_ident)
    (thread,) = (t for t in threading.enumerate() if t.ident == ident)
    del heap
    thread.join(timeout=10)
    assert not thread.is_alive()


class NotingMap:
    """A voxel map that notes which threads fill it."""

    def __init__(self, threads):
        self._threads = threads

    def insert(self, points, pose):
        self._threads.add(threading.get_ident())

    update = insert


def test_the_local_maps_of_odometry_are_filled_in_heaps_of_their_own():
    of_recent, of_surfaces = [], set()

    def new_map():
        of_recent.append(set())
        return NotingMap(of_recent[-1])

    recent = RecentMap(new_map)
    for step in range(50):
        recent.update(np.zeros((1, 3)), exp(np.array([0, 0, 0, step * STRETCH / 10, 0, 0])))
    surfaces = SurfaceRefinement(1.0)
    surfaces._map = NotingMap(of_surfaces)
    surfaces.insert(
        Cloud.prepare(np.random.default_rng(0).uniform(-5, 5, (500, 3)), 1.0), np.eye(4)
    )
    assert len(of_recent) > 5
    assert all(len(threads) == 1 for threads in [*of_recent, of_surfaces])
    # A new map has the heap of the one that went, not that of the one beside it.
    for older, younger in itertools.pairwise(of_recent):
        assert older != younger
    assert len(set.union(*of_recent)) == 2
    assert len(set.union(*of_recent, of_surfaces, {threading.get_ident()})) == 4


@given(st.lists(st.integers(0, 3000), max_size=8))
def test_rows_come_back_as_they_went_in(counts):
    rows = np.random.default_rng(0).normal(size=(sum(counts), 2, 3))
    growing = GrowingArray(np.zeros((0, 2, 3)))
    for part in np.split(rows, np.cumsum(counts)[:-1]) if counts else []:
        growing.extend(part)
    assert len(growing) == len(rows)
    np.testing.assert_array_equal(growing.rows, rows)


def test_one_by_one_is_the_same():
    growing = GrowingArray(np.zeros(0, np.int64))
    for i in range(5000):
        growing.append(10**18 + i)
    assert growing.rows.dtype == np.int64
    assert growing.rows.tolist() == [10**18 + i for i in range(5000)]


def test_what_was_appended_may_change_afterwards():
    growing, row = GrowingArray(np.zeros((0, 3))), np.ones(3)
    growing.append(row)
    row[:] = 2
    assert growing.rows.tolist() == [[1, 1, 1]]


def test_a_row_of_another_shape_is_refused():
    growing = GrowingArray(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="shape"):
        growing.append(np.ones(4))
    assert len(growing) == 0


def test_rows_may_be_replaced_by_fewer_and_by_more():
    growing = GrowingArray(np.arange(10))
    for count in (3, 0, 10, 5000, 20):
        growing.replace(np.arange(count) + 1)
        assert growing.rows.tolist() == list(range(1, count + 1))
    growing.append(7)
    assert growing.rows[-2:].tolist() == [20, 7]


@pytest.mark.parametrize("count", [0, 1, 100_000])
def test_a_copy_is_kept_as_it_was(count):
    array = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    copy = kept(array)
    assert copy.dtype == array.dtype
    np.testing.assert_array_equal(copy, array)
    array += 1
    assert not count or not np.any(copy == array)


def test_where_the_system_gives_no_more_pages_of_their_own_the_heap_has_some(monkeypatch):
    def refuse(*_, **__):
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(mmap, "mmap", refuse)
    np.testing.assert_array_equal(kept(np.arange(100_000)), np.arange(100_000))


KEEPING = """
import sys
import numpy as np
import psutil
from lifelong_slam.memory import kept

keep = {"kept": kept, "copied": np.copy}[sys.argv[1]]
process, lasting = psutil.Process(), []
before = process.memory_info().rss
for size in range(10_000, 16_000, 500):
    scratch = []
    for _ in range(200):
        scratch.append(np.ones(size))
        lasting.append(keep(np.ones(5_000)))
    del scratch, lasting[:-200]
print((process.memory_info().rss - before) / 1e6)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="about glibc's heap")
def test_what_is_kept_leaves_no_holes_among_what_is_there_for_a_moment():
    """In processes of their own: this one may have free memory left from other tests."""

    def growth_mb(how):
        return float(subprocess.check_output([sys.executable, "-c", KEEPING, how]))

    # 8 MB of it are held.
    assert growth_mb("kept") < 16
    assert growth_mb("copied") > 32
