"""Pruning: which vertices hold the graph together, and that the graph is as large as the place."""

import networkx
import numpy as np
import pytest
from slam_support import SIGMAS, error_of, planar

from lifelong_slam.geometry import exp, invert
from lifelong_slam.graph.marginalisation import ChowLiu, Dense, StarMesh
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.pruning import NoPruning, Pruner, protected
from lifelong_slam.graph.removal import recover
from lifelong_slam.graph.selection import Decimate, Geometry, Random
from lifelong_slam.result import Edge

COVARIANCE = np.diag(SIGMAS**2)


def graph_of(pairs, roots=(0,), count=None, kind="odometry"):
    """Return a graph whose odometry runs through all vertices on a line, with more edges."""
    graph = PoseGraph()
    count = 1 + max(v for pair in pairs for v in pair) if count is None else count
    for i in range(count):
        if i in roots:
            graph.add_vertex(i, planar(2.0 * i, 0))
        else:
            graph.add_odometry(Edge(i - 1, i, planar(2.0, 0), COVARIANCE, "odometry"))
    for i, j in pairs:
        graph.add_edge(Edge(i, j, planar(2.0 * (j - i), 0), COVARIANCE, kind))
    return graph


def test_of_a_chain_only_the_root_is_protected():
    assert protected(graph_of([], count=8)) == {0}


def test_the_joints_of_loops_are_protected():
    # 0 - 1 - 2 - 3 = loop of 1..3; 3 - 4 a bridge; loop of 4..6; 7 a dead end.
    graph = graph_of([(1, 3), (4, 6)], count=8, kind="loop")
    assert protected(graph) == {0, 1, 3, 4, 6}


def test_a_second_edge_between_two_does_not_make_them_joints():
    assert protected(graph_of([(2, 3)], count=6)) == {0}


def test_the_roots_of_all_components_are_protected():
    graph = graph_of([], roots=(0, 4), count=8)
    assert protected(graph) == {0, 4}


def connected(graph):
    structure = networkx.Graph()
    structure.add_nodes_from(graph.vertices)
    structure.add_edges_from((e.source, e.target) for e in graph.edges)
    return networkx.is_connected(structure)


def circle(laps, lap=30, noise=1.0, seed=0):
    """Yield the vertices of a drive on a circle with the edges that end there, and the truth."""
    rng = np.random.default_rng(seed)
    step = planar(2.0, 0.0, 2 * np.pi / lap)
    truth = [np.eye(4)]
    for _ in range(lap * laps - 1):
        truth.append(truth[-1] @ step)

    def measured(i, j, kind):
        Z = invert(truth[i]) @ truth[j] @ exp(rng.normal(size=6) * SIGMAS * noise)
        return Edge(i, j, Z, COVARIANCE, kind)

    return truth, measured


def drive(pruning, laps, window=12, every=6):
    """Go round with loop closures to whatever vertex is near, pruned as the pipeline does it."""
    truth, measured = circle(laps)
    graph, recent, removals, sizes = PoseGraph(), [], [], []
    graph.add_vertex(0, truth[0])
    recent.append(0)
    for i in range(1, len(truth)):
        graph.add_odometry(measured(i - 1, i, "odometry"))
        recent.append(i)
        if i % 3 == 0:
            old = [v for v in graph.vertices if v < i - 20]
            near = [v for v in old if error_of(truth[v], truth[i])[0] < 5.0]
            if near:
                nearest = min(near, key=lambda v: error_of(truth[v], truth[i])[0])
                graph.add_edge(measured(nearest, i, "loop"))
        if len(recent) == window + every:
            graph.optimise()
            removals += pruning.settle(graph, recent[:every])
            recent = recent[every:]
        sizes.append((len(graph), graph.edge_count))
    graph.optimise(reconsider=True)
    removals += pruning.settle(graph, recent)
    return graph, truth, removals, sizes


class Watched:
    """A selection that notes how much it is given to look at."""

    def __init__(self, selection):
        self._selection, self.given = selection, []

    def settle(self, poses, new, older):
        self.given.append(len(poses))
        return self._selection.settle(poses, new, older)


@pytest.fixture(scope="module")
def many_laps():
    watched = Watched(Geometry(4.0))
    return watched, *drive(Pruner(watched, StarMesh()), laps=9)


def test_laps_after_the_first_do_not_make_the_graph_larger(many_laps):
    _, graph, _, _, sizes = many_laps
    vertices, edges = np.array(sizes).T
    assert vertices[150:].max() <= vertices[30:150].max() + 2
    assert edges[150:].max() <= 1.4 * edges[30:150].max()
    assert len(graph) <= 20  # 60 m, one each 4 m, and a few that are protected


def test_what_a_removal_costs_does_not_depend_on_how_many_there_were(many_laps):
    watched, graph, _, removals, _ = many_laps
    assert len(removals) > 230
    settled_in_lap_3, later = watched.given[10:15], watched.given[15:-1]
    assert max(later) <= max(settled_in_lap_3) + 2
    assert max(len(removal.neighbours) for removal in removals) <= 6
    degree = [len(graph.incident(vertex)) for vertex in graph.vertices]
    assert max(degree) <= 24


