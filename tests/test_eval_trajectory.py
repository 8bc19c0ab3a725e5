"""Trajectory metrics against closed forms, evo, and published figures."""

import os
from pathlib import Path

import numpy as np
import pytest
from eval_support import disturbed, make, winding
from evo.core import sync
from evo.core.metrics import APE, RPE, PoseRelation
from evo.core.units import Unit
from scipy.spatial.transform import Rotation

from eval import relative
from eval.association import Pairs, pair_by_index
from eval.errors import FileError
from eval.files import read_kitti, read_tum
from eval.trajectory import compare_pairs, compare_trajectories, trajectory_metrics

DATA = (
    Path(os.environ.get("LIFELONG_SLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    / "trajectories"
)
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"no recordings in {DATA}; LIFELONG_SLAM_DATA names their folder"
)


def test_errors_of_a_square_that_is_off_by_known_amounts():
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    reference = make(square)
    estimate = make([[x, y, 0.3 * (-1) ** i] for i, (x, y, _) in enumerate(square)])
    metrics = trajectory_metrics(compare_trajectories(estimate, reference))
    assert metrics["mae_m"] == metrics["mae_z_m"] == metrics["max_m"] == pytest.approx(0.3)
    assert metrics["mse_m2"] == pytest.approx(0.09)
    assert metrics["rmse_m"] == pytest.approx(0.3)
    assert metrics["mae_x_m"] == pytest.approx(0, abs=1e-12)
    assert metrics["percentiles_m"]["95"] == pytest.approx(0.3)
    assert metrics["reference_path_length_m"] == pytest.approx(3.0)
    assert metrics["kitti"] is None
    assert metrics["rpe"]["1 m"]["pairs"] == 3
    assert metrics["rpe"]["1 m"]["translation_m"]["rmse"] == pytest.approx(0.6)
    assert metrics["rpe"]["10 m"] is None
    assert metrics["rpe"]["1 s"] is None


def test_ape_and_rpe_equal_evos():
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    metrics = trajectory_metrics(comparison)
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
    ours = trajectory_metrics(comparison)["rpe"]["1 s"]
    assert ours["pairs"] == len(rpe.error)
    assert ours["translation_m"] == pytest.approx(rpe.get_all_statistics(), rel=1e-6)


def test_rpe_by_time_leaves_out_pieces_across_gaps():
    stamps = np.concatenate([np.arange(0, 3.05, 0.1), np.arange(10, 12.05, 0.1)])
    path = make(np.column_stack([stamps, 0 * stamps, 0 * stamps]), stamps=stamps)
    assert relative.rpe_by_time(path, path, 1.0)["pairs"] == 5


def test_kitti_errors_of_a_scaled_straight_drive():
    """A path that is 2 percent too long errs by 2 percent at every length, and never turns."""
    reference = make(np.arange(500)[:, None] * [1.0, 0.0, 0.0])
    estimate = make(1.02 * reference.positions_xyz)
    result = relative.kitti(estimate, reference)
    assert list(result["by_length_m"]) == ["100", "200", "300", "400"]
    # A segment ends at the first pose beyond its length, here one metre on.
    assert result["by_length_m"]["100"]["translation_percent"] == pytest.approx(2.02)
    assert result["by_length_m"]["400"]["translation_percent"] == pytest.approx(2.005)
    assert result["rotation_deg_per_m"] == pytest.approx(0, abs=1e-9)


def test_kitti_errors_of_a_steady_turn():
    """A heading that drifts 0.01 degrees a metre shows as just that."""
    reference = make(np.arange(300)[:, None] * [1.0, 0.0, 0.0])
    heading = np.arange(300)[:, None] * 0.01
    estimate = make(reference.positions_xyz, Rotation.from_euler("z", heading, degrees=True))
    by_length = relative.kitti(estimate, reference)["by_length_m"]
    assert by_length["100"]["rotation_deg_per_m"] == pytest.approx(0.01 * 101 / 100)


# files


@pytest.mark.parametrize(
    "content",
    [
        "",
        "1 2 3\n",
        "1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n",
        "1 nan 0 0 0 0 0 1\n",
        "x 0 0 0 0 0 0 1\n",
    ],
)
def test_bad_trajectory_files_are_named(tmp_path, content):
    (tmp_path / "bad.tum").write_text(content)
    with pytest.raises(FileError, match=r"bad\.tum"):
        read_tum(tmp_path / "bad.tum")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileError, match="no such trajectory"):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(FileError, match="no such trajectory"):
        read_kitti(tmp_path / "none.txt")


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
    metrics = trajectory_metrics(compare_pairs(pairs, alignment))
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
    metrics = trajectory_metrics(compare_pairs(pairs))
    assert metrics["rmse_m"] == pytest.approx(0.008119, abs=5.1e-7)


@pytest.mark.data
@needs_data
def test_fr2_desk_interpolated_is_close_to_matched():
    reference = read_tum(DATA / "fr2_desk_groundtruth.txt")
    estimate = read_tum(DATA / "fr2_desk_ORB.txt")
    metrics = trajectory_metrics(compare_trajectories(estimate, reference))
    assert metrics["rmse_m"] == pytest.approx(0.008144, abs=5e-5)
    assert metrics["warnings"] == []
