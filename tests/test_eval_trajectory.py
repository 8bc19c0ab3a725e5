"""Trajectory metrics against closed forms, evo, and published figures."""

import os
from pathlib import Path

import numpy as np
import pytest
from eval_support import disturbed, make, values_of, winding
from evo.core import sync
from evo.core.metrics import APE, RPE, PoseRelation
from evo.core.units import Unit
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from eval.association import Pairs, pair_by_index
from eval.errors import EvalError, MetricError
from eval.evidence import Evidence
from eval.metrics.metric import Metric
from eval.metrics.trajectory import (
    Coverage,
    KittiErrors,
    PathLength,
    PositionError,
    RelativePoseError,
    RotationError,
)
from eval.relative import over_distance, over_time
from eval.trajectory import compare_pairs, compare_trajectories
from eval.trajectory_files import read_kitti, read_tum

METRICS = (
    PositionError(),
    RotationError(),
    RelativePoseError(),
    KittiErrors(),
    PathLength(),
    Coverage(),
)
DATA = (
    Path(os.environ.get("LIFELONG_SLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    / "trajectories"
)
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"no recordings in {DATA}; LIFELONG_SLAM_DATA names their folder"
)


def all_values(comparison):
    evidence = {"comparison": comparison, "estimate": comparison.pairs.estimate}
    return {
        key: value for metric in METRICS for key, value in values_of(metric, **evidence).items()
    }


def test_errors_of_a_square_that_is_off_by_known_amounts():
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    reference = make(square)
    estimate = make([[x, y, 0.3 * (-1) ** i] for i, (x, y, _) in enumerate(square)])
    metrics = all_values(compare_trajectories(estimate, reference))
    assert metrics["mae_m"] == metrics["mae_z_m"] == metrics["max_m"] == pytest.approx(0.3)
    assert metrics["mse_m2"] == pytest.approx(0.09)
    assert metrics["rmse_m"] == pytest.approx(0.3)
    assert metrics["mae_x_m"] == pytest.approx(0, abs=1e-12)
    assert metrics["percentiles_m"]["95"] == pytest.approx(0.3)
    assert metrics["reference_path_length_m"] == pytest.approx(3.0)
    assert metrics["path_length_m"] == pytest.approx(3 * np.hypot(1, 0.6))
    assert metrics["poses"]["matched"] == 4
    assert metrics["coverage"] == 1
    assert metrics["alignment"]["scale"] == 1
    assert metrics["kitti"] is None
    assert metrics["rpe"]["1 m"]["pairs"] == 3
    assert metrics["rpe"]["1 m"]["translation_m"]["rmse"] == pytest.approx(0.6)
    assert metrics["rpe"]["10 m"] is None
    assert metrics["rpe"]["1 s"] is None


def test_ape_and_rpe_equal_evos():
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    metrics = all_values(comparison)
    pair = (comparison.reference, comparison.estimate)
    for key, relation in (
        ("ape_translation_m", PoseRelation.translation_part),
        ("ape_rotation_deg", PoseRelation.rotation_angle_deg),
    ):
        ape = APE(relation)
        ape.process_data(pair)
        assert metrics[key] == pytest.approx(ape.get_all_statistics(), rel=1e-7)
    for delta in (1.0, 10.0):
        for key, relation in (
            ("translation_m", PoseRelation.translation_part),
            ("rotation_deg", PoseRelation.rotation_angle_deg),
        ):
            rpe = RPE(relation, delta, Unit.meters, pairs_from_reference=True)
            rpe.process_data(pair)
            ours = metrics["rpe"][f"{delta:g} m"][key]
            assert ours == pytest.approx(rpe.get_all_statistics(), rel=1e-6, abs=1e-9)


def test_rpe_over_a_second_equals_evos_over_ten_frames_at_ten_hertz():
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    rpe = RPE(PoseRelation.translation_part, 10, Unit.frames)
    rpe.process_data((comparison.reference, comparison.estimate))
    ours = values_of(RelativePoseError(), comparison=comparison)["rpe"]["1 s"]
    assert ours["pairs"] == len(rpe.error)
    assert ours["translation_m"] == pytest.approx(rpe.get_all_statistics(), rel=1e-6)


@given(st.integers(0, 10_000), st.floats(0.5, 40))
def test_pieces_of_a_length_are_evos(seed, delta):
    reference = winding(100, seed=seed)
    estimate = disturbed(reference, seed=seed)
    rpe = RPE(PoseRelation.translation_part, delta, Unit.meters, pairs_from_reference=True)
    rpe.process_data((reference, estimate))
    np.testing.assert_allclose(over_distance(estimate, reference, delta).translation, rpe.error)


def test_ten_steps_of_a_tenth_are_a_metre():
    """Where a sum of rounded steps falls short of the metre by less than it can know."""
    path = make(np.arange(101)[:, None] * [0.1, 0.0, 0.0])
    assert over_distance(path, path, 1.0).last.tolist() == list(range(10, 101, 10))


def test_rpe_by_time_leaves_out_pieces_across_gaps():
    stamps = np.concatenate([np.arange(0, 3.05, 0.1), np.arange(10, 12.05, 0.1)])
    path = make(np.column_stack([stamps, 0 * stamps, 0 * stamps]), stamps=stamps)
    assert len(over_time(path, path, 1.0).first) == 5


def test_rpe_does_not_depend_on_the_alignment():
    reference = winding()
    estimate = disturbed(reference)
    aligned, raw = (
        values_of(RelativePoseError(), comparison=compare_trajectories(estimate, reference, how))
        for how in ("se3", "none")
    )
    for delta, errors in aligned["rpe"].items():
        for key in ("translation_m", "rotation_deg"):
            assert raw["rpe"][delta][key] == pytest.approx(errors[key])


def test_rpe_takes_the_lengths_it_is_given():
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    metric = RelativePoseError(metres=[5], seconds=[])
    assert list(values_of(metric, comparison=comparison)["rpe"]) == ["5 m"]
    assert "5 m" in metric.meaning
    metric = RelativePoseError(metres=[], seconds=[2, 3])
    measured = metric.measure(Evidence(comparison=comparison))
    assert measured.headline == measured.values["rpe"]["2 s"]["translation_m"]["rmse"]


@pytest.mark.parametrize("lengths", [{"metres": [0]}, {"metres": [], "seconds": []}])
def test_rpe_over_nothing_is_refused(lengths):
    with pytest.raises(MetricError, match="0\\.001"):
        RelativePoseError(**lengths)


def test_percentiles_are_those_asked_for():
    with pytest.raises(MetricError, match="0 to 100"):
        PositionError(percentiles=[101])
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    values = values_of(PositionError(percentiles=[0, 100]), comparison=comparison)
    assert values["percentiles_m"]["100"] == values["max_m"]
    assert list(values["percentiles_m"]) == ["0", "100"]


def kitti_errors(estimate, reference):
    comparison = compare_trajectories(estimate, reference, "none")
    return values_of(KittiErrors(), comparison=comparison)["kitti"]


def test_kitti_errors_of_a_scaled_straight_drive():
    """A path that is 2 percent too long errs by 2 percent at every length, and never turns."""
    reference = make(np.arange(500)[:, None] * [1.0, 0.0, 0.0])
    result = kitti_errors(make(1.02 * reference.positions_xyz), reference)
    assert list(result["by_length_m"]) == ["100", "200", "300", "400"]
    # A segment ends at the first pose beyond its length, here one metre on.
    assert result["by_length_m"]["100"]["translation_percent"] == pytest.approx(2.02)
    assert result["by_length_m"]["400"]["translation_percent"] == pytest.approx(2.005)
    assert result["by_length_m"]["100"]["segments"] == 40
    assert result["segments"] == sum(n["segments"] for n in result["by_length_m"].values())
    assert result["rotation_deg_per_m"] == pytest.approx(0, abs=1e-9)


def test_kitti_errors_of_a_steady_turn():
    """A heading that drifts 0.01 degrees a metre shows as just that."""
    reference = make(np.arange(300)[:, None] * [1.0, 0.0, 0.0])
    heading = np.arange(300)[:, None] * 0.01
    estimate = make(reference.positions_xyz, Rotation.from_euler("z", heading, degrees=True))
    by_length = kitti_errors(estimate, reference)["by_length_m"]
    assert by_length["100"]["rotation_deg_per_m"] == pytest.approx(0.01 * 101 / 100)


# the contract of metrics


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: metric.name)
def test_trajectory_metrics_keep_the_contract(metric):
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    evidence = Evidence(estimate=comparison.pairs.estimate, comparison=comparison)
    assert isinstance(metric, Metric)
    assert all(getattr(evidence, need) is not None for need in metric.needs)
    measured = metric.measure(evidence)
    assert set(measured.values) == set(metric.keys)
    assert isinstance(measured.headline, float)
    assert np.isfinite(measured.headline)
    assert all(values.ndim == 1 for values in measured.samples.values())
    for plot in measured.plots:
        assert plot.curves
        assert all(len(curve.x) == len(curve.y) > 1 for curve in plot.curves)


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: metric.name)
def test_without_evidence_a_metric_says_why_there_is_nothing(metric):
    with pytest.raises(EvalError, match=r"there is no|no overlap"):
        metric.measure(Evidence(reasons={"comparison": "no overlap"}))