def test_every_vertex_is_in_the_graph_or_comes_back_where_it_was(many_laps):
    _, graph, truth, removals, _ = many_laps
    assert sorted([*graph.vertices, *(r.vertex for r in removals)]) == list(range(len(truth)))
    poses = recover(graph.poses(), removals)
    unpruned, _, _, _ = drive(NoPruning(), laps=9)
    error = [error_of(poses[i], T)[0] for i, T in enumerate(truth)]
    best = [error_of(unpruned.pose(i), T)[0] for i, T in enumerate(truth)]
    assert np.mean(error) < 2.0 * np.mean(best)
    assert max(error) < 0.15


@pytest.mark.parametrize(
    "selection",
    [Geometry(4.0), Geometry(1e9), Decimate(), Random()],
    ids=lambda s: type(s).__name__,
)
@pytest.mark.parametrize("marginalisation", [StarMesh(), ChowLiu()], ids=lambda m: type(m).__name__)
def test_the_graph_stays_connected_and_keeps_its_root(selection, marginalisation):
    graph, truth, removals, _ = drive(Pruner(selection, marginalisation), laps=2)
    assert connected(graph)
    assert 0 in graph
    assert len(graph) + len(removals) == len(truth)
    assert len(graph) < len(truth)
    graph.optimise()
    assert max(error_of(graph.pose(i), truth[i])[0] for i in graph.vertices) < 0.3


def test_dense_factors_hold_the_graph_together_too():
    graph, truth, _, _ = drive(Pruner(Geometry(4.0), Dense()), laps=2)
    assert len(graph) < 25
    graph.optimise()  # raises where a vertex hangs on nothing
    assert max(error_of(graph.pose(i), truth[i])[0] for i in graph.vertices) < 0.3


def test_joints_outlast_a_selection_that_wants_everything():
    graph = graph_of([(1, 3), (4, 6)], count=8, kind="loop")
    graph.optimise()
    removals = Pruner(Geometry(1e9), StarMesh()).settle(graph, graph.vertices)
    assert set(graph.vertices) == {0, 1, 3, 4, 6}
    assert {removal.vertex for removal in removals} == {2, 5, 7}
    assert connected(graph)


def test_vertices_in_the_window_are_left_alone():
    graph = graph_of([], count=20)
    graph.optimise()
    removals = Pruner(Geometry(100.0), StarMesh()).settle(graph, range(10))
    assert {removal.vertex for removal in removals} == set(range(1, 10))
    assert graph.vertices == [0, *range(10, 20)]


@pytest.mark.parametrize(("moved_to", "gone"), [(3.5, True), (4.5, False)])
def test_one_that_stayed_goes_once_the_optimiser_has_moved_it_upon_another(moved_to, gone):
    loose = 100 * COVARIANCE
    graph = PoseGraph()
    graph.add_vertex(0, np.eye(4))
    graph.add_odometry(Edge(0, 1, planar(4.2, 0), loose, "odometry"))
    graph.add_odometry(Edge(1, 2, planar(100, 0), loose, "odometry"))
    pruner = Pruner(Geometry(4.0), StarMesh())
    assert pruner.settle(graph, [0, 1]) == []
    graph.add_edge(Edge(0, 1, planar(moved_to, 0), 1e-6 * COVARIANCE, "odometry"))
    graph.optimise()
    removed = [removal.vertex for removal in pruner.settle(graph, [2])]
    assert removed == ([1] if gone else [])
    assert connected(graph)


def test_one_that_no_longer_is_a_joint_may_go_later():
    graph = graph_of([(1, 3)], count=6, kind="loop")
    pruner = Pruner(Geometry(1e9), StarMesh())
    graph.optimise()
    pruner.settle(graph, [0, 1, 2, 3])
    assert graph.vertices == [0, 1, 3, 4, 5]
    graph.add_edge(Edge(0, 5, planar(10.0, 0), COVARIANCE, "loop"))
    graph.optimise()
    assert protected(graph) == {0}
    pruner.settle(graph, [4])
    assert graph.vertices == [0, 5]


def test_reducing_leaves_as_many_as_asked_or_the_protected_ones():
    for keep, left in ((10, 10), (1, 5)):
        graph = graph_of([(1, 3), (12, 14)], count=16, kind="loop")
        graph.optimise()
        removals = Pruner(Geometry(4.0), StarMesh()).reduce(graph, keep)
        assert len(graph) == left
        assert len(removals) == 16 - left
        assert set(graph.vertices) >= {0, 1, 3, 12, 14}
        assert connected(graph)


def test_without_pruning_nothing_goes():
    graph = graph_of([(1, 3)], count=8, kind="loop")
    edges = graph.edges
    assert NoPruning().settle(graph, graph.vertices) == []
    assert NoPruning().reduce(graph, 2) == []
    assert graph.vertices == list(range(8))
    assert graph.edges == edges


def test_a_session_that_is_not_located_yet_is_not_pruned_against_the_map():
    graph = PoseGraph()
    for first in (0, 5):  # both begin at the origin of their frames
        graph.add_vertex(first, np.eye(4))
        for i in range(first, first + 4):
            graph.add_odometry(Edge(i, i + 1, planar(6.0, 0.5), COVARIANCE, "odometry"))
    pruner = Pruner(Geometry(4.0), StarMesh())
    assert pruner.settle(graph, range(5)) == []
    assert pruner.settle(graph, range(5, 10)) == []
