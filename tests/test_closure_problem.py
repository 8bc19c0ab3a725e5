"""The condensed problem of a vote: the same optimum as the whole graph's, and its covariances."""

import gtsam
import numpy as np
import pytest
from g2o_support import laps as file_laps
from graph_support import (
    chained,
    closure,
    edge,
    full_covariance,
    gtsam_graph,
    gtsam_values,
    laps,
)
from slam_support import error_of, planar

from lifelong_slam.geometry import invert
from lifelong_slam.graph.closure_problem import ClosureProblem, Trusted
from lifelong_slam.graph.reduction import loaded
from lifelong_slam.graph.robust import vote


def problem_of(seed=0, pairs=((0, 30), (7, 37), (20, 50)), **settings):
    truth, odometry, rng = laps(seed, **settings)
    odometry = [
        edge(e.source, e.target, e.T_source_target, covariance=full_covariance(rng))
        for e in odometry
    ]
    closures = [closure(truth, i, j, rng) for i, j in pairs]
    poses = chained(odometry)
    problem = ClosureProblem(poses, Trusted(odometry, [0]), closures, planar=False)
    return problem, poses, odometry, closures


def whole_graph(odometry, closures):
    """Return GTSAM's optimum of all edges, its chi-square and marginals."""
    graph = gtsam_graph([*odometry, *closures])
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, gtsam_values(chained(odometry)))
    values = optimiser.optimize()
    return values, 2 * graph.error(values), gtsam.Marginals(graph, values)


def test_only_what_closures_touch_is_left():
    problem, _, odometry, _ = problem_of()
    assert problem.vertices == [0, 7, 20, 30, 37, 50]
    assert len(problem) == 3
    assert len(odometry) == 59


@pytest.mark.parametrize("accepted", [(), (1,), (0, 1, 2)])
def test_the_optimum_is_that_of_the_whole_graph(accepted):
    problem, poses, odometry, closures = problem_of()
    values, chi_square = problem.solve(accepted, problem.values(poses))
    used = [closures[k] for k in accepted]
    expected, whole, _ = whole_graph(odometry, used)
    # Composition is of first order.
    assert chi_square == pytest.approx(whole, rel=0.01, abs=1e-6)
    found = problem.poses(values)
    assert sorted(found) == list(range(60))
    for vertex in problem.vertices:
        assert error_of(found[vertex], expected.atPose3(vertex).matrix())[0] < 0.002
    for vertex in range(60):
        assert error_of(found[vertex], expected.atPose3(vertex).matrix())[0] < 0.05


def test_what_hangs_on_the_last_closure_follows_it_by_odometry():
    problem, poses, odometry, _ = problem_of()
    values, _ = problem.solve((0, 1, 2), problem.values(poses))
    found = problem.poses(values)
    for e in odometry[50:]:
        step = invert(found[e.source]) @ found[e.target]
        np.testing.assert_allclose(step, e.T_source_target, atol=1e-9)


def test_covariances_of_predictions_are_those_of_gtsam():
    problem, poses, odometry, closures = problem_of()
    accepted = (0,)
    values, _ = problem.solve(accepted, problem.values(poses))
    around = problem.linearise(accepted, values)
    _, _, marginals = whole_graph(odometry, [closures[0]])
    every = np.arange(len(problem))
    exact, rough = around.spread(every), around.sampled_spread
    for k, measured in enumerate(closures):
        factor = gtsam.BetweenFactorPose3(
            measured.source,
            measured.target,
            gtsam.Pose3(measured.T_source_target),
            gtsam.noiseModel.Gaussian.Covariance(measured.covariance),
        )
        A, b = factor.linearize(values).jacobian()
        keys = gtsam.KeyVector([measured.source, measured.target])
        expected = A @ marginals.jointMarginalCovariance(keys).fullMatrix() @ A.T
        np.testing.assert_allclose(around.residuals[k], b)
        scale = np.trace(expected)
        np.testing.assert_allclose(exact[k], expected, atol=0.02 * scale)
        np.testing.assert_allclose(rough[k], exact[k], atol=0.6 * scale)
    joint = around.joint_spread(every)
    np.testing.assert_allclose(joint[1, 2], joint[2, 1].T, atol=1e-9 * np.abs(joint).max())


