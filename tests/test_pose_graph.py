"""The pose graph against closed forms, plain GTSAM and wrong loop closures."""

import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from slam_support import SIGMAS, error_of, planar

from lifelong_slam.geometry import exp, invert
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.result import Edge

COVARIANCE = np.diag(SIGMAS**2)
NO_BIAS = np.zeros(6)


def edge(i, j, T, kind="odometry", covariance=COVARIANCE):
    return Edge(i, j, T, covariance, kind)


def graph_of(edges, count):
    """Build a graph whose first edges are the odometry 0 -> 1 -> ... -> count - 1."""
    graph = PoseGraph()
    graph.add_vertex(0, np.eye(4))
    for e in edges:
        graph.add_odometry(e) if e.kind == "odometry" else graph.add_edge(e)
    assert len(graph) == count
    return graph


def noise(rng, scale=1.0, sigmas=SIGMAS):
    return exp(rng.normal(size=6) * sigmas * scale)


def laps(seed, count=60, lap=30, sigmas=SIGMAS, bias=NO_BIAS):
    """Return true poses on a circle driven more than once, and odometry with noise and bias."""
    rng = np.random.default_rng(seed)
    step = planar(2.0, 0.0, 2 * np.pi / lap)
    truth = [np.eye(4)]
    for _ in range(count - 1):
        truth.append(truth[-1] @ step)
    covariance = np.diag(sigmas**2 + bias**2)
    odometry = [
        edge(i, i + 1, step @ exp(bias) @ noise(rng, 1.0, sigmas), covariance=covariance)
        for i in range(count - 1)
    ]
    return truth, odometry, rng


def closure(truth, i, j, rng, wrong=None):
    T = invert(truth[i]) @ truth[j] @ noise(rng)
    return edge(i, j, T if wrong is None else T @ wrong, "loop")


def largest_error(graph, reference):
    return max(error_of(graph.pose(i), T)[0] for i, T in enumerate(reference))


def test_two_measurements_of_one_motion_average_by_their_information():
    far, near = planar(1.02, 0, 0), planar(1.0, 0, 0)
    loose, tight = np.diag([1e-6] * 3 + [4e-4] * 3), np.diag([1e-6] * 3 + [1e-4] * 3)
    graph = graph_of([edge(0, 1, far, covariance=loose), edge(0, 1, near, "loop", tight)], 2)
    graph.optimise()
    expected = (1.02 / 4e-4 + 1.0 / 1e-4) / (1 / 4e-4 + 1 / 1e-4)
    np.testing.assert_allclose(graph.pose(1), planar(expected, 0, 0), atol=1e-7)
    np.testing.assert_array_equal(graph.edges[0].T_source_target, far)


@pytest.mark.parametrize("count", [3, 6, 11])
def test_a_loop_of_equal_covariances_shares_its_error_equally(count):
    steps = [edge(i, i + 1, planar(1.0, 0, 0)) for i in range(count - 1)]
    gap = 0.02
    loop = edge(0, count - 1, planar(count - 1 + gap, 0, 0), "loop")
    graph = graph_of([*steps, loop], count)
    graph.optimise()
    for i in range(count):
        np.testing.assert_allclose(graph.pose(i), planar(i * (1 + gap / count), 0, 0), atol=1e-6)


def test_the_first_vertex_stays_where_it_is_put():
    graph = PoseGraph()
    start = planar(3.0, -2.0, 1.0, 0.5)
    graph.add_vertex(7, start)
    graph.add_odometry(edge(7, 8, planar(1, 0, 0)))
    graph.add_edge(edge(8, 7, planar(-1.02, 0, 0), "loop"))
    graph.optimise()
    np.testing.assert_allclose(graph.pose(7), start, atol=1e-9)


def test_odometry_alone_is_chained_and_optimising_changes_nothing():
    _, odometry, _ = laps(0, 20)
    graph = graph_of(odometry, 20)
    chained = np.eye(4)
    for e in odometry:
        chained = chained @ e.T_source_target
    np.testing.assert_allclose(graph.pose(19), chained, atol=1e-9)
    graph.optimise(reconsider=True)
    np.testing.assert_allclose(graph.pose(19), chained, atol=1e-9)


def test_a_graph_of_one_vertex_can_be_optimised():
    graph = PoseGraph()
    graph.add_vertex(0, np.eye(4))
    graph.optimise()
    graph.optimise(reconsider=True)
    np.testing.assert_allclose(graph.pose(0), np.eye(4), atol=1e-12)


def full_covariance(rng):
    A = rng.normal(size=(6, 6)) * 0.5
    return np.diag(SIGMAS) @ (A @ A.T + np.eye(6)) @ np.diag(SIGMAS)


