"""The optimum of a pose graph against closed forms and plain GTSAM."""

import gtsam
import numpy as np
import pytest
from graph_support import COVARIANCE, closure, disagreement, edge, full_covariance, graph_of, laps
from slam_support import planar

from lifelong_slam.geometry import invert
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.result import Prior


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


def test_fixed_vertices_and_priors_take_the_place_of_a_root():
    """The third part has neither, and hangs on its lowest vertex."""
    poses = {i: planar(float(i), 0, 0) for i in range(9)}
    links = (0, 1, 3, 4, 6, 7)
    edges = {i: edge(i, i + 1, planar(1.5, 0, 0)) for i in links}
    prior = Prior(4, planar(10.0, 0, 0), COVARIANCE)
    graph = PoseGraph()
    graph.restore(poses, edges, solved=False, fixed=[1], priors=[prior])
    assert graph.held == {1, 4, 6}
    assert graph.edge_count == 6
    graph.optimise()
    found = [graph.pose(i)[0, 3] for i in range(9)]
    np.testing.assert_allclose(found, [-0.5, 1, 2.5, 8.5, 10, 11.5, 6, 7.5, 9], atol=1e-6)
    assert graph.chi_square() == pytest.approx(0, abs=1e-9)
    assert (graph.snapshot().fixed, graph.snapshot().priors) == ((1,), (prior,))
    for vertex in (1, 4):
        with pytest.raises(ValueError, match="holds its component"):
            graph.remove_vertex(vertex)
    graph.remove_vertex(5)
    assert 5 not in graph


def test_priors_count_against_a_closure():
    """Two sure priors 10 m apart, and a closure that says 14 m: without them it would bend odometry."""
    loose = 25 * np.eye(6)
    edges = {
        0: edge(0, 1, planar(10, 0, 0), covariance=loose),
        1: edge(0, 1, planar(14, 0, 0), "loop"),
    }
    poses = {0: np.eye(4), 1: planar(10, 0, 0)}
    priors = [Prior(i, T, COVARIANCE) for i, T in poses.items()]
    for known, rejected in (([], 0), (priors, 1)):
        graph = PoseGraph()
        graph.restore(poses, edges, solved=False, priors=known)
        graph.optimise()
        assert len(graph.rejected) == rejected
