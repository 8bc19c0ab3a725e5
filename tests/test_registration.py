"""Registration against known transforms, and what it says about its own answer."""

import os
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from slam_support import corridor, error_of, planar, surfaces

from lifelong_slam.geometry import adjoint, exp, invert, log, transform
from lifelong_slam.registration import Cloud, covariance_of, refine, register

ROOT = Path(__file__).parent.parent
DATA = ROOT / os.environ.get("LIFELONG_SLAM_DATA", "../shared/data") / "maps"
VOXEL = 0.5
NOISE = 0.01


def pair(seed, T_target_source, noise=NOISE, boxes=12):
    """Two independent samples of one scene, the second one seen from `T_target_source`."""
    target = surfaces(seed, sample=1, noise=noise, boxes=boxes)
    source = transform(invert(T_target_source), surfaces(seed, sample=2, noise=noise, boxes=boxes))
    return Cloud.prepare(target, VOXEL), Cloud.prepare(source, VOXEL)


@pytest.mark.parametrize("seed", range(5))
def test_known_transforms_are_recovered(seed):
    rng = np.random.default_rng(seed)
    T = exp(rng.uniform(-1, 1, 6) * [0.05, 0.05, 0.2, 0.6, 0.6, 0.3])
    result = register(*pair(seed, T), [np.eye(4)], VOXEL)
    distance, angle = error_of(result.T_target_source, T)
    assert distance < 0.02
    assert angle < 0.002
    assert result.converged


def real_cloud(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not there (LIFELONG_SLAM_DATA names the data folder)")
    return np.asarray(o3d.io.read_point_cloud(str(path)).points)


@pytest.mark.data
@pytest.mark.parametrize("xi", [[0, 0, 0, 0, 0, 0], [0.02, -0.02, 0.06, 0.5, -0.5, 0.2]])
def test_two_real_scans_fit_as_published(xi):
    target, source = (Cloud.prepare(real_cloud(f"{n}.ply"), VOXEL) for n in ("target", "source"))
    true = np.loadtxt(DATA / "T_target_source.txt")
    result = register(target, source, [true @ exp(np.array(xi, float))], VOXEL)
    distance, angle = error_of(result.T_target_source, true)
    assert distance < 0.05
    assert angle < 0.005
    assert result.overlap > 0.7
    assert result.residual < 0.06


def test_the_best_of_several_guesses_wins_wherever_it_stands():
    T = planar(1.0, -0.5, 0.1)
    target, source = pair(3, T)
    wrong, turned = planar(9.0, 7.0, 1.5), planar(0.0, 0.0, np.pi)
    alone = register(target, source, [T], VOXEL)
    for guesses in ([T, wrong, turned], [wrong, T, turned], [wrong, turned, T]):
        result = register(target, source, guesses, VOXEL)
        np.testing.assert_array_equal(result.T_target_source, alone.T_target_source)
    lost = register(target, source, [wrong, turned], VOXEL)
    assert error_of(lost.T_target_source, T)[0] > 1.0
    assert lost.overlap < alone.overlap


def test_registration_without_a_guess_is_refused():
    with pytest.raises(ValueError, match="guess"):
        register(*pair(0, np.eye(4)), [], VOXEL)


def test_refining_a_good_guess_ends_where_registration_ends():
    T = planar(0.5, 0.2, 0.05)
    target, source = pair(4, T)
    refined = refine(target, source, T, VOXEL)
    registered = register(target, source, [np.eye(4)], VOXEL)
    assert error_of(refined.T_target_source, registered.T_target_source)[0] < 2e-3


def test_registration_repeats_to_the_last_bit():
    results = [register(*pair(5, planar(0.4, 0.1, 0.1)), [np.eye(4)], VOXEL) for _ in range(2)]
    np.testing.assert_array_equal(results[0].T_target_source, results[1].T_target_source)
    np.testing.assert_array_equal(results[0].hessian, results[1].hessian)


def test_overlap_is_one_for_the_same_scene_and_the_share_of_points_that_belong_to_it():
    target = surfaces(6, sample=1, noise=NOISE)
    source = surfaces(6, sample=2, noise=NOISE)
    aloft = source + np.array([0, 0, 40.0])
    whole = Cloud.prepare(target, VOXEL)
    same = register(whole, Cloud.prepare(source, VOXEL), [np.eye(4)], VOXEL)
    assert same.overlap > 0.85
    half = Cloud.prepare(np.vstack([source, aloft]), VOXEL)
    mixed = register(whole, half, [np.eye(4)], VOXEL)
    assert mixed.overlap == pytest.approx(same.overlap / 2, rel=0.02)


def test_disjoint_clouds_do_not_overlap():
    target = Cloud.prepare(surfaces(7, sample=1), VOXEL)
    source = Cloud.prepare(surfaces(7, sample=2) + np.array([500.0, 0, 0]), VOXEL)
    result = register(target, source, [np.eye(4)], VOXEL)
    assert result.overlap == 0.0
    assert np.isfinite(result.covariance).all()


def test_a_point_near_a_surface_but_off_its_plane_does_not_overlap():
    target = Cloud.prepare(surfaces(8, sample=1, boxes=0, count=12000), VOXEL)
    lifted = Cloud.prepare(surfaces(8, sample=2, boxes=0, count=12000), VOXEL)
    # No iteration can move it back: two parallel planes half a metre apart, the source between them.
    points = np.vstack([target.positions, target.positions + np.array([0, 0, 1.0])])
    between = Cloud.prepare(lifted.positions + np.array([0, 0, 0.5]), VOXEL)
    result = refine(Cloud.prepare(points, VOXEL), between, np.eye(4), 0.3)
    assert result.overlap < 0.1


def test_residual_is_the_noise_of_the_surfaces():
    residuals = []
    for noise in (0.005, 0.02, 0.04):
        clouds = pair(9, np.eye(4), noise, boxes=0)
        residuals.append(register(*clouds, [np.eye(4)], VOXEL).residual)
        # One cloud's point off a plane fitted to the other's; voxels average both.
        assert 0.3 * noise < residuals[-1] < 1.5 * noise
    assert residuals == sorted(residuals)


def test_a_corridor_leaves_one_direction_free():
    target, source = (Cloud.prepare(corridor(sample), VOXEL) for sample in (1, 2))
    result = register(target, source, [np.eye(4)], VOXEL)
    assert result.overlap > 0.9
    _, directions = np.linalg.eigh(result.translation_information)
    assert abs(directions[0, 0]) > 0.99
    room = register(*pair(10, np.eye(4)), [np.eye(4)], VOXEL)
    assert result.degeneracy < 0.01
    assert room.degeneracy > 0.05


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 0.7])
def test_the_free_direction_is_told_in_the_frame_of_the_source(yaw):
    T = planar(0.2, 0.1, yaw)
    target = Cloud.prepare(corridor(1), VOXEL)
    source = Cloud.prepare(transform(invert(T), corridor(2)), VOXEL)
    covariance = register(target, source, [T], VOXEL).covariance
    _, directions = np.linalg.eigh(covariance[3:, 3:])
    along = T[:3, :3].T @ [1.0, 0, 0]
    assert abs(directions[:, -1] @ along) > 0.99


