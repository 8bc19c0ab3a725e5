"""A heap's blocks are allocated by one thread that does nothing else."""

import itertools
import threading

import numpy as np
import pytest

from lifelong_slam.geometry import exp
from lifelong_slam.heap import Heap
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
