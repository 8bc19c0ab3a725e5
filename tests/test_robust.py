"""The vote: its objective against closed forms, and what it chooses among true and wrong closures."""

import gtsam
import numpy as np
import pytest
from graph_support import chained, closure, edge, gtsam_graph, gtsam_values, laps
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.stats import chi2
from slam_support import error_of, planar

from lifelong_slam.geometry import invert
from lifelong_slam.graph.closure_problem import ClosureProblem, Trusted
from lifelong_slam.graph.robust import fitted, objective, threshold, vote

SIGMAS = np.array([1e-4, 1e-4, 0.01, 0.05, 0.05, 1e-3])


def value(chi_square, accepted, rejected=0, dof=3, scaled=True):
    return float(
        objective(np.array(chi_square), np.array(accepted), np.array(rejected), dof, scaled)
    )


@pytest.mark.parametrize("dof", [3, 6])
def test_without_closures_the_objective_is_a_threshold_for_each(dof):
    assert threshold(dof) == pytest.approx(chi2.ppf(0.999, dof))
    assert value(0.0, 0, 7, dof) == pytest.approx(7 * threshold(dof))


@given(chi_square=st.floats(0, 1e5), accepted=st.integers(0, 300))
def test_the_scale_is_the_best_between_a_third_and_three(chi_square, accepted):
    n = 3 * accepted

    def fit(log_s2):
        s2 = np.exp(log_s2)
        return (chi_square + 30) / s2 + (n + 30) * log_s2 - 30

    best = minimize_scalar(fit, bounds=(-np.log(9), np.log(9)), method="bounded")
    assert value(chi_square, accepted) == pytest.approx(best.fun, rel=1e-3, abs=1e-3)


def test_where_closures_fit_better_than_they_claim_less_is_forgiven():
    def limit(chi_square, accepted):
        """Return the rise at which one more closure makes no difference."""
        rises = np.linspace(0, 200, 20001)
        after = objective(chi_square + rises, np.array(accepted + 1), np.array(0), 3)
        return rises[np.searchsorted(after, value(chi_square, accepted, 1))]

    assert limit(0.0, 0) == pytest.approx(threshold(3), rel=0.2)
    assert limit(3.0 * 200, 200) == pytest.approx(threshold(3), rel=0.05)
    assert limit(0.1 * 200, 200) < threshold(3) / 4
    assert limit(27.0 * 200, 200) > 4 * threshold(3)


def test_composed_edges_leave_the_scale_alone():
    assert value(5.0, 100, 3, scaled=False) == pytest.approx(5.0 + 3 * threshold(3))


def problem_of(odometry, closures):
    poses = chained(odometry)
    problem = ClosureProblem(poses, Trusted(odometry, [0]), closures, planar=False)
    return problem, problem.chained(poses)


def two_laps(seed, scale=1.0, sigmas=SIGMAS):
    """Return true poses, odometry whose standard deviations are stated `scale` times, and a generator."""
    truth, odometry, rng = laps(seed, 80, 40, sigmas=sigmas)
    stated = scale**2 * np.diag(sigmas**2)
    return (
        truth,
        [edge(e.source, e.target, e.T_source_target, covariance=stated) for e in odometry],
        rng,
    )


def wrong_closures(truth, count, rng):
    """Return closures that take random places for one another."""
    made = []
    while len(made) < count:
        i, j = np.sort(rng.choice(len(truth), 2, replace=False))
        there = planar(rng.normal(), rng.normal(), rng.uniform(-3, 3))
        if np.linalg.norm((invert(truth[i]) @ truth[j] @ invert(there))[:3, 3]) > 3:
            made.append(edge(int(i), int(j), there, "loop"))
    return made


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.sampled_from([0.1, 0.3, 0.5]))
def test_true_closures_in_and_random_wrong_ones_out(seed, share):
    truth, odometry, rng = two_laps(seed)
    true = [closure(truth, i, i + 40, rng) for i in range(0, 40, 2)]
    wrong = wrong_closures(truth, round(share / (1 - share) * len(true)), rng)
    problem, start = problem_of(odometry, [*true, *wrong])
    choice = vote(problem, [((), start)])
    right = fitted(problem, [(range(len(true)), choice.values)])
    assert choice.objective <= right.objective + 1e-3
    assert len(choice.accepted - right.accepted) <= 1
    assert len(right.accepted - choice.accepted) <= 1


