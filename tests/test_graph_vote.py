"""Loop closures that are wrong, or contradict what the graph believes."""

import numpy as np
from graph_support import closure, disagreement, edge, graph_of, laps, largest_error
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from slam_support import error_of, planar

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


def slipped(slip=0.5):
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


def test_a_closure_that_contradicts_is_rejected_until_several_say_the_same():
    graph, truth, rng = slipped()
    before = graph.poses()
    contradicting = [closure(truth, i, i + 30, rng) for i in range(0, 14, 2)]
    graph.add_edge(contradicting[0])
    graph.optimise()
    assert graph.rejected == contradicting[:1]
    assert largest_error(graph, before.values()) < 1e-6
    for loop in contradicting[1:]:
        graph.add_edge(loop)
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
