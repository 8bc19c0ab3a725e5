"""Association and alignment of trajectories."""

import re

import numpy as np
import pytest
from eval_support import disturbed, make, values_of, winding
from evo.core.geometry import umeyama_alignment
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from eval.alignment import align, kabsch
from eval.association import associate, pair_by_index
from eval.errors import AlignmentError, AssociationError
from eval.evidence import Evidence
from eval.metrics.trajectory import Coverage, PositionError, RotationError
from eval.trajectory import compare_trajectories


def test_reference_is_interpolated_at_the_estimates_stamps():
    reference = make([[0, 0, 0], [1, 0, 0], [2, 0, 0]], stamps=[0.0, 0.1, 0.2])
    estimate = make(np.zeros((4, 3)), stamps=[0.0, 0.05, 0.1, 0.175])
    pairs = associate(estimate, reference)
    np.testing.assert_allclose(pairs.reference.positions_xyz[:, 0], [0, 0.5, 1, 1.75])
    assert pairs.coverage == pytest.approx(0.875)


def test_orientation_is_interpolated_along_the_arc():
    turns = Rotation.from_euler("z", [[0], [90], [180]], degrees=True)
    reference = make(np.zeros((3, 3)), turns, [0.0, 0.1, 0.2])
    pairs = associate(make(np.zeros((3, 3)), stamps=[0.0, 0.05, 0.15]), reference)
    got = Rotation.from_quat(np.roll(pairs.reference.orientations_quat_wxyz, -1, axis=1))
    np.testing.assert_allclose(got.as_euler("zyx", degrees=True)[:, 0], [0, 45, 135], atol=1e-9)


def test_poses_outside_in_gaps_and_repeated_are_dropped_and_counted():
    stamps = np.concatenate([np.arange(0, 1.05, 0.1), np.arange(2.0, 3.05, 0.1)])
    reference = make(np.column_stack([stamps, stamps, stamps]), stamps=stamps)
    own = [-1.0, 0.0, 0.5, 0.5, 0.55, 1.0, 1.5, 2.0, 2.95, 3.5]
    pairs = associate(make(np.zeros((10, 3)), stamps=own), reference, max_gap=0.25)
    assert (pairs.outside, pairs.in_gaps, pairs.repeated, pairs.estimated) == (2, 1, 1, 10)
    np.testing.assert_allclose(pairs.estimate.timestamps, [0, 0.5, 0.55, 1.0, 2.0, 2.95])
    np.testing.assert_allclose(pairs.reference.positions_xyz[:, 0], pairs.estimate.timestamps)


def test_equal_stamps_match_however_sparse_the_reference():
    reference = make(np.eye(3), stamps=[0, 10, 20])
    assert associate(make(np.eye(3), stamps=[0, 10, 20]), reference).estimate.num_poses == 3


@pytest.mark.parametrize(
    ("stamps", "message"),
    [([100, 101, 102], "0 of 3 poses lie within"), ([0.5, 1.5, 2.5], "1.000 s apart")],
)
def test_too_few_matches_are_an_error_that_says_why(stamps, message):
    reference = make(np.zeros((5, 3)), stamps=np.arange(5))
    with pytest.raises(AssociationError, match=message):
        associate(make(np.zeros((3, 3)), stamps=stamps), reference)


def test_a_reference_of_one_pose_is_an_error():
    with pytest.raises(AssociationError, match="at least two"):
        associate(make(np.zeros((3, 3))), make(np.zeros((1, 3))))


def test_a_reference_that_stands_still_in_time_is_an_error():
    with pytest.raises(AssociationError, match="different instants"):
        associate(make(np.zeros((3, 3))), make(np.zeros((3, 3)), stamps=[1.0, 1.0, 1.0]))


@pytest.mark.parametrize("back", [0, 1])
def test_stamps_that_run_back_are_an_error(back):
    pair = [make(np.zeros((4, 3))), make(np.zeros((4, 3)))]
    pair[back] = make(np.zeros((4, 3)), stamps=[0.0, 0.2, 0.1, 0.3])
    with pytest.raises(AssociationError, match="order of time"):
        associate(*pair)


def test_too_sparse_a_reference_is_called_so_beside_poses_that_match_exactly():
    reference = make(np.zeros((5, 3)), stamps=np.arange(5))
    with pytest.raises(AssociationError, match=r"1\.000 s apart"):
        associate(make(np.zeros((4, 3)), stamps=[0.0, 1.0, 1.5, 2.5]), reference)


def test_poses_without_stamps_need_equal_counts():
    with pytest.raises(AssociationError, match="4 estimated, 3 in the reference"):
        pair_by_index(make(np.zeros((4, 3))), make(np.zeros((3, 3))))


# alignment


@given(st.integers(0, 10_000))
def test_kabsch_recovers_a_known_similarity(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(10, 3)) * 50
    R, t = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 100
    scale = float(rng.uniform(0.2, 5))
    found = kabsch(points, scale * points @ R.T + t, with_scale=True)
    np.testing.assert_allclose(found[0], R, atol=1e-9)
    np.testing.assert_allclose(found[1], t, atol=1e-8)
    assert found[2] == pytest.approx(scale)


