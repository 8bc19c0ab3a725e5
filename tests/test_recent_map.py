"""The map that odometry registers to holds the last stretch of path, however often a block is driven."""

import numpy as np
import pytest
from kiss_icp.mapping import VoxelHashMap
from slam_support import planar

from lifelong_slam.odometry.recent_map import STRETCH, RecentMap

STEP = 5.0  # metres


def new_map():
    return VoxelHashMap(voxel_size=1.0, max_distance=1e4, max_points_per_voxel=20)


def drive(distances, points_at):
    recent = RecentMap(new_map)
    for distance in distances:
        recent.update(points_at(distance), planar(distance, 0, 0))
    return recent


def beside(distance):
    """One point beside the sensor, as far along as it has come."""
    return np.array([[0.0, 3.0, 0.0]])


def reach(recent):
    return sorted(recent.current.point_cloud()[:, 0])


@pytest.mark.parametrize("length", [0, 100, 295])
def test_the_first_two_stretches_are_all_there(length):
    distances = np.arange(0, length + 1, STEP)
    np.testing.assert_allclose(reach(drive(distances, beside)), distances)


@pytest.mark.parametrize("length", [320, 455, 1000, 3333])
def test_it_holds_at_least_one_stretch_and_at_most_two(length):
    distances = np.arange(0, length + 1, STEP)
    held = reach(drive(distances, beside))
    np.testing.assert_allclose(held, distances[-len(held) :])
    assert STRETCH - 2 * STEP <= held[-1] - held[0] <= 2 * STRETCH


def test_laps_that_drift_do_not_pile_up():
    """A block of 200 m, driven ten times, each time seen 2 m further to the side by odometry."""

    def size(laps):
        recent = RecentMap(new_map)
        for distance in np.arange(0, laps * 200, STEP):
            angle, lap = 2 * np.pi * distance / 200, distance // 200
            radius = 200 / (2 * np.pi)
            T = planar(radius * np.cos(angle) + 2 * lap, radius * np.sin(angle), 0)
            recent.update(np.array([[0.0, 0.0, 0.0]]), T)
        return len(recent.current.point_cloud())

    assert size(10) <= size(2)