def test_adding_and_dropping_a_closure_costs_what_the_closed_forms_say():
    problem, poses, _, _ = problem_of(seed=3)
    start = problem.values(poses)
    with_two, two = problem.solve((0, 1), start)
    _, three = problem.solve((0, 1, 2), with_two)
    around = problem.linearise((0, 1), with_two)
    e, P = around.residuals, around.spread(np.arange(3))
    rise = e[2] @ np.linalg.solve(np.eye(6) + P[2], e[2])
    assert three - two == pytest.approx(rise, rel=0.05)
    _, one = problem.solve((0,), with_two)
    fall = e[1] @ np.linalg.solve(np.eye(6) - P[1], e[1])
    assert two - one == pytest.approx(fall, rel=0.05)


def test_planar_graphs_have_three_degrees_of_freedom():
    graph, _ = file_laps(planar=True, seed=2)
    odometry = [e for e in graph.edges if e.kind == "odometry"]
    closures = [e for e in graph.edges if e.kind == "loop"]
    problem = ClosureProblem(graph.poses, Trusted(odometry, [0]), closures, planar=True)
    every = range(len(problem))
    values, chi_square = problem.solve(every, problem.values(graph.poses))
    assert problem.dof == 3
    trusting = loaded(graph, robust=False)
    trusting.optimise()
    assert chi_square == pytest.approx(trusting.chi_square(), rel=1e-3)
    for vertex, T in problem.poses(values).items():
        np.testing.assert_allclose(T, trusting.pose(vertex), atol=2e-3)


def test_a_part_that_only_closures_reach_goes_where_they_put_it():
    odometry = [edge(i, i + 1, planar(1, 0, 0.1)) for i in (0, 1, 2, 100, 101, 102)]
    poses = chained(odometry[:3])
    poses |= {100 + i: planar(500, 30, 2.0) @ T for i, T in poses.items()}
    there = planar(0.5, -2, 0.7)
    closures = [edge(3, 101, there, "loop"), edge(0, 100, planar(9, 9, 1), "loop")]
    problem = ClosureProblem(poses, Trusted(odometry, [0]), closures, planar=False)
    values, chi_square = problem.solve((0,), problem.values(poses))
    found = problem.poses(values)
    assert chi_square < 0.1
    assert error_of(invert(found[3]) @ found[101], there)[0] < 0.01
    alone, _ = problem.solve((), problem.values(poses))
    assert error_of(problem.poses(alone)[100], poses[100])[0] < 1e-6


def test_chained_poses_begin_at_the_anchors():
    odometry = [edge(i, i + 1, planar(1, 0, 0)) for i in range(6)]
    poses = {i: planar(2 * i, 0) for i in range(7)}
    closures = [edge(1, 5, planar(4, 0), "loop")]
    problem = ClosureProblem(poses, Trusted(odometry, [0, 6]), closures, planar=False)
    found = problem.poses(problem.chained(poses))
    np.testing.assert_allclose(found[6], poses[6])
    assert found[1][0, 3] in (pytest.approx(1.0), pytest.approx(7.0))


def test_a_glance_at_a_singular_problem_stays_where_it_began():
    problem, poses, _, _ = problem_of()
    nowhere = problem.values({vertex: np.eye(4) for vertex in poses})
    values, chi_square = problem.glance((0, 1, 2), nowhere)
    assert np.isfinite(chi_square)
    assert values.size() == len(problem.vertices)


def test_a_closure_between_vertices_that_are_held_has_nothing_to_move():
    held = {0: np.eye(4), 1: planar(1, 0)}
    true, wrong = edge(0, 1, planar(1, 0), "loop"), edge(0, 1, planar(5, 0), "loop")
    problem = ClosureProblem(held, Trusted([], [0, 1]), [true, wrong], planar=False)
    choice = vote(problem, [((), problem.values(held))])
    assert choice.accepted == {0}
