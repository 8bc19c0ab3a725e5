"""The benchmark of map distances on small towns."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
map_metrics = importlib.import_module("map_metrics")


def timing(seconds, mean=0.1):
    return map_metrics.Timing(seconds, 2 * seconds, 100.0, (mean, 0.2), (3.0, 4.0))


@pytest.mark.parametrize("order", ["scan", "random"])
def test_a_town_is_the_same_each_time_and_another_map_of_it_is_near(order):
    one, again, other = (map_metrics.town(20_000, seed, order) for seed in (1, 1, 2))
    assert one.shape == (20_000, 3)
    assert one.dtype == np.float32
    np.testing.assert_array_equal(one, again)
    there, back = map_metrics.mutual_distances(one, other)
    assert 0 < np.median(there) < 0.3
    assert 0 < np.median(back) < 0.3


def test_both_orders_hold_the_same_points():
    by_order = [map_metrics.town(5000, 1, order) for order in ("scan", "random")]
    scan, random = (points[np.lexsort(points.T)] for points in by_order)
    np.testing.assert_array_equal(scan, random)


def test_ours_and_open3d_agree():
    timings = [map_metrics.measure(system, 5000, "scan") for system in ("ours", "open3d")]
    assert map_metrics.agree(timings)
    assert not map_metrics.agree([*timings, timing(1.0)])


def test_ratios_are_taken_within_a_repeat():
    timings = {"ours": [timing(1.0), timing(4.0)], "open3d": [timing(2.0), timing(12.0)]}
    assert "2.50 times as fast (2.00 .. 3.00)" in map_metrics.table(timings)
