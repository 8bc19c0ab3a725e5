"""Metrics of maps: closed forms, properties, published distances, and maps that can't be judged."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import cdist, directed_hausdorff

from eval.errors import EvidenceError, MetricError
from eval.evidence import Evidence
from eval.map_files import read_map
from eval.metrics import map as map_metrics
from eval.metrics import map_consistency
from eval.metrics.map import Chamfer, FScore, Hausdorff, MapDistance, MapExtent
from eval.metrics.map_consistency import MapConsistency, surrounding_variances
from eval.nearest import mutual_distances
from eval.testing import check_metric

DATA = Path(__file__).resolve().parents[1] / os.environ.get("LIFELONG_SLAM_DATA", "../shared/data")
COMPARING = (MapDistance, Hausdorff, Chamfer, FScore)
METRICS = (*COMPARING, MapExtent, MapConsistency)

clouds = st.integers(1, 30).flatmap(
    lambda n: arrays(np.float64, (n, 3), elements=st.floats(-100, 100, width=32))
)


def plane(side=5.0, step=0.1, height=0.0):
    """Points on a horizontal plane from 0 to `side` along x and y."""
    along = np.arange(0, side + step / 2, step)
    x, y = (axis.ravel() for axis in np.meshgrid(along, along))
    return np.column_stack([x, y, np.full_like(x, height)])


def moved(points, x=0.0, y=0.0, z=0.0):
    return points + np.array([x, y, z])


def measure(metric, points, reference=None):
    return metric.measure(Evidence(map=points, reference_map=reference))


def values(points, reference):
    """The values of all metrics that compare two maps."""
    found = {}
    for metric in COMPARING:
        found |= measure(metric(), points, reference).values
    return found


@pytest.mark.parametrize("metric", METRICS)
def test_metrics_keep_the_contract(metric):
    check_metric(metric())


# Two maps


def test_parallel_planes_are_their_distance_apart():
    low, high = plane(), plane(height=0.15)
    found = values(high, low)
    both = {"map_to_reference": 0.15, "reference_to_map": 0.15, "symmetric": 0.15}
    assert found["mean_distance_m"] == pytest.approx(both)
    assert found["hausdorff_m"] == pytest.approx(both)
    assert found["chamfer_m2"] == pytest.approx(2 * 0.15**2)
    assert found["distance_percentiles_m"]["map_to_reference"]["95"] == pytest.approx(0.15)
    assert found["f_score_percent"] == {"0.05_m": 0.0, "0.1_m": 0.0, "0.2_m": 100.0}


def test_what_the_map_lacks_shows_from_the_reference_alone():
    # Columns x = 0, 1, 2, 3 m; the map has the first two.
    whole = plane(side=3.0, step=1.0)
    half = whole[whole[:, 0] < 1.5]
    found = values(half, whole)
    assert found["mean_distance_m"] == {
        "map_to_reference": 0.0,
        "reference_to_map": pytest.approx((0 + 0 + 1 + 2) / 4),
        "symmetric": pytest.approx(3 / 8),
    }
    assert found["hausdorff_m"] == {
        "map_to_reference": 0.0,
        "reference_to_map": 2.0,
        "symmetric": 2.0,
    }
    assert found["chamfer_m2"] == pytest.approx((1 + 4) / 4)
    assert found["accuracy_percent"]["0.2_m"] == 100.0
    assert found["completeness_percent"]["0.2_m"] == 50.0
    assert found["f_score_percent"]["0.2_m"] == pytest.approx(200 * 0.5 / 1.5)


def test_a_shifted_grid_of_points_scores_where_it_overlaps():
    # Shifted by 3 of 10 steps along x: 7 of 10 columns still meet a point.
    points = plane(side=9.0, step=1.0)
    found = measure(FScore([0.1, 5.0]), moved(points, x=3.0), points)
    assert found.values["accuracy_percent"] == pytest.approx({"0.1_m": 70.0, "5_m": 100.0})
    assert found.values["f_score_percent"] == pytest.approx({"0.1_m": 70.0, "5_m": 100.0})


def test_the_headline_of_the_f_score_is_at_the_middle_threshold():
    low, high = plane(), plane(height=0.15)
    assert measure(FScore([0.2, 0.05, 0.1]), high, low).headline == 0.0
    assert measure(FScore([0.2, 0.16, 0.1]), high, low).headline == 100.0
    assert "0.16 m" in FScore([0.2, 0.16, 0.1]).meaning


@given(clouds)
def test_a_map_is_like_itself(points):
    found = values(points, points.copy())
    for key in ("mean_distance_m", "hausdorff_m"):
        assert set(found[key].values()) == {0.0}
    assert found["chamfer_m2"] == 0.0
    assert set(found["f_score_percent"].values()) == {100.0}


@given(clouds, clouds)
def test_swapping_the_maps_swaps_the_directions(first, second):
    one, other = values(first, second), values(second, first)
    for key in ("mean_distance_m", "hausdorff_m"):
        assert one[key]["symmetric"] == other[key]["symmetric"]
        assert one[key]["map_to_reference"] == other[key]["reference_to_map"]
    assert one["chamfer_m2"] == other["chamfer_m2"]
    assert one["accuracy_percent"] == other["completeness_percent"]
    assert one["f_score_percent"] == other["f_score_percent"]


@given(clouds, clouds)
def test_moving_both_maps_changes_nothing(first, second):
    shift = np.array([4096.0, -512.0, 64.0])
    one, other = values(first, second), values(first + shift, second + shift)
    for key in ("mean_distance_m", "hausdorff_m"):
        assert one[key] == pytest.approx(other[key], abs=1e-9)
    assert one["chamfer_m2"] == pytest.approx(other["chamfer_m2"], abs=1e-6)


@given(clouds, clouds)
def test_values_are_those_of_brute_force(points, reference):
    found, table = values(points, reference), cdist(points, reference)
    there, back = table.min(axis=1), table.min(axis=0)
    assert found["mean_distance_m"]["map_to_reference"] == pytest.approx(there.mean())
    assert found["mean_distance_m"]["reference_to_map"] == pytest.approx(back.mean())
    assert found["chamfer_m2"] == pytest.approx((there**2).mean() + (back**2).mean())
    for key, a, b in (
        ("map_to_reference", points, reference),
        ("reference_to_map", reference, points),
    ):
        assert found["hausdorff_m"][key] == pytest.approx(directed_hausdorff(a, b)[0])


def test_samples_are_the_distances_in_the_order_of_the_map():
    reference = plane()
    points = reference[::7] + np.arange(len(reference[::7]))[:, None] * [0.0, 0.0, 0.001]
    samples = measure(MapDistance(), points, reference).samples["distance_m"]
    np.testing.assert_allclose(samples, np.arange(len(points)) * 0.001, atol=1e-12)


def test_the_plot_is_a_cumulative_distribution():
    rng = np.random.default_rng(0)
    points = plane() + rng.normal(size=(51 * 51, 3)) * 0.02
    (plot,) = measure(MapDistance(), points, plane()).plots
    distances = mutual_distances(points, plane())
    for curve, expected in zip(plot.curves, distances, strict=True):
        for x, share in zip(curve.x[::20], curve.y[::20], strict=True):
            assert 100 * np.mean(expected <= x) == pytest.approx(share, abs=0.1)


def test_distances_are_computed_once_for_all_metrics(monkeypatch):
    calls = []

    def counted(*clouds):
        calls.append(clouds)
        return mutual_distances(*clouds)

    monkeypatch.setattr(map_metrics, "mutual_distances", counted)
    evidence, other = (Evidence(map=plane(), reference_map=plane(height=h)) for h in (0.1, 0.2))
    for metric in COMPARING:
        metric().measure(evidence)
    assert len(calls) == 1
    assert MapDistance().measure(other).headline == pytest.approx(0.2)


@pytest.mark.data
def test_two_scans_have_their_known_distances():
    folder = DATA / "maps"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there (LIFELONG_SLAM_DATA names the data folder)")
    T_target_source = np.loadtxt(folder / "T_target_source.txt")
    source, target = read_map(folder / "source.ply"), read_map(folder / "target.ply")
    there = source @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    found = values(there, target)
    assert found["mean_distance_m"]["map_to_reference"] == pytest.approx(0.13332, abs=5e-6)
    assert found["mean_distance_m"]["reference_to_map"] == pytest.approx(0.13549, abs=5e-6)
    assert found["hausdorff_m"]["symmetric"] == pytest.approx(25.449, abs=5e-4)


# One map


def test_the_extent_is_that_of_the_points():
    points = np.array([[1, 2, 3], [4, -2, 3], [2, 0, 9]], dtype=np.float32)
    assert measure(MapExtent(), points).values == {
        "points": 3,
        "min_m": [1.0, -2.0, 3.0],
        "max_m": [4.0, 2.0, 9.0],
        "extent_m": [3.0, 4.0, 6.0],
    }


def test_a_thick_plane_is_as_thick_as_its_noise():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 10, size=(60_000, 3))
    points[:, 2] = rng.normal(size=len(points)) * 0.03
    found = measure(MapConsistency(), points)
    assert found.headline == pytest.approx(2 * 0.03, rel=0.03)
    assert found.values["mean_plane_variance_m2"] == pytest.approx(0.03**2, rel=0.05)


def test_a_double_wall_is_thicker_than_a_single_one():
    one = plane(side=10.0)
    shifted = np.vstack([one, moved(one, 0.03, 0.04, 0.2)])
    single, double = (measure(MapConsistency(), points).values for points in (one, shifted))
    assert single["thickness_m"] == pytest.approx(2e-4)  # the least that counts
    assert double["thickness_m"] == pytest.approx(0.2, rel=0.02)  # two deviations of +-0.1 m
    assert double["mean_map_entropy_nats"] > single["mean_map_entropy_nats"]


def test_entropy_is_that_of_the_points_around():
    points = np.random.default_rng(0).normal(size=(40, 3))
    found = measure(MapConsistency(radius=100.0), points)
    covariance = np.cov(points.T, bias=True)
    entropy = np.log(np.linalg.det(2 * np.pi * np.e * covariance)) / 2
    assert found.values["mean_map_entropy_nats"] == pytest.approx(entropy)
    assert found.values["consistency_samples"] == 40


def test_variances_are_those_of_one_neighbourhood_after_the_other(monkeypatch):
    points = moved(np.random.default_rng(0).normal(size=(400, 3)), 5e5, 5e6)
    expected = []
    for sample in points[::3]:
        around = points[np.linalg.norm(points - sample, axis=1) <= 0.8]
        if len(around) >= 10:
            expected.append(np.linalg.eigvalsh(np.cov(around.T, bias=True)))
    assert 0 < len(expected) < len(points[::3])
    monkeypatch.setattr(map_consistency, "_MOST_NEIGHBOURS", 100)
    found = surrounding_variances(points[::3], points, 0.8, 10)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_large_maps_are_judged_by_samples_spread_over_them(monkeypatch):
    monkeypatch.setattr(map_consistency, "_MOST_SAMPLES", 100)
    points = plane(side=10.0)
    found = measure(MapConsistency(), points)
    assert 90 <= found.values["consistency_samples"] <= 100


# Maps that can't be judged, or hardly


@pytest.mark.parametrize("metric", COMPARING)
def test_empty_maps_are_said_to_be_empty(metric):
    with pytest.raises(EvidenceError, match="the map is empty"):
        measure(metric(), plane()[:0], plane())
    with pytest.raises(EvidenceError, match="the reference map is empty"):
        measure(metric(), plane(), plane()[:0])


def test_an_empty_map_has_no_extent_and_says_so():
    found = measure(MapExtent(), plane()[:0])
    assert found.values == {"points": 0, "min_m": None, "max_m": None, "extent_m": None}
    assert found.warnings == ("the map is empty",)
    with pytest.raises(EvidenceError, match="the map is empty"):
        measure(MapConsistency(), plane()[:0])


@pytest.mark.parametrize("metric", METRICS)
def test_maps_with_nan_are_refused(metric):
    points = plane()
    points[3, 2] = np.nan
    with pytest.raises(EvidenceError, match="NaN"):
        measure(metric(), points, plane())


@pytest.mark.parametrize("metric", COMPARING)
def test_tiny_maps_are_doubtful(metric):
    assert measure(metric(), plane(), plane()).warnings == ()
    assert measure(metric(), plane()[:3], plane()).warnings == ("the map has only 3 points",)
    (warning,) = measure(metric(), plane(), plane()[:1]).warnings
    assert warning == "the reference map has only 1 points"


@pytest.mark.parametrize("metric", COMPARING)
def test_maps_kilometres_apart_may_be_of_different_frames(metric):
    (warning,) = measure(metric(), moved(plane(), x=5000.0), plane()).warnings
    assert "4997 m" in warning or "4998 m" in warning
    assert "are both in one frame?" in warning


@pytest.mark.parametrize("metric", COMPARING)
def test_a_map_of_a_part_of_the_place_is_no_reason_for_doubt(metric):
    whole = plane(side=100.0, step=1.0)
    assert measure(metric(), whole[whole[:, 0] < 5.0], whole).warnings == ()


def test_a_map_too_sparse_for_its_surfaces_is_not_judged():
    sparse = plane(side=50.0, step=1.0)
    with pytest.raises(EvidenceError, match=r"15 neighbours within 0\.5 m"):
        measure(MapConsistency(), sparse)
    mixed = np.vstack([sparse, moved(plane(side=2.0), z=20.0)])
    (warning,) = measure(MapConsistency(), mixed).warnings
    assert "too sparse" in warning


@pytest.mark.parametrize(
    ("metric", "settings"),
    [
        (MapDistance, {"percentiles": [50, 101]}),
        (FScore, {"thresholds": []}),
        (FScore, {"thresholds": [0.1, 0.0]}),
        (MapConsistency, {"radius": 0.0}),
        (MapConsistency, {"min_neighbours": 3}),
    ],
)
def test_settings_without_sense_are_refused(metric, settings):
    with pytest.raises(MetricError):
        metric(**settings)