@pytest.mark.parametrize("seed", range(4))
def test_odometry_that_is_three_times_as_sure_as_it_should_be_is_outvoted(seed):
    truth, odometry, rng = two_laps(seed, scale=1 / 3)
    true = [closure(truth, i, i + 40, rng) for i in range(0, 40, 2)]
    problem, start = problem_of(odometry, [*true, *wrong_closures(truth, 5, rng)])
    choice = vote(problem, [((), start)])
    assert not choice.accepted & set(range(20, 25))
    assert len(choice.accepted) >= 16
    right = fitted(problem, [(range(20), choice.values)])
    drift, *errors = (
        largest_error(problem.poses(values), truth)
        for values in (start, right.values, choice.values)
    )
    assert errors[1] < max(1.3 * errors[0], 0.1 * drift)


def largest_error(poses, truth):
    return max(error_of(T, truth[i])[0] for i, T in poses.items())


def aliased(truth, first, count, apart, rng):
    """Return wrong closures that agree: a stretch looks like the one some vertices later."""
    same = invert(invert(truth[first]) @ truth[first + apart])
    return [closure(truth, i, i + apart, rng, same) for i in range(first, first + count)]


@pytest.mark.parametrize(("true", "wrong"), [(12, 6), (10, 0), (20, 15), (0, 30)])
@pytest.mark.parametrize("apart", [6, 20])
def test_of_closures_that_agree_in_themselves_the_greater_number_wins(true, wrong, apart):
    truth, odometry, rng = two_laps(5)
    right = [closure(truth, i, i + 40, rng) for i in range(true)]
    alike = aliased(truth, 3, wrong, apart, rng)
    problem, start = problem_of(odometry, [*right, *alike])
    choice = vote(problem, [((), start)])
    assert choice.accepted == frozenset(range(true))


def test_later_evidence_overturns_what_was_accepted_before():
    """On the second lap a place is taken for one further on, as drift allows, until more is seen."""
    truth, odometry, rng = two_laps(2, sigmas=SIGMAS * [1, 1, 5, 5, 5, 1])
    further = invert(truth[0]) @ truth[6]
    alike = [closure(truth, i + 6, i + 40, rng, further) for i in (5, 6, 7, 8)]
    problem, start = problem_of(odometry, alike)
    first = vote(problem, [((), start)])
    assert len(first.accepted) == 4
    right = [closure(truth, i, i + 40, rng) for i in range(2, 12)]
    problem, start = problem_of(odometry, [*alike, *right])
    second = vote(problem, [(range(4), start)])
    assert second.accepted == frozenset(range(4, 14))


@pytest.mark.parametrize("seed", range(6))
def test_it_never_ends_worse_than_odometry_alone_what_was_in_use_or_gnc(seed):
    truth, odometry, rng = two_laps(seed)
    true = [closure(truth, i, i + 40, rng) for i in range(0, 40, 4)]
    closures = [*true, *wrong_closures(truth, 10, rng)]
    problem, start = problem_of(odometry, closures)
    before = [k for k in range(len(closures)) if rng.random() < 0.5]
    choice = vote(problem, [((), start), (before, start)])
    rivals = [(), before, by_gnc(odometry, closures)]
    for accepted in rivals:
        rival = fitted(problem, [(accepted, start), (accepted, choice.values)])
        assert choice.objective <= rival.objective + 1e-3


def by_gnc(odometry, closures):
    """Return the closures that GTSAM's graduated non-convexity lets in."""
    graph = gtsam_graph([*odometry, *closures])
    values = gtsam_values(chained(odometry))
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(len(odometry) + 1)))
    optimiser = gtsam.GncLMOptimizer(graph, values, params)
    optimiser.setInlierCostThresholdsAtProbability(0.99)
    optimiser.optimize()
    weights = np.asarray(optimiser.getWeights())[len(odometry) + 1 :]
    return np.flatnonzero(weights >= 0.5).tolist()