@given(st.integers(0, 10_000), st.booleans())
def test_kabsch_agrees_with_evo(seed, with_scale):
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, 12, 3))
    ours = kabsch(source, target, with_scale)
    for a, b in zip(ours, umeyama_alignment(source.T, target.T, with_scale), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_kabsch_never_mirrors():
    points = np.random.default_rng(0).normal(size=(20, 3))
    R, *_ = kabsch(points, points * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1)


@pytest.mark.parametrize("method", ["se3", "sim3", "first_pose"])
def test_rigid_motion_is_undone(method):
    reference = winding()
    comparison = compare_trajectories(disturbed(reference, size=0), reference, method)
    # The wobble in orientation turns a first-pose alignment, and nothing else.
    assert comparison.errors.max() < (10 if method == "first_pose" else 1e-9)
    if method == "first_pose":
        assert comparison.errors[0] < 1e-9


def test_yaw_alignment_keeps_the_estimates_tilt():
    reference = winding()
    turn = Rotation.from_euler("z", 1.2)
    quaternions = np.roll(reference.orientations_quat_wxyz, -1, axis=1)
    turned = make(
        turn.apply(reference.positions_xyz) + np.array([1, 2, 3]),
        turn * Rotation.from_quat(quaternions),
        reference.timestamps,
    )
    comparison = compare_trajectories(turned, reference, "yaw")
    assert values_of(PositionError(), comparison=comparison)["max_m"] < 1e-9
    angles = values_of(RotationError(), comparison=comparison)["ape_rotation_deg"]
    assert angles["max"] < 1e-6
    tilted = make(
        Rotation.from_euler("x", 0.1).apply(turned.positions_xyz), None, turned.timestamps
    )
    assert compare_trajectories(tilted, reference, "yaw").errors.max() > 1


def test_no_alignment_leaves_positions_alone():
    reference = winding()
    moved = make(reference.positions_xyz + np.array([1, 2, 2]), stamps=reference.timestamps)
    np.testing.assert_allclose(compare_trajectories(moved, reference, "none").errors, 3.0)


def test_more_freedom_never_fits_worse():
    reference = winding()
    estimate = disturbed(reference)
    rmse = {
        method: np.sqrt((compare_trajectories(estimate, reference, method).errors ** 2).mean())
        for method in ("none", "first_pose", "yaw", "se3", "sim3")
    }
    assert rmse["sim3"] <= rmse["se3"] <= min(rmse["yaw"], rmse["first_pose"], rmse["none"])


def test_unknown_alignment_lists_the_known_ones():
    reference = winding(10)
    with pytest.raises(AlignmentError, match=r"'se2'.*none, first_pose, se3"):
        align(reference, reference, "se2")


def test_a_straight_line_leaves_roll_free_and_says_so():
    reference = make(np.arange(50)[:, None] * [1.0, 0.0, 0.0])
    rolled = make(reference.positions_xyz, Rotation.from_euler("x", np.full((50, 1), 0.5)))
    comparison = compare_trajectories(rolled, reference)
    assert comparison.errors.max() < 1e-9
    assert any("roll" in warning for warning in comparison.alignment.warnings)


def test_standing_still_leaves_rotation_free_and_says_so():
    still = make(np.zeros((10, 3)))
    warnings = compare_trajectories(still, still).alignment.warnings
    assert any("hardly moves" in warning for warning in warnings)
    with pytest.raises(AlignmentError, match="no scale"):
        compare_trajectories(still, still, "sim3")


def test_kilometres_of_alignment_are_suspicious():
    reference = winding()
    far = make(reference.positions_xyz + np.array([400_000, 0, 0]), stamps=reference.timestamps)
    assert "400.0 km" in " ".join(compare_trajectories(far, reference).alignment.warnings)


@pytest.mark.parametrize("method", ["se3", "sim3", "yaw", "first_pose"])
def test_a_long_drive_with_another_heading_is_not_suspicious(method):
    path = winding(count=3000, rate=1.0)
    turn = Rotation.from_euler("z", 3.0)
    turned = make(turn.apply(path.positions_xyz), None, path.timestamps)
    reference = make(path.positions_xyz, None, path.timestamps)
    assert np.linalg.norm(turned.positions_xyz - reference.positions_xyz, axis=1).mean() > 1000
    warnings = compare_trajectories(turned, reference, method, max_gap=2.0).warnings
    assert not any("km" in warning for warning in warnings)


def test_an_estimate_that_stands_still_while_the_reference_moves_is_doubtful():
    reference = winding()
    still = make(np.zeros((reference.num_poses, 3)), stamps=reference.timestamps)
    assert "as large as the path" in " ".join(compare_trajectories(still, reference).warnings)


def test_little_overlap_is_doubtful():
    reference = winding()
    late = make(reference.positions_xyz, stamps=reference.timestamps + 30)
    warnings = compare_trajectories(late, reference).warnings
    assert "only 100 of 400 estimated poses were compared: 300 lie outside" in " ".join(warnings)
    assert "covers only 25 % of the reference's duration" in " ".join(warnings)


def test_a_handful_of_poses_is_doubtful():
    reference = winding(9)
    assert "only 9 poses" in " ".join(compare_trajectories(reference, reference).warnings)


@pytest.mark.parametrize("metric", [PositionError(), RotationError(), Coverage()])
def test_what_makes_a_comparison_doubtful_is_said_with_its_errors(metric):
    reference = winding()
    far = make(reference.positions_xyz + np.array([400_000, 0, 0]), stamps=reference.timestamps)
    warnings = metric.measure(Evidence(comparison=compare_trajectories(far, reference))).warnings
    assert any("400.0 km" in warning for warning in warnings)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("method", ["none", "se3"])
def test_what_is_no_number_is_never_aligned(value, method):
    reference = winding(10)
    broken = make(np.where(np.eye(10, 3) > 0, value, reference.positions_xyz))
    with pytest.raises(AlignmentError, match="NaN"):
        compare_trajectories(broken, reference, method)


def test_a_good_run_has_no_warnings():
    reference = winding()
    assert compare_trajectories(disturbed(reference), reference).warnings == ()


# mirror images, and paths in or near a plane


def circle(height=0.2, count=400):
    """A circle of 20 m, with so much up and down."""
    angle = np.linspace(0, 2 * np.pi, count)
    up = height * np.sin(3 * angle)
    positions = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), up])
    return make(positions, Rotation.from_euler("z", angle[:, None] + np.pi / 2))