@pytest.mark.parametrize("seed", range(3))
def test_true_closures_give_the_same_poses_as_plain_gtsam(seed):
    truth, odometry, rng = laps(seed)
    odometry = [
        edge(e.source, e.target, e.T_source_target, covariance=full_covariance(rng))
        for e in odometry
    ]
    loops = [closure(truth, i, i + 30, rng) for i in range(0, 30, 6)]
    graph = graph_of([*odometry, *loops], 60)
    plain, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    plain.push_back(
        gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))
    )
    for e in [*odometry, *loops]:
        model = gtsam.noiseModel.Gaussian.Covariance(e.covariance)
        plain.push_back(
            gtsam.BetweenFactorPose3(e.source, e.target, gtsam.Pose3(e.T_source_target), model)
        )
    for i, T in enumerate(truth):  # from another start than ours
        values.insert(i, gtsam.Pose3(T))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    optimum = gtsam.LevenbergMarquardtOptimizer(plain, values, params).optimize()
    graph.optimise()
    assert not graph.rejected
    for i in range(60):
        np.testing.assert_allclose(graph.pose(i), optimum.atPose3(i).matrix(), atol=1e-3)
    ours = gtsam.Values()
    for i, T in graph.poses().items():
        ours.insert(i, gtsam.Pose3(T))
    assert plain.error(ours) == pytest.approx(plain.error(optimum), rel=1e-3)


def test_disagreement_is_twice_the_error_of_gtsams_between_factor():
    rng = np.random.default_rng(1)
    for _ in range(10):
        a, b = exp(rng.normal(size=6)), exp(rng.normal(size=6))
        e = edge(0, 1, invert(a) @ b @ noise(rng, 5), covariance=full_covariance(rng))
        graph, values = PoseGraph(), gtsam.Values()
        for i, T in enumerate((a, b)):
            graph.add_vertex(i, T)
            values.insert(i, gtsam.Pose3(T))
        factor = gtsam.BetweenFactorPose3(
            0, 1, gtsam.Pose3(e.T_source_target), gtsam.noiseModel.Gaussian.Covariance(e.covariance)
        )
        assert graph.disagreement(e) == pytest.approx(2 * factor.error(values), rel=1e-6)


def test_a_covariance_is_in_the_frame_of_the_edges_target():
    # The target looks along the source's y, and its x is the loosely measured direction.
    turned = planar(4.0, 0.0, np.pi / 2)
    loose_x = np.diag([1e-8] * 3 + [1e-2, 1e-6, 1e-6])
    graph = graph_of([edge(0, 1, turned, covariance=loose_x)], 2)
    moved = turned.copy()
    moved[:2, 3] += [0.02, 0.02]
    graph.add_edge(edge(0, 1, moved, "loop", np.diag([1e-8] * 3 + [1e-4] * 3)))
    graph.optimise()
    x, y = graph.pose(1)[:2, 3] - turned[:2, 3]
    assert y == pytest.approx(0.02 * 1e-2 / (1e-2 + 1e-4), rel=0.01)
    assert x == pytest.approx(0.02 * 1e-6 / (1e-6 + 1e-4), rel=0.05)


def test_edges_agree_as_often_as_true_ones_should():
    rng = np.random.default_rng(2)
    graph = graph_of([edge(0, 1, planar(2, 1, 0.5))], 2)
    agreed = [graph.agrees(edge(0, 1, planar(2, 1, 0.5) @ noise(rng), "loop")) for _ in range(3000)]
    assert np.mean(agreed) > 0.995
    for xi in np.eye(6) * SIGMAS * 5:
        assert not graph.agrees(edge(0, 1, planar(2, 1, 0.5) @ exp(xi), "loop"))


gross = st.tuples(
    st.floats(-1, 1), st.floats(-1, 1), st.floats(2.0, 40.0), st.floats(-np.pi, np.pi)
)


def gross_error(parts):
    """Make a transform at least two metres off out of random numbers."""
    x, y, length, yaw = parts
    direction = np.array([x, y]) / max(np.hypot(x, y), 1e-3)
    direction = direction if np.hypot(*direction) > 0.5 else np.array([1.0, 0.0])
    return planar(*(direction * length), yaw)


slowly = settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))


@slowly
@given(parts=gross, pair=st.tuples(st.integers(0, 20), st.integers(31, 59)))
def test_one_wrong_closure_among_true_ones_does_not_bend_the_map(parts, pair):
    truth, odometry, rng = laps(3)
    true_loops = [closure(truth, i, i + 30, rng) for i in range(0, 30, 5)]
    clean = graph_of([*odometry, *true_loops], 60)
    clean.optimise()
    wrong = closure(truth, *pair, rng, gross_error(parts))
    graph = graph_of([*odometry, *true_loops, wrong], 60)
    graph.optimise()
    assert graph.rejected == [wrong]
    assert graph.edges == [*odometry, *true_loops]
    assert largest_error(graph, clean.poses().values()) < 0.01


