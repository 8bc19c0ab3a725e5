"""Nearest-neighbour distances: against brute force, SciPy and Open3D, and what they can't be taken of."""

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from eval import nearest
from eval.errors import EvidenceError
from eval.nearest import mutual_distances, nearest_distances

coordinates = st.floats(-1e4, 1e4, allow_subnormal=False)


def clouds(size, dimensions=3, dtype=np.float64, elements=coordinates):
    return st.integers(1, size).flatmap(
        lambda n: arrays(dtype, (n, dimensions), elements=elements, fill=st.nothing())
    )


@given(clouds(40), clouds(40))
def test_distances_are_those_of_brute_force(points, target):
    np.testing.assert_allclose(
        nearest_distances(points, target), cdist(points, target).min(axis=1), rtol=1e-12, atol=1e-12
    )


@given(clouds(30, 2), clouds(30, 2))
def test_points_of_a_plane_are_as_good(points, target):
    np.testing.assert_allclose(
        nearest_distances(points, target), cdist(points, target).min(axis=1), rtol=1e-12, atol=1e-12
    )


@given(clouds(60, elements=st.integers(-3, 3)), clouds(60, elements=st.integers(-3, 3)))
def test_equal_points_and_ties_do_no_harm(points, target):
    np.testing.assert_allclose(
        nearest_distances(points, target), cdist(points, target).min(axis=1), atol=1e-12
    )


@given(clouds(40), clouds(40))
def test_mutual_distances_are_those_of_both_directions(first, second):
    there, back = mutual_distances(first, second)
    np.testing.assert_array_equal(there, nearest_distances(first, second))
    np.testing.assert_array_equal(back, nearest_distances(second, first))


@given(clouds(40), st.randoms(use_true_random=False))
def test_the_order_of_points_does_not_matter(points, random):
    order = list(range(len(points)))
    random.shuffle(order)
    target = points[::-2] + 0.25
    np.testing.assert_array_equal(
        nearest_distances(points, target)[order], nearest_distances(points[order], target)
    )


@given(clouds(40))
def test_a_cloud_is_at_no_distance_from_itself(points):
    assert not nearest_distances(points, points).any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("seed", range(3))
def test_random_clouds_have_the_distances_of_scipy_and_open3d(seed, dtype):
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(3000, 3)) * [40, 20, 2]).astype(dtype)
    target = (rng.normal(size=(2000, 3)) * [30, 30, 3] + [5, 0, 0]).astype(dtype)
    found = nearest_distances(points, target)
    a, b = (
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.astype(float)))
        for cloud in (points, target)
    )
    np.testing.assert_allclose(found, cKDTree(target).query(points)[0], rtol=1e-12)
    np.testing.assert_allclose(found, a.compute_point_cloud_distance(b), rtol=1e-12)


def test_clouds_of_many_blocks_are_put_together_in_order(monkeypatch):
    rng = np.random.default_rng(0)
    points, target = rng.uniform(size=(1000, 3)), rng.uniform(size=(500, 3))
    whole = nearest_distances(points, target)
    monkeypatch.setattr(nearest, "_BLOCK", 64)
    np.testing.assert_array_equal(nearest_distances(points, target), whole)


def test_millimetres_are_kept_kilometres_from_the_origin():
    rng = np.random.default_rng(0)
    utm = np.array([500_000.0, 5_400_000.0, 300.0])
    points = rng.uniform(0, 50, size=(500, 3))
    target = points + np.array([0.0, 0.0, 0.001])
    np.testing.assert_allclose(
        nearest_distances(points + utm, target + utm), nearest_distances(points, target), atol=1e-8
    )


def test_the_clouds_are_left_as_they_are():
    points = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    before = points.copy()
    nearest_distances(points, points[:10])
    np.testing.assert_array_equal(points, before)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nan_and_infinity_are_refused(value):
    good, bad = np.zeros((5, 3)), np.zeros((5, 3))
    bad[3, 1] = value
    for pair in ((good, bad), (bad, good)):
        with pytest.raises(EvidenceError, match="NaN or infinite"):
            nearest_distances(*pair)


def test_empty_clouds_are_refused():
    for pair in ((np.zeros((0, 3)), np.zeros((2, 3))), (np.zeros((2, 3)), np.zeros((0, 3)))):
        with pytest.raises(EvidenceError, match="without points"):
            mutual_distances(*pair)