def test_keys_are_given_once():
    keys = [key for metric in METRICS for key in metric.keys]
    assert len(keys) == len(set(keys))


def test_samples_are_what_the_values_sum_up():
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    measured = PositionError().measure(Evidence(comparison=comparison))
    samples = measured.samples
    assert samples["error_m"].mean() == pytest.approx(measured.headline)
    assert np.abs(samples["y_m"]).mean() == pytest.approx(measured.values["mae_y_m"])
    axes = np.stack([samples[f"{axis}_m"] for axis in "xyz"])
    np.testing.assert_allclose(np.linalg.norm(axes, axis=0), samples["error_m"])


def test_a_path_has_a_length_without_a_reference():
    values = values_of(PathLength(), estimate=make([[0, 0, 0], [3, 4, 0]]))
    assert values == {"path_length_m": 5.0, "poses": {"estimated": 2}}


# published figures


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    ("name", "alignment", "rmse"),
    [
        ("ORB", "se3", 1.303450),
        ("SPTAM", "se3", 3.738488),
        ("ORB", "none", 7.790289),
        ("SPTAM", "none", 9.224542),
        ("ORB", "sim3", 0.937709),
        ("SPTAM", "sim3", 3.635294),
    ],
)
def test_kitti_00_has_evos_figures(name, alignment, rmse):
    reference = read_kitti(DATA / "KITTI_00_gt.txt")
    pairs = pair_by_index(read_kitti(DATA / f"KITTI_00_{name}.txt"), reference)
    metrics = all_values(compare_pairs(pairs, alignment))
    assert metrics["rmse_m"] == pytest.approx(rmse, abs=5.1e-7)
    assert metrics["reference_path_length_m"] == pytest.approx(3724.187, abs=0.01)
    assert list(metrics["kitti"]["by_length_m"]) == [str(n) for n in range(100, 900, 100)]
    assert "1 s" not in metrics["rpe"]


@pytest.mark.data
@needs_data
def test_fr2_desk_has_evos_figure_with_evos_matching():
    reference = read_tum(DATA / "fr2_desk_groundtruth.txt")
    estimate = read_tum(DATA / "fr2_desk_ORB.txt")
    matched, own = sync.associate_trajectories(reference, estimate)
    pairs = Pairs(own, matched, True, estimate.num_poses, 0, 0, 0, 1.0)
    metrics = values_of(PositionError(), comparison=compare_pairs(pairs))
    assert metrics["rmse_m"] == pytest.approx(0.008119, abs=5.1e-7)


@pytest.mark.data
@needs_data
def test_fr2_desk_interpolated_is_close_to_matched():
    reference = read_tum(DATA / "fr2_desk_groundtruth.txt")
    estimate = read_tum(DATA / "fr2_desk_ORB.txt")
    measured = PositionError().measure(
        Evidence(comparison=compare_trajectories(estimate, reference))
    )
    assert measured.values["rmse_m"] == pytest.approx(0.008144, abs=5e-5)
    assert measured.warnings == ()
