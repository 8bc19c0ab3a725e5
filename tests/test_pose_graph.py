"""The pose graph against closed forms, plain GTSAM and wrong loop closures."""

import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
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


def disagreement(e, poses):
    """Return the squared Mahalanobis distance of an edge from poses, by GTSAM."""
    values = gtsam.Values()
    for i in (e.source, e.target):
        values.insert(i, gtsam.Pose3(poses[i]))
    model = gtsam.noiseModel.Gaussian.Covariance(e.covariance)
    measured = gtsam.Pose3(e.T_source_target)
    return 2 * gtsam.BetweenFactorPose3(e.source, e.target, measured, model).error(values)


def test_chi_square_is_the_sum_of_the_squared_errors_of_what_is_in_use():
    truth, odometry, rng = laps(13)
    loops = [closure(truth, i, i + 30, rng) for i in range(0, 30, 5)]
    graph = graph_of([*odometry, *loops, closure(truth, 2, 33, rng, planar(5, 5, 1))], 60)
    before = sum(disagreement(e, graph.poses()) for e in graph.edges)
    assert graph.chi_square() == pytest.approx(before, rel=1e-6)
    graph.optimise()
    assert len(graph.rejected) == 1
    after = sum(disagreement(e, graph.poses()) for e in graph.edges)
    assert graph.chi_square() == pytest.approx(after, rel=1e-6)
    assert after < before


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


@pytest.mark.parametrize("direction", [0.0, 1.0, 2.5])
def test_a_measurement_is_news_once_it_misses_by_a_fifth_of_a_metre(direction):
    graph = graph_of([edge(0, 1, planar(2, 1, 0.5))], 2)
    for miss, news in ((0.0, False), (0.19, False), (0.21, True)):
        T = planar(2 + miss * np.cos(direction), 1 + miss * np.sin(direction), 0.5)
        assert graph.is_news(edge(0, 1, T, "loop")) == news
        assert graph.is_news(edge(1, 0, invert(T), "loop")) == news


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
@example(parts=(0.0, 0.0, 35.0, 0.0), pair=(6, 48))
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


def sessions(count=4):
    """Return a graph of two components: vertices 0, 1, ... and, in a frame of its own, 100, 101, ..."""
    graph = PoseGraph()
    graph.add_vertex(0, np.eye(4))
    graph.add_vertex(100, planar(7, 7, 1.0))
    for first in (0, 100):
        for i in range(first, first + count - 1):
            graph.add_odometry(edge(i, i + 1, planar(1.0, 0, 0.1)))
    return graph


def test_components_are_what_edges_connect():
    graph = sessions()
    assert graph.roots == [0, 100]
    assert set(graph.component(2)) == {0, 1, 2, 3}
    assert set(graph.component(100)) == {100, 101, 102, 103}
    assert set(graph_of(laps(0, 5)[1], 5).component(3)) == set(range(5))


def test_each_component_is_held_where_it_begins():
    graph = sessions()
    before = graph.poses()
    graph.optimise()
    graph.optimise(reconsider=True)
    for i, T in before.items():
        np.testing.assert_allclose(graph.pose(i), T, atol=1e-9)


def test_joining_moves_a_component_as_a_whole_to_where_the_closure_puts_it():
    graph = sessions()
    before = graph.poses()
    found = edge(3, 102, planar(0.5, -2, 0.7), "loop")
    graph.join(found)
    np.testing.assert_allclose(graph.pose(102), graph.pose(3) @ found.T_source_target, atol=1e-9)
    for first in (0, 100):
        for i in range(first, first + 4):
            expected = invert(before[first]) @ before[i]
            np.testing.assert_allclose(
                invert(graph.pose(first)) @ graph.pose(i), expected, atol=1e-9
            )
    np.testing.assert_array_equal(graph.pose(2), before[2])
    assert graph.roots == [0]
    assert set(graph.component(101)) == set(before)
    assert found in graph.edges
    joined = graph.poses()
    graph.optimise()
    assert not graph.rejected
    assert max(error_of(graph.pose(i), T)[0] for i, T in joined.items()) < 1e-6


def test_a_joined_session_is_bent_by_later_closures_like_any_other():
    graph = sessions()
    graph.join(edge(3, 100, planar(1, 0), "loop"))
    target = graph.pose(103)
    nudge = planar(0.02, 0, 0)
    graph.add_edge(edge(2, 103, invert(graph.pose(2)) @ target @ nudge, "loop"))
    graph.optimise()
    assert not graph.rejected
    moved = error_of(graph.pose(103), target)[0]
    assert 0.005 < moved < 0.02


