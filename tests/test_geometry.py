"""Rigid-body geometry against GTSAM, SciPy and its own laws."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from lifelong_slam.geometry import (
    adjoint,
    exp,
    from_quaternion,
    interpolate,
    invert,
    log,
    rotation_angle,
    skew,
    to_quaternion,
    transform,
)

# Components of 1.7 rad keep the rotation's angle below pi, where log is one-to-one.
_components = st.one_of(
    st.floats(-1.7, 1.7, allow_subnormal=False), st.sampled_from([0.0, 1e-9, -1e-6, 1e-4, 3e-4])
)
tangents = arrays(np.float64, 6, elements=_components)


@given(tangents)
def test_exp_and_log_agree_with_gtsam(xi):
    pose = gtsam.Pose3.Expmap(xi)
    np.testing.assert_allclose(exp(xi), pose.matrix(), atol=1e-9)
    np.testing.assert_allclose(log(pose.matrix()), xi, atol=1e-7)


@given(tangents)
def test_exp_is_the_matrix_exponential(xi):
    algebra = np.zeros((4, 4))
    algebra[:3, :3], algebra[:3, 3] = skew(xi[:3]), xi[3:]
    np.testing.assert_allclose(exp(xi), expm(algebra), atol=1e-9)


@given(tangents)
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(log(exp(xi)), xi, atol=1e-7)


@pytest.mark.parametrize("angle", [1e-12, 1e-8, 0.99e-4, 1.01e-4, 1e-3])
def test_small_angles_are_exact_on_both_sides_of_the_series(angle):
    xi = np.array([0, 0, angle, 1.0, 2.0, 3.0])
    sine, versine = np.sin(angle), 2 * np.sin(angle / 2) ** 2
    x = (sine * 1.0 - versine * 2.0) / angle
    y = (versine * 1.0 + sine * 2.0) / angle
    np.testing.assert_allclose(exp(xi)[:3, 3], [x, y, 3.0], rtol=1e-7)


@given(tangents, tangents)
def test_adjoint_carries_tangents_to_the_other_side(xi, eta):
    T = exp(xi)
    np.testing.assert_allclose(adjoint(T), gtsam.Pose3(T).AdjointMap(), atol=1e-9)
    np.testing.assert_allclose(T @ exp(eta) @ invert(T), exp(adjoint(T) @ eta), atol=1e-8)


@given(tangents, tangents)
def test_inverse_and_composition(xi, eta):
    A, B = exp(xi), exp(eta)
    np.testing.assert_allclose(invert(A) @ A, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(invert(A @ B), invert(B) @ invert(A), atol=1e-12)


@given(tangents, tangents, st.floats(0, 1))
def test_interpolation_has_ends_midpoint_and_constant_twist(xi, step, fraction):
    start = exp(xi)
    end = start @ exp(step)
    np.testing.assert_allclose(interpolate(start, end, np.array(0.0)), start, atol=1e-9)
    np.testing.assert_allclose(interpolate(start, end, np.array(1.0)), end, atol=1e-7)
    between = interpolate(start, end, np.array(fraction))
    np.testing.assert_allclose(between, start @ exp(fraction * step), atol=1e-6)
    gtsams = gtsam.Pose3(start).slerp(fraction, gtsam.Pose3(end)).matrix()
    np.testing.assert_allclose(between, gtsams, atol=1e-6)


@given(tangents)
def test_quaternions_agree_with_scipy_and_come_back(xi):
    T = exp(xi)
    q = to_quaternion(T)
    assert q[3] >= 0
    np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), T[:3, :3], atol=1e-12)
    np.testing.assert_allclose(from_quaternion(T[:3, 3], q), T, atol=1e-12)


@given(tangents)
def test_rotation_angle_is_the_length_of_the_rotation_vector(xi):
    assert rotation_angle(exp(xi)) == pytest.approx(np.linalg.norm(xi[:3]), abs=1e-7)


def test_everything_is_vectorised_over_leading_axes():
    xi = np.random.default_rng(0).normal(size=(2, 5, 6))
    stacked = exp(xi)
    assert stacked.shape == (2, 5, 4, 4)
    for function in (invert, log, adjoint, rotation_angle, to_quaternion):
        single = np.array([[function(T) for T in row] for row in stacked])
        np.testing.assert_allclose(function(stacked), single, atol=1e-12)
    halves = interpolate(stacked[0], stacked[1], np.full(5, 0.5))
    assert halves.shape == (5, 4, 4)


def test_empty_stacks_pass_through():
    assert exp(np.zeros((0, 6))).shape == (0, 4, 4)
    assert log(np.zeros((0, 4, 4))).shape == (0, 6)
    assert to_quaternion(np.zeros((0, 4, 4))).shape == (0, 4)
    assert from_quaternion(np.zeros((0, 3)), np.zeros((0, 4))).shape == (0, 4, 4)


def test_transform_maps_points_like_homogeneous_coordinates():
    rng = np.random.default_rng(1)
    T, points = exp(rng.normal(size=6)), rng.normal(size=(20, 3))
    homogeneous = np.column_stack([points, np.ones(20)]) @ T.T
    np.testing.assert_allclose(transform(T, points), homogeneous[:, :3], atol=1e-12)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), [[0.6, 0.8, 0.0]]]))
def test_log_survives_half_turns(axis):
    xi = np.concatenate([axis * np.pi, [1.0, 2.0, 3.0]])
    np.testing.assert_allclose(exp(log(exp(xi))), exp(xi), atol=1e-9)
