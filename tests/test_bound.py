"""Pruning doesn't move what stays by more than its covariance, in metres and radians."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from graph_support import closure, edge, graph_of, laps
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from slam_support import error_of, planar

from lifelong_slam.geometry import exp, invert, log
from lifelong_slam.graph.bound import MAX_DISTANCE, Bound
from lifelong_slam.graph.marginalisation import ChowLiu, Dense, StarMesh
from lifelong_slam.graph.pruning import CHECKED, REFUSED, UNDONE, Pruner
from lifelong_slam.graph.reduction import loaded
from lifelong_slam.graph.removal import Removal, recover
from lifelong_slam.graph.selection import Decimate, Random
from lifelong_slam.result import Edge, GraphSnapshot


def lattice(seed, sigma, sigma_angle, error=1.0, count=40, scale=1.0):
    """Return an optimised graph that winds through a grid, whose columns closures tie together.

    Standard deviations of its edges lie within a factor of two of `sigma` (m) and `sigma_angle` (rad); the
    true errors are `error` times as large. All covariances are multiplied by `scale`.
    """
    rng = np.random.default_rng(seed)
    truth = []
    for i in range(count):
        row, column = divmod(i, 5)
        x = column if row % 2 == 0 else 4 - column
        truth.append(planar(4.0 * x, 4.0 * row, rng.uniform(-1, 1), 0.3 * rng.normal()))
    pairs = [(i, i + 1, "odometry") for i in range(count - 1)]
    pairs += [(i, 2 * 5 * (i // 5 + 1) - 1 - i % 5, "loop") for i in range(count)]
    edges = []
    for i, j, kind in pairs:
        if j < count and j - i >= (1 if kind == "odometry" else 2):
            sigmas = np.repeat([sigma_angle, sigma], 3) * 2.0 ** rng.uniform(-1, 1, 6)
            Z = invert(truth[i]) @ truth[j] @ exp(error * sigmas * rng.normal(size=6))
            edges.append(Edge(i, j, Z, scale * np.diag(sigmas**2), kind))
    graph = loaded(GraphSnapshot(dict(enumerate(truth)), edges), robust=False)
    graph.optimise()
    graph.relax()
    return graph


def distances(before, graph):
    """Return what GTSAM says vertices have moved by: the squared Mahalanobis distance of each."""
    nonlinear = before._nonlinear_graph(before._loops - before._rejected)
    marginals = gtsam.Marginals(nonlinear, before._values)
    moved = {i: log(invert(before.pose(i)) @ graph.pose(i)) for i in graph.vertices if i}
    return [d @ np.linalg.solve(marginals.marginalCovariance(i), d) for i, d in moved.items()]


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    seed=st.integers(0, 10_000),
    sigma=st.floats(1e-3, 1.0),
    sigma_angle=st.floats(1e-3, 0.7),
    error=st.floats(0.01, 1.0),
    method=st.sampled_from([StarMesh(), StarMesh(arms=3, max_edges=4), ChowLiu(), Dense()]),
)
def test_nothing_that_stays_moves_by_more_than_its_covariance(
    seed, sigma, sigma_angle, error, method
):
    graph = lattice(seed, sigma, sigma_angle, error)
    before = graph.checkpoint()
    bound = Bound(graph)
    pruner = Pruner(Random(seed=seed), method)
    removals = pruner.reduce(graph, 14)
    rise = before.chi_square(recover(graph.poses(), removals)) - before.chi_square()
    assert rise <= 6 * max(len(removals), 1) * bound.variance * 1.01
    # Where the rise is negative the graph wasn't at its optimum, and what stays has found a better one.
    assert rise < 0 or max(distances(before, graph)) <= 1.01 * MAX_DISTANCE * bound.variance
    assert len(graph) + len(removals) == 40
    assert len(graph) == 14 + pruner.counts[REFUSED]


@pytest.mark.parametrize("selection", [Decimate(), Random()], ids=lambda s: type(s).__name__)
def test_edges_that_claim_to_know_little_are_not_bent(selection):
    """Sigmas of 0.5 m and 1 rad, errors a hundredth of that; arms of 4 m lead to sigmas of metres."""
    graph = lattice(3, 0.5, 1.0, error=0.01, count=80)
    before = graph.poses()
    Pruner(selection, StarMesh()).reduce(graph, 40)
    graph.optimise()
    moved = [error_of(graph.pose(i), before[i])[0] for i in graph.vertices]
    assert len(graph) < 60
    assert np.mean(moved) < 0.15
    assert max(moved) < 0.5


def test_the_unit_of_the_covariances_changes_nothing():
    poses = []
    for scale in (1.0, 1 / 16):
        graph = lattice(5, 0.2, 0.2, error=0.2, scale=scale)
        Pruner(Decimate(), StarMesh()).reduce(graph, 14)
        graph.relax()
        poses.append(graph.poses())
    assert poses[0].keys() == poses[1].keys()
    assert max(error_of(poses[0][i], T)[0] for i, T in poses[1].items()) < 1e-3


@pytest.mark.parametrize(("error", "factor"), [(0.1, 1e-2), (0.5, 0.25), (3.0, 1.0), (1e-4, 1e-4)])
def test_the_variance_factor_is_what_residuals_show(error, factor):
    graph = lattice(6, 0.01, 0.01, error, count=150)
    assert Bound(graph).variance == pytest.approx(factor, rel=0.15)


def moved_chain(distance, count=30):
    """Return a chain, and the same with its vertices moved evenly, the last by `distance` sigmas."""
    steps = [edge(i, i + 1, planar(1.0, 0)) for i in range(count)]
    graph = graph_of(steps, count + 1)
    share = distance * 0.01 * np.sqrt(count) / count
    longer = [replace(e, T_source_target=planar(1.0 + share, 0)) for e in steps]
    return graph, graph_of(longer, count + 1)


def gone(count):
    """Return removals of vertices that aren't there, but have a say in how many went."""
    T, gain = np.eye(4)[None], np.eye(6)[None]
    return [Removal(9000 + i, np.array([0]), T, gain) for i in range(count)]


