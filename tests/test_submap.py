"""The voxels of one owner: what is merged, weakened, doubted and forgotten."""

import numpy as np
import pytest

from lifelong_slam.mapping.submap import DOUBTED, HIGH, LOW, Submap, voxel_keys

VOXEL = 0.5


def voxels(points, weight=1, score=1):
    """Return the arguments of `Submap.merge` for points that lie in voxels of their own."""
    points = np.asarray(points, dtype=float)
    order = np.argsort(voxel_keys(points, VOXEL))
    points = points[order]
    count = len(points)
    return voxel_keys(points, VOXEL), points, np.full(count, weight), np.full(count, score)


def test_voxels_keep_apart_on_both_sides_of_the_origin_and_far_away():
    places = np.array([[0.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [-0.1, -0.1, -0.1], [0.1, -0.1, 0.1]])
    far = np.vstack([places, places + np.array([30_000.0, -40_000.0, 500.0])])
    assert len(np.unique(voxel_keys(far, 0.2))) == len(far)


def test_merged_means_are_weighted_by_how_much_was_measured():
    submap = Submap.empty()
    submap.merge(*voxels([[0.1, 0.1, 0.1]], weight=3))
    submap.merge(*voxels([[0.3, 0.2, 0.1]], weight=1))
    np.testing.assert_allclose(submap.means, [[0.15, 0.125, 0.1]], rtol=1e-6)
    assert submap.weights.tolist() == [4]


def test_old_measurements_fade_so_that_a_mean_follows_its_surface():
    submap = Submap.empty()
    for _ in range(5000):
        submap.merge(*voxels([[0.1, 0.1, 0.1]]))
    for _ in range(500):
        submap.merge(*voxels([[0.4, 0.1, 0.1]]))
    assert submap.means[0, 0] == pytest.approx(0.4, abs=0.005)


@pytest.mark.parametrize("seed", range(3))
def test_a_submap_is_a_table_from_voxels_to_sums(seed):
    rng = np.random.default_rng(seed)
    submap, table = Submap.empty(), {}
    for _ in range(6):
        points = rng.integers(-4, 4, (40, 3)) * VOXEL + rng.uniform(0.05, 0.45, 3)
        keys, first = np.unique(voxel_keys(points, VOXEL), return_index=True)
        weights, scores = rng.integers(1, 5, len(keys)), rng.integers(-2, 3, len(keys))
        submap.merge(keys, points[first], weights, scores)
        for key, point, weight, score in zip(keys, points[first], weights, scores, strict=True):
            total, moment, count = table.get(key, (0, np.zeros(3), 0))
            count = min(max(count + score, LOW + 1), HIGH)
            table[key] = (total + weight, moment + weight * point, count)
    assert submap.keys.tolist() == sorted(table)
    rows = [table[key] for key in submap.keys]
    assert submap.weights.tolist() == [total for total, _, _ in rows]
    assert submap.scores.tolist() == [count for _, _, count in rows]
    np.testing.assert_allclose(submap.means, [s / total for total, s, _ in rows], atol=1e-5)
    assert np.all(submap.bounds[0] <= submap.means.min(axis=0))
    assert np.all(submap.bounds[1] >= submap.means.max(axis=0))


def test_after_an_absence_what_is_gone_leaves_after_three_looks_and_what_stands_is_sure_again():
    submap = Submap.empty()
    for _ in range(HIGH):
        submap.merge(*voxels([[0.1, 0.1, 0.1], [2.1, 0.1, 0.1]]))
    submap.merge(*voxels([[4.1, 0.1, 0.1]], score=-1))
    submap.doubt()
    assert submap.scores.tolist() == [DOUBTED, DOUBTED, -1]
    for _ in range(DOUBTED + 1):
        assert submap.static[1]
        submap.weaken(np.array([0, 1, 0])[: len(submap)])
        submap.merge(*voxels([[0.1, 0.1, 0.1]]))
    assert submap.static.tolist() == [True, False, False]
    assert submap.scores[0] == DOUBTED + 3


def test_looks_count_alike_together_and_one_after_the_other():
    together, apart = Submap.empty(), Submap.empty()
    rng = np.random.default_rng(3)
    points = np.arange(30)[:, None] * [1.0, 0.0, 0.0] + 0.1
    for submap in (together, apart):
        submap.merge(*voxels(points, score=3))
    looks = rng.integers(0, 9, 30)
    together.weaken(looks)
    left = looks.copy()
    while left.any():
        once = np.minimum(left, 1)
        before = apart.keys
        apart.weaken(once)
        left = (left - once)[np.isin(before, apart.keys)]
    assert 0 < len(together) < 30
    for name, array in together.arrays().items():
        np.testing.assert_array_equal(array, apart.arrays()[name])


def test_what_stood_for_years_leaves_the_map_like_what_stood_for_a_day():
    submap = Submap.empty()
    for _ in range(1000):
        submap.merge(*voxels([[0.1, 0.1, 0.1], [2.1, 0.1, 0.1]]))
    assert submap.scores.tolist() == [HIGH, HIGH]
    gone = np.array([0, 1])
    submap.weaken(HIGH * gone)
    assert submap.static.tolist() == [True, True]
    submap.weaken(gone)
    assert submap.static.tolist() == [True, False]
    for _ in range(-LOW - 1):
        submap.weaken(gone)
    np.testing.assert_allclose(submap.means, [[0.1, 0.1, 0.1]], rtol=1e-6)  # forgotten for good


def test_a_submap_comes_back_from_its_arrays_even_from_bytes_that_cant_be_written():
    submap = Submap.empty()
    submap.merge(*voxels([[0.1, 0.1, 0.1], [7.1, 0.1, 0.1]], weight=2))
    saved = {n: np.frombuffer(a.tobytes(), a.dtype) for n, a in submap.arrays().items()}
    again = Submap(**saved | {"means": saved["means"].reshape(-1, 3)})
    for one in (submap, again):
        one.merge(*voxels([[0.2, 0.2, 0.2], [-3.0, 0.1, 0.1]]))
    for name, values in submap.arrays().items():
        np.testing.assert_array_equal(values, again.arrays()[name])
    np.testing.assert_array_equal(submap.bounds, again.bounds)


def test_arrays_that_dont_make_a_submap_are_refused():
    submap = Submap.empty()
    submap.merge(*voxels([[0.1, 0.1, 0.1], [7.1, 0.1, 0.1]]))
    with pytest.raises(ValueError, match="one length"):
        Submap(**submap.arrays() | {"scores": submap.scores[:1]})
    with pytest.raises(ValueError, match="ascend"):
        Submap(**submap.arrays() | {"keys": submap.keys[::-1]})