def test_a_part_that_has_lost_the_closure_that_joined_it_stays_where_it_is():
    graph = sessions()
    found = edge(3, 102, planar(0.5, -2, 0.7), "loop")
    graph.join(found)
    before = graph.poses()
    graph.remove_edge(found)
    assert set(graph.component(3)) == {0, 1, 2, 3}
    assert set(graph.component(100)) == {100, 101, 102, 103}
    graph.optimise()
    for i, T in before.items():
        np.testing.assert_allclose(graph.pose(i), T, atol=1e-6)
    # Held by its first vertex, when something in it changes.
    motion = invert(graph.pose(100)) @ graph.pose(103)
    graph.add_edge(edge(100, 103, motion @ planar(0.03, 0, 0), "loop"))
    graph.optimise()
    np.testing.assert_allclose(graph.pose(100), before[100], atol=1e-6)
    assert error_of(graph.pose(103), before[103])[0] > 0.01


def test_a_closure_that_joined_wrongly_can_be_outvoted():
    """Several later ones agree with each other and not with it."""
    graph = sessions(12)
    graph.join(edge(2, 102, planar(5.0, 3.0, 1.0), "loop"))
    graph.optimise()
    truth = planar(0.3, 0.1)
    for i in (4, 6, 8, 10):
        graph.add_edge(edge(i, 100 + i, truth, "loop"))
    graph.optimise()
    graph.optimise(reconsider=True)
    assert [(e.source, e.target) for e in graph.rejected] == [(2, 102)]
    for i in (4, 10):
        assert error_of(invert(graph.pose(i)) @ graph.pose(100 + i), truth)[0] < 0.05


def test_a_root_cannot_be_removed_until_its_component_is_joined():
    graph = sessions()
    with pytest.raises(ValueError, match="holds its component"):
        graph.remove_vertex(100)
    assert 100 in graph
    graph.join(edge(3, 102, planar(0.5, -2, 0.7), "loop"))
    graph.remove_vertex(100)
    assert 100 not in graph
    with pytest.raises(ValueError, match="holds its component"):
        graph.remove_vertex(0)


def test_a_removed_vertex_takes_its_edges_along():
    truth, odometry, rng = laps(11, 40)
    loops = [closure(truth, i, i + 30, rng) for i in range(0, 10, 2)]
    wrong = closure(truth, 4, 33, rng, planar(5, 5, 1))
    graph = graph_of([*odometry, *loops, wrong], 40)
    graph.optimise()
    assert graph.rejected == [wrong]
    assert graph.incident(4) == [odometry[3], odometry[4], loops[2]]
    removed = graph.remove_vertex(4)
    assert removed == [odometry[3], odometry[4], loops[2], wrong]
    assert graph.rejected == []
    assert graph.edges == [e for e in [*odometry, *loops] if 4 not in (e.source, e.target)]
    assert graph.edge_count == len(graph.edges)
    assert len(graph) == 39
    assert 4 not in graph
    assert 4 not in graph.poses()
    assert graph.incident(3) == [odometry[2]]
    assert graph.vertices == [*range(4), *range(5, 40)]


def test_a_removed_vertex_and_the_edges_across_it_may_come_again():
    graph = graph_of([edge(i, i + 1, planar(1, 0)) for i in range(3)], 4)
    graph.remove_vertex(3)
    graph.add_odometry(edge(2, 3, planar(2, 0)))
    graph.optimise()
    np.testing.assert_allclose(graph.pose(3), planar(4, 0), atol=1e-9)


def test_a_removed_edge_has_no_say_any_more():
    truth, odometry, rng = laps(12, 40)
    loops = [closure(truth, i, i + 30, rng) for i in (0, 4, 8)]
    graph, without = graph_of([*odometry, *loops], 40), graph_of([*odometry, *loops[:2]], 40)
    for each in (graph, without):
        each.optimise()
    graph.remove_edge(loops[2])
    graph.optimise()
    assert graph.edges == without.edges
    assert graph.between(8, 38) == []
    assert largest_error(graph, without.poses().values()) < 1e-3
    assert graph.chi_square() == pytest.approx(without.chi_square(), rel=1e-3)
    with pytest.raises(KeyError, match="8 -> 38"):
        graph.remove_edge(loops[2])


def test_of_equal_edges_only_the_one_that_was_given_is_removed():
    first, second = (edge(0, 1, planar(1, 0), "loop") for _ in range(2))
    graph = graph_of([edge(0, 1, planar(1, 0)), first, second], 2)
    graph.remove_edge(first)
    assert len(graph.between(0, 1)) == 2
    assert graph.between(0, 1)[1] is second


