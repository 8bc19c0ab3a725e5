"""Taking vertices and edges out of a pose graph."""

import gtsam
import numpy as np
import pytest
from graph_support import closure, edge, full_covariance, graph_of, laps, largest_error
from slam_support import error_of, planar

from lifelong_slam.geometry import exp, invert


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


def test_what_is_set_aside_has_no_say_in_how_a_vertex_follows_or_what_is_between_two():
    truth, odometry, rng = laps(11, 40)
    loops = [closure(truth, i, i + 30, rng) for i in range(0, 10, 2)]
    wrong = closure(truth, 4, 34, rng, planar(5, 5, 1))
    graph, without = graph_of([*odometry, *loops, wrong], 40), graph_of([*odometry, *loops], 40)
    for each in (graph, without):
        each.optimise()
    assert graph.rejected == [wrong]
    assert graph.between(4, 34) == [loops[2]]
    neighbours, gains = graph.conditional(4)
    assert neighbours == [3, 5, 34]
    np.testing.assert_allclose(gains, without.conditional(4)[1], atol=1e-3)
    graph.remove_edge(loops[2])
    assert graph.between(4, 34) == []
    assert graph.conditional(4)[0] == [3, 5]


def test_a_graph_becomes_again_what_its_copy_has_kept():
    truth, odometry, rng = laps(11, 40)
    loops = [closure(truth, i, i + 30, rng) for i in range(0, 10, 2)]
    wrong = closure(truth, 4, 33, rng, planar(5, 5, 1))
    graph = graph_of([*odometry, *loops, wrong], 40)
    graph.optimise()
    poses, edges, chi_square = graph.poses(), graph.edges, graph.chi_square()
    kept = graph.checkpoint()
    for _ in range(2):
        graph.remove_vertex(4)
        graph.remove_edge(loops[0])
        graph.add_vertex(50, truth[0])
        graph.add_odometry(edge(50, 51, planar(1, 0)))
        graph.add_edge(closure(truth, 1, 31, rng, planar(0.1, 0)))
        graph.optimise()
        for each in (kept, graph):
            if each is graph:
                graph.rollback(kept)
            assert each.edges == edges
            assert each.rejected == [wrong]
            assert each.roots == [0]
            assert each.vertices == list(range(40))
            assert each.incident(4) == [odometry[3], odometry[4], loops[2]]
            assert each.chi_square() == chi_square
            assert all((each.pose(i) == T).all() for i, T in poses.items())


def test_relaxing_finds_the_optimum_without_a_vote():
    truth, odometry, rng = laps(12, 40)
    loops = [closure(truth, i, i + 30, rng) for i in (0, 4, 8)]
    wrong = closure(truth, 5, 35, rng, planar(5, 5, 1))
    graph = graph_of([*odometry, *loops, wrong], 40)
    graph.optimise()
    assert graph.rejected == [wrong]
    moved = [T @ exp(0.01 * rng.normal(size=6)) if i else T for i, T in graph.poses().items()]
    expected = graph.poses().values()
    for vertex, T in enumerate(moved):
        graph._values.update(vertex, gtsam.Pose3(T))
    graph._is_optimal = False
    assert graph.chi_square() == pytest.approx(graph.chi_square(dict(enumerate(moved))))
    assert graph.chi_square() > 100
    graph.relax()
    assert largest_error(graph, expected) < 1e-3
    assert graph.rejected == [wrong]
    outlier = closure(truth, 9, 39, rng, planar(1, 0, 0))
    graph.add_edge(outlier)
    graph.relax()
    assert outlier in graph.edges
    graph.optimise()  # has still to accept it
    assert graph.rejected == [wrong, outlier]