def test_covariance_is_symmetric_and_positive_definite_even_where_a_direction_is_free():
    target, source = (Cloud.prepare(corridor(sample), VOXEL) for sample in (1, 2))
    for result in (
        register(target, source, [np.eye(4)], VOXEL),
        register(*pair(11, planar(0.3, 0.1, 0.1)), [np.eye(4)], VOXEL),
    ):
        np.testing.assert_array_equal(result.covariance, result.covariance.T)
        assert np.linalg.eigvalsh(result.covariance).min() > 0


def test_covariance_moves_with_the_frame_of_the_source():
    # A voxel that small keeps all points, so both registrations see the very same scene.
    T, X = planar(0.1, 0.2, 0.05), exp(np.array([0.2, -0.4, 1.1, 6.0, -3.0, 2.0]))
    target = Cloud.prepare(surfaces(12, sample=1, noise=NOISE), 0.01)
    points = transform(invert(T), surfaces(12, sample=2, noise=NOISE))
    plain = register(target, Cloud.prepare(points, 0.01), [T], VOXEL)
    moved = register(target, Cloud.prepare(transform(invert(X), points), 0.01), [T @ X], VOXEL)
    np.testing.assert_allclose(moved.T_target_source, plain.T_target_source @ X, atol=1e-3)
    A = adjoint(invert(X))
    expected = A @ plain.covariance @ A.T
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        moved.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.05
    )


def test_covariance_grows_with_noise():
    quiet, loud = (
        register(*pair(13, np.eye(4), noise), [np.eye(4)], VOXEL) for noise in (0.01, 0.05)
    )
    assert np.all(np.diag(loud.covariance) > 1.5 * np.diag(quiet.covariance))


@pytest.mark.parametrize("noise", [0.01, 0.03, 0.05])
def test_covariance_is_as_large_as_the_errors_it_stands_for(noise):
    squared = []
    for seed in range(20):
        result = register(*pair(seed, np.eye(4), noise), [np.eye(4)], VOXEL)
        error = log(result.T_target_source)
        squared.append(error @ np.linalg.solve(result.covariance, error))
    assert 3 < np.mean(squared) < 12  # NEES in six dimensions: 6 within a factor of two


def test_covariance_of_an_unconstrained_problem_is_finite_and_large():
    for error in (0.0, 1.0):
        covariance = covariance_of(np.zeros((6, 6)), error, 0)
        assert np.isfinite(covariance).all()
        assert np.linalg.eigvalsh(covariance).min() > 1e3


def test_a_prepared_cloud_has_a_point_a_voxel_and_unit_normals():
    points = surfaces(14)
    cloud = Cloud.prepare(points, VOXEL)
    occupied = len(np.unique(np.floor(points / VOXEL), axis=0))
    assert len(cloud) == pytest.approx(occupied, rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-6)
    low = np.abs(cloud.positions[:, 2]) < 1e-9
    clear = low & (np.abs(cloud.positions[:, :2]) < 14).all(axis=1)
    assert np.median(np.abs(cloud.normals[clear, 2])) > 0.99


@pytest.mark.parametrize("count", [0, 1, 2, 4, 9])
def test_next_to_no_points_overlap_with_nothing_and_break_nothing(count):
    few = Cloud.prepare(surfaces(15)[:count], VOXEL)
    assert len(few) == count
    assert few.positions.shape == few.normals.shape == (count, 3)
    many = Cloud.prepare(surfaces(15, sample=1) + np.array([0, 0, 300.0]), VOXEL)
    for target, source in ((many, few), (few, many), (few, few)):
        for result in (
            register(target, source, [np.eye(4)], VOXEL),
            refine(target, source, np.eye(4), VOXEL),
        ):
            assert np.isfinite(result.T_target_source).all()
            if target is not source or count < 4:
                assert result.overlap == 0.0
            assert result.degeneracy >= 0