def test_a_vertex_follows_its_neighbours_as_gtsam_would_have_it():
    """Its gains against the optimum, anew, of the vertex alone among neighbours that have moved."""
    rng = np.random.default_rng(14)
    truth, odometry, _ = laps(14, 40)
    loops = [
        edge(i, i + 30, invert(truth[i]) @ truth[i + 30], "loop", full_covariance(rng))
        for i in (4, 5)
    ]
    graph = graph_of([*odometry, *loops, edge(4, 20, invert(truth[4]) @ truth[20], "loop")], 40)
    graph.optimise()
    neighbours, gains = graph.conditional(4)
    assert neighbours == [3, 5, 20, 34]
    moves = rng.normal(size=(4, 6)) * 1e-3
    alone, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(4, gtsam.Pose3(graph.pose(4)))
    for i, move in zip(neighbours, moves, strict=True):
        moved = gtsam.Pose3(graph.pose(i) @ exp(move))
        values.insert(i, moved)
        alone.push_back(gtsam.NonlinearEqualityPose3(i, moved))
    for e in graph.incident(4):
        model = gtsam.noiseModel.Gaussian.Covariance(e.covariance)
        alone.push_back(
            gtsam.BetweenFactorPose3(e.source, e.target, gtsam.Pose3(e.T_source_target), model)
        )
    best = gtsam.LevenbergMarquardtOptimizer(alone, values).optimize().atPose3(4).matrix()
    predicted = graph.pose(4) @ exp(np.einsum("kij,kj->i", gains, moves))
    moved_by = error_of(best, graph.pose(4))[0]
    assert moved_by > 5e-4
    assert error_of(predicted, best)[0] < 0.05 * moved_by


def test_in_the_middle_of_two_a_vertex_moves_by_half():
    graph = graph_of([edge(0, 1, planar(1, 0)), edge(1, 2, planar(1, 0))], 3)
    neighbours, gains = graph.conditional(1)
    assert neighbours == [0, 2]
    along = gains[:, 3, 3]
    np.testing.assert_allclose(along, [0.5, 0.5], atol=1e-6)


def slipped(slip=0.33):
    """Return true poses of two laps, and a graph whose odometry slipped, sure of itself, half-way."""
    truth, odometry, rng = laps(15)
    slip_at = odometry[20]
    odometry[20] = edge(20, 21, slip_at.T_source_target @ planar(slip, 0, 0))
    graph = graph_of(odometry, 60)
    for i in (22, 24):  # across nothing that slipped
        graph.add_edge(closure(truth, i, i + 30, rng))
    graph.optimise()
    assert not graph.rejected
    return graph, truth, rng


def test_a_closure_that_contradicts_is_set_aside_until_several_say_the_same():
    graph, truth, rng = slipped()
    before = graph.poses()
    contradicting = [closure(truth, i, i + 30, rng) for i in (0, 5, 10)]
    for count, loop in enumerate(contradicting[:2], 1):
        graph.add_edge(loop)
        graph.optimise()
        assert graph.rejected == contradicting[:count]
        assert largest_error(graph, before.values()) < 1e-6
    graph.add_edge(contradicting[2])
    graph.optimise()
    assert graph.rejected == []
    for loop in contradicting:
        assert disagreement(loop, graph.poses()) < 22.5


def test_what_is_set_aside_is_not_what_agrees_and_came_with_it():
    graph, truth, rng = slipped()
    good, bad = closure(truth, 26, 56, rng), closure(truth, 3, 33, rng, planar(4, 2, 0.5))
    for loop in (bad, good):
        graph.add_edge(loop)
    graph.optimise()
    assert graph.rejected == [bad]
    assert good in graph.edges


def test_what_was_set_aside_comes_in_when_asked_to_reconsider_and_enough_agree():
    graph, truth, rng = slipped()
    contradicting = [closure(truth, i, i + 30, rng) for i in (0, 5)]
    for loop in contradicting:
        graph.add_edge(loop)
        graph.optimise()
    assert graph.rejected == contradicting
    graph.optimise(reconsider=True)
    assert graph.rejected == []


def test_derived_closures_in_place_of_others_change_nothing():
    graph, truth, rng = slipped()
    before = graph.poses()
    for old in [e for e in graph.edges if e.kind == "loop"]:
        graph.remove_edge(old)
        again = edge(old.source, old.target, old.T_source_target, "loop", old.covariance)
        graph.add_edge(again, derived=True)
    # They aren't news that would excuse what the next closure costs all edges together.
    contradicting = closure(truth, 0, 30, rng)
    graph.add_edge(contradicting)
    graph.optimise()
    assert graph.rejected == [contradicting]
    assert largest_error(graph, before.values()) < 1e-6


def test_a_derived_closure_can_be_outvoted():
    truth, odometry, rng = laps(16)
    wrong = closure(truth, 7, 40, rng, planar(1.0, 0.5, 0.1))
    graph = graph_of(odometry, 60)
    graph.add_edge(wrong, derived=True)
    for i in range(0, 30, 4):
        graph.add_edge(closure(truth, i, i + 30, rng))
    graph.optimise()
    graph.optimise(reconsider=True)
    assert graph.rejected == [wrong]
