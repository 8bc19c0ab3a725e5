"""The second opinion on motions that the front end can't be sure of."""

import numpy as np
import pytest
from slam_support import corridor, error_of, planar, surfaces

from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.odometry.motion_check import MotionCheck

VOXEL = 1.0
NOISE = 0.02


def scene(seed, sample):
    return surfaces(seed, sample, boxes=16, count=9000, extent=20.0, noise=NOISE)


def check_that_knows(seed):
    """Return a check that has seen a scene from its origin."""
    check = MotionCheck(VOXEL)
    check.remember(scene(seed, 1), np.eye(4))
    return check


def seen_from(seed, T, sample=2):
    return transform(invert(T), scene(seed, sample))


@pytest.mark.parametrize("yaw", [-0.3, -0.2, 0.1, 0.25, 0.35])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_quick_turn_is_found_though_no_guess_knows_of_it(seed, yaw):
    T = planar(0.4, -0.1, yaw)
    misled = planar(0.6, 0.3, 0.0)
    check = check_that_knows(seed)
    found = check.resolve(seen_from(seed, T), np.eye(4), [misled, planar(0.5, 0, 0)])
    distance, angle = error_of(found, T)
    assert distance < 0.05
    assert angle < 0.005
    assert check.checks == 1


def test_a_true_guess_is_kept_among_false_ones():
    T = planar(2.5, 0.2, 0.05)
    for guesses in ([T, planar(-3, 4, 1.2)], [planar(-3, 4, 1.2), T]):
        found = check_that_knows(2).resolve(seen_from(2, T), np.eye(4), guesses)
        assert error_of(found, T)[0] < 0.05


def test_scans_are_checked_where_they_were_registered():
    # The same place remembered from another pose gives the same answer in that pose's frame.
    X = exp(np.array([0.1, -0.2, 1.0, 30.0, -20.0, 3.0]))
    T = planar(0.5, 0.1, 0.2)
    check = MotionCheck(VOXEL)
    check.remember(scene(3, 1), X)
    found = check.resolve(seen_from(3, T), X, [X])
    assert error_of(found, X @ T)[0] < 0.05


def test_where_nothing_fits_there_is_no_answer():
    elsewhere = surfaces(5, 1, boxes=4, extent=5.0) + np.array([0, 0, 300.0])
    guess = planar(1.0, 2.0, 0.3)
    assert check_that_knows(4).resolve(elsewhere, np.eye(4), [guess, np.eye(4)]) is None


@pytest.mark.parametrize(
    "T",
    [planar(0, 0), planar(2.0, 0), planar(3.0, 0.0, 0.03), planar(-1.0, 0), planar(1.5, 1.5)],
    ids=lambda T: f"{T[0, 3]:g},{T[1, 3]:g}",
)
def test_the_first_motion_is_found_at_standstill_and_at_speed(T):
    check = MotionCheck(VOXEL)
    for seed in (6, 7):
        found = check.first_motion(scene(seed, 1), seen_from(seed, T))
        distance, angle = error_of(found, T)
        assert distance < 0.05
        assert angle < 0.005
    assert check.checks == 2


def test_first_scans_that_do_not_fit_have_no_motion():
    far_away = surfaces(9, 1, boxes=4, extent=5.0) + np.array([0, 0, 300.0])
    assert MotionCheck(VOXEL).first_motion(scene(8, 1), far_away) is None


@pytest.mark.parametrize("counts", [(0, 500), (500, 0), (0, 0), (3, 500), (500, 3), (12, 12)])
def test_next_to_nothing_to_compare_has_no_motion(counts):
    first, second = (scene(10, i)[:n] for i, n in enumerate(counts))
    assert MotionCheck(VOXEL).first_motion(first, second + np.array([0, 0, 100.0])) is None


def test_a_motion_is_suspicious_outside_the_basin_around_its_prediction():
    check = MotionCheck(VOXEL)
    predicted = exp(np.array([0.1, 0.2, 0.3, 10.0, 20.0, 1.0]))
    assert not check.is_suspicious(predicted, predicted)
    assert not check.is_suspicious(predicted, predicted @ planar(0.2, 0.1, 0.02))
    assert check.is_suspicious(predicted, predicted @ planar(0.0, 0.0, 0.06))
    assert check.is_suspicious(predicted, predicted @ planar(0.5, 0.0, 0.0))
    # The basin grows with the voxels that ICP matches in.
    assert not MotionCheck(3.0).is_suspicious(predicted, predicted @ planar(0.5, 0.0, 0.0))


def test_a_free_direction_is_not_moved_along_for_nothing():
    # In a corridor all places along it fit as well; the answer stays by one of the guesses.
    check = MotionCheck(VOXEL)
    check.remember(corridor(1, length=120.0, count=12000), np.eye(4))
    found = check.resolve(corridor(2, length=40.0), np.eye(4), [planar(0.5, 0.05, 0.01)])
    assert abs(found[0, 3]) < 2.0
    assert np.linalg.norm(found[1:3, 3]) < 0.05