@pytest.mark.parametrize(
    ("squared", "count", "allowed"),
    [(5.0, 1, True), (7.0, 1, False), (7.0, 2, True), (21.0, 10, True), (24.0, 10, False)],
)
def test_all_together_and_each_by_itself_are_bounded(squared, count, allowed):
    """A chain has no redundancy: its factor is 1. All of the move is the last vertex's own distance."""
    graph, moved = moved_chain(np.sqrt(squared))
    bound = Bound(graph)
    assert bound.allows(moved, gone(count)) == allowed
    assert (bound._information is None) == (squared < MAX_DISTANCE)  # which takes time


def test_of_a_graph_of_many_vertices_some_are_watched():
    graph, moved = moved_chain(np.sqrt(40.0), count=450)
    bound = Bound(graph)
    assert not bound.allows(moved, gone(100))
    assert len(bound._information) <= 100


class Bends:
    """Marginalises as StarMesh does, but some vertices wrongly."""

    leaves_edges = True

    def __init__(self, *guilty):
        self._guilty = guilty

    def remove(self, graph, vertex, lasting):
        ends = [e.target if e.source == vertex else e.source for e in graph.incident(vertex)]
        StarMesh().remove(graph, vertex, lasting)
        if vertex in self._guilty:
            T = invert(graph.pose(ends[0])) @ graph.pose(ends[1]) @ planar(1.0, 0)
            graph.add_edge(Edge(ends[0], ends[1], T, 1e-6 * np.eye(6), "odometry"))


class Chosen:
    """Removes what it is told, and notes which of the older ones it could have had."""

    def __init__(self, *vertices):
        self._vertices, self.older = vertices, []

    def settle(self, poses, new, older):
        self.older.append(set(older))
        return [vertex for vertex in self._vertices if vertex in new]

    def reduce(self, poses, removable, count):
        return list(self._vertices)


def two_laps(seed=21):
    truth, odometry, rng = laps(seed)
    graph = graph_of([*odometry, *(closure(truth, i, i + 30, rng) for i in range(0, 30, 3))], 60)
    graph.optimise()
    return graph


def test_a_vertex_that_cannot_go_without_moving_others_is_refused():
    graph, before, clean = two_laps(), two_laps().poses(), two_laps()
    pruner = Pruner(Chosen(3, 4, 5, 7, 8), Bends(5))
    removals = pruner.reduce(graph, 0)
    assert [removal.vertex for removal in removals] == [3, 4, 7, 8]
    assert 5 in graph
    # 5 together, 3 4 and 5 7 8; 5 and 7 8.
    assert dict(pruner.counts) == {CHECKED: 5, UNDONE: 3, REFUSED: 1}
    Pruner(Chosen(3, 4, 7, 8), StarMesh()).reduce(clean, 0)
    assert [(e.source, e.target, e.kind) for e in graph.edges] == [
        (e.source, e.target, e.kind) for e in clean.edges
    ]
    recovered = recover(graph.poses(), removals)
    assert max(error_of(recovered[i], T)[0] for i, T in before.items()) < 0.01


def test_a_refused_vertex_stays_as_others_do():
    graph, selection = two_laps(), Chosen(3, 4, 5)
    pruner = Pruner(selection, Bends(5))
    assert [removal.vertex for removal in pruner.settle(graph, range(10))] == [3, 4]
    pruner.settle(graph, range(10, 20))
    assert 5 in selection.older[1]
    assert not {3, 4} & selection.older[1]


def test_what_moves_everything_is_given_up(monkeypatch):
    monkeypatch.setattr("lifelong_slam.graph.pruning._PATIENCE", 3)
    graph, vertices = two_laps(), list(range(3, 19))
    before = graph.poses()
    pruner = Pruner(Chosen(*vertices), Bends(*vertices))
    assert pruner.reduce(graph, 0) == []
    assert dict(pruner.counts) == {CHECKED: 5, UNDONE: 5, REFUSED: 16}
    assert graph.poses().keys() == before.keys()


def test_a_graph_that_is_not_at_its_optimum_is_brought_there_first():
    optimised, stale = two_laps(), two_laps()
    poses = {i: T @ exp(0.02 * np.sin(np.arange(6.0) + i)) for i, T in stale.poses().items() if i}
    for vertex, T in poses.items():
        stale._values.update(vertex, gtsam.Pose3(T))
    stale._is_optimal = False
    recovered = []
    for graph in (optimised, stale):
        removals = Pruner(Chosen(3, 4, 5, 20), StarMesh()).reduce(graph, 0)
        recovered.append(recover(graph.poses(), removals))
    assert max(error_of(recovered[0][i], T)[0] for i, T in recovered[1].items()) < 1e-3