def mirrored(path, axis):
    """The same path in a left-handed frame, in which one axis points the other way."""
    flip = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
    R = Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True).as_matrix()
    rotations = Rotation.from_matrix(flip @ R @ flip)
    return make(path.positions_xyz @ flip, rotations, path.timestamps)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("method", ["se3", "sim3", "yaw"])
def test_a_left_handed_estimate_is_called_so_with_how_well_its_mirror_image_fits(axis, method):
    reference = circle()
    estimate = mirrored(disturbed(reference, size=0.03) if method != "yaw" else reference, axis)
    warnings = compare_trajectories(estimate, reference, method).alignment.warnings
    (warning,) = warnings
    assert "a mirror image of the estimate fits: mean error 0.0" in warning
    assert "left-handed" in warning


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_in_a_plane_left_handed_and_upside_down_are_the_same(noise):
    reference = circle(height=0.0)
    down = Rotation.from_euler("x", np.pi)
    own = Rotation.from_quat(reference.orientations_quat_wxyz, scalar_first=True)
    upside_down = make(down.apply(reference.positions_xyz), down * own * down.inv())
    shaken = np.random.default_rng(0).normal(size=(400, 3)) * noise
    for estimate in (mirrored(reference, 1), upside_down):
        estimate = make(
            estimate.positions_xyz + shaken,
            Rotation.from_quat(estimate.orientations_quat_wxyz, scalar_first=True),
        )
        (warning,) = compare_trajectories(estimate, reference).alignment.warnings
        assert "rotation errors are about 180 deg" in warning
        assert "left-handed, or its poses have other axes" in warning


@pytest.mark.parametrize("height", [0.0, 0.2])
def test_a_good_estimate_of_a_flat_path_has_no_warnings(height):
    reference = circle(height)
    assert compare_trajectories(disturbed(reference), reference).alignment.warnings == ()


def test_large_errors_on_a_round_path_are_no_straight_line():
    reference = circle()
    estimate = disturbed(reference, size=0.5)
    (warning,) = compare_trajectories(estimate, reference).alignment.warnings
    assert "straight line" not in warning
    assert re.search(
        r"errors of 0\.\d+ m are large .* leaves roll .* open by some \d\.\d deg", warning
    )


def test_errors_as_large_as_a_paths_width_leave_roll_open():
    # 2 m wide and 100 m long is no line, but errors of 1 m let it roll
    along = np.linspace(-170, 170, 300)
    reference = make(np.column_stack([along, 3 * np.sin(along / 10), 0 * along]))
    assert compare_trajectories(disturbed(reference, size=0.001), reference).warnings == ()
    (warning,) = compare_trajectories(disturbed(reference, size=0.5), reference).warnings
    assert "leaves roll" in warning


# association: what the limits include


def test_a_gap_of_exactly_the_limit_is_interpolated():
    reference = make(np.eye(4, 3), stamps=[0.0, 0.25, 0.5, 0.75])
    pairs = associate(make(np.zeros((3, 3)), stamps=[0.125, 0.375, 0.625]), reference, 0.25)
    assert (pairs.estimate.num_poses, pairs.in_gaps) == (3, 0)


def test_stamps_that_rounding_puts_outside_take_the_end_poses():
    reference = make(np.arange(12).reshape(4, 3), stamps=[0.0, 0.1, 0.2, 0.3])
    estimate = make(np.zeros((4, 3)), stamps=[-5e-7, 0.1, 0.2, 0.3 + 5e-7])
    pairs = associate(estimate, reference)
    assert pairs.outside == 0
    np.testing.assert_array_equal(pairs.reference.positions_xyz, reference.positions_xyz)
    assert pairs.coverage == 1.0