@slowly
@given(parts=gross, target=st.integers(25, 59))
def test_one_wrong_closure_alone_does_not_bend_the_map(parts, target):
    truth, odometry, rng = laps(4)
    graph = graph_of(odometry, 60)
    before = graph.poses().values()
    wrong = closure(truth, 0, target, rng, gross_error(parts))
    graph.add_edge(wrong)
    for reconsider in (False, True):
        graph.optimise(reconsider)
        assert graph.rejected == [wrong]
        assert largest_error(graph, before) < 1e-3


def test_a_wrong_closure_that_comes_after_true_ones_is_outvoted_at_once():
    truth, odometry, rng = laps(5)
    graph = graph_of(odometry, 60)
    for i in range(0, 25, 5):
        graph.add_edge(closure(truth, i, i + 30, rng))
        graph.optimise()
    before = graph.poses()
    wrong = closure(truth, 28, 58, rng, planar(4.0, 0, 0.2))
    graph.add_edge(wrong)
    graph.optimise()
    assert graph.rejected == [wrong]
    assert largest_error(graph, before.values()) < 0.01


def test_a_true_closure_after_metres_of_honest_drift_is_accepted():
    # Half a degree of yaw in each step, known to be uncertain: after a lap the car is metres off.
    sigmas = np.array([1e-4, 1e-4, 0.01, 0.02, 0.02, 0.001])
    bias = np.array([0, 0, 0.01, 0, 0, 0.0])
    truth, odometry, rng = laps(6, 31, sigmas=sigmas, bias=bias)
    graph = graph_of(odometry, 31)
    drift = error_of(graph.pose(30), truth[30])[0]
    assert drift > 1.5
    graph.add_edge(closure(truth, 0, 30, rng))
    graph.optimise()
    assert not graph.rejected
    assert error_of(graph.pose(30), truth[30])[0] < 0.05
    assert largest_error(graph, truth) < drift / 3
    graph.optimise(reconsider=True)
    assert not graph.rejected


def test_many_agreeing_closures_outvote_odometry_that_promises_too_much():
    bias = np.array([0, 0, 0.002, 0, 0, 0.0])
    truth, odometry, rng = laps(7, bias=bias)
    odometry = [edge(e.source, e.target, e.T_source_target) for e in odometry]
    graph = graph_of(odometry, 60)
    drift = largest_error(graph, truth)
    assert drift > 1
    loops = [closure(truth, i, i + 30, rng) for i in range(30)]
    for loop in loops:
        graph.add_edge(loop)
    graph.optimise()
    graph.optimise(reconsider=True)
    assert len(graph.rejected) <= 3
    assert largest_error(graph, truth) < drift / 2


def test_outvoted_closures_are_listed_and_come_back_when_others_confirm_them():
    # The first closure is true, but the odometry promises too much for it alone to be believed.
    bias = np.array([0, 0, 0.002, 0, 0, 0.0])
    truth, odometry, rng = laps(8, bias=bias)
    odometry = [edge(e.source, e.target, e.T_source_target) for e in odometry]
    wrong = closure(truth, 3, 40, rng, planar(6.0, 3.0, 0.5))
    first = closure(truth, 0, 30, rng)
    graph = graph_of([*odometry, wrong, first], 60)
    graph.optimise()
    assert wrong in graph.rejected
    later = [closure(truth, i, i + 30, rng) for i in range(1, 30)]
    for loop in later:
        graph.add_edge(loop)
    graph.optimise(reconsider=True)
    assert wrong in graph.rejected
    assert first in graph.edges
    assert graph.edges == [e for e in [*odometry, wrong, first, *later] if e not in graph.rejected]
    assert len(graph.rejected) <= 3


def test_a_snapshot_holds_what_is_in_use_and_does_not_change_any_more():
    truth, odometry, rng = laps(9)
    loops = [closure(truth, i, i + 30, rng) for i in range(0, 30, 5)]
    wrong = closure(truth, 2, 33, rng, planar(5, 5, 1))
    graph = graph_of([*odometry, *loops, wrong], 60)
    before = graph.snapshot()
    graph.optimise()
    after = graph.snapshot()
    assert list(after.poses) == list(range(60))
    assert after.edges == [*odometry, *loops]
    assert before.edges == [*odometry, *loops, wrong]
    assert not np.allclose(before.poses[59], after.poses[59], atol=1e-4)


def test_two_graphs_of_the_same_edges_are_equal_to_the_last_bit():
    poses = []
    for _ in range(2):
        truth, odometry, rng = laps(10)
        loops = [closure(truth, i, i + 30, rng) for i in range(0, 30, 5)]
        wrong = closure(truth, 2, 33, rng, planar(5, 5, 1))
        graph = graph_of([*odometry, *loops, wrong], 60)
        graph.optimise()
        graph.optimise(reconsider=True)
        poses.append(np.array(list(graph.poses().values())))
    np.testing.assert_array_equal(poses[0], poses[1])
