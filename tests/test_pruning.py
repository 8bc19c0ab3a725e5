"""Which vertices go, which hold the graph together, and that the graph is as large as the place."""

import networkx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from slam_support import SIGMAS, error_of, planar

from lifelong_slam.geometry import exp, invert
from lifelong_slam.graph.marginalisation import ChowLiu, Dense, StarMesh
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.pruning import NoPruning, Pruner, protected
from lifelong_slam.graph.removal import recover
from lifelong_slam.graph.selection import Decimate, Geometry, Random
from lifelong_slam.result import Edge

COVARIANCE = np.diag(SIGMAS**2)


def at(positions, yaws=None):
    """Return poses by number at (N, 2) positions."""
    yaws = np.zeros(len(positions)) if yaws is None else yaws
    return {
        i: planar(x, y, yaw) for i, ((x, y), yaw) in enumerate(zip(positions, yaws, strict=True))
    }


def on_a_line(*xs):
    return at([(x, 0.0) for x in xs])


def scattered(seed, count=150, size=25.0):
    return np.random.default_rng(seed).uniform(0, size, (count, 2))


def settle(selection, poses, new=None, older=()):
    return selection.settle(poses, list(poses) if new is None else new, older)


def survivors(poses, removed):
    return np.array([T[:3, 3] for i, T in poses.items() if i not in set(removed)])


def nearest_others(positions):
    return cKDTree(positions).query(positions, k=2)[0][:, 1]


# Geometry, chosen as vertices leave the window.


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), spacing=st.floats(0.5, 8.0))
def test_those_that_stay_are_a_spacing_apart(seed, spacing):
    poses = at(scattered(seed))
    removed = settle(Geometry(spacing), poses)
    staying = survivors(poses, removed)
    assert len(set(removed)) == len(removed)
    assert len(staying) == 1 or nearest_others(staying).min() >= spacing


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), spacing=st.floats(0.5, 8.0))
def test_one_that_goes_has_another_within_the_spacing(seed, spacing):
    positions = scattered(seed)
    left = np.ones(len(positions), dtype=bool)
    for i in settle(Geometry(spacing), at(positions)):
        left[i] = False
        assert np.linalg.norm(positions[left] - positions[i], axis=1).min() < spacing


@pytest.mark.parametrize("seed", range(5))
def test_no_hole_is_left_where_there_were_vertices(seed):
    poses = at(scattered(seed, 400))
    staying = survivors(poses, settle(Geometry(3.0), poses))
    distances = cKDTree(staying).query(survivors(poses, []))[0]
    # The neighbour that one goes for may go for another itself, but never far.
    assert distances.max() < 2 * 3.0
    assert np.mean(distances > 3.0) < 1 / 3


def test_the_densest_goes_first():
    """Closed form: sums of 1 / distance are 4.44, 5 and 2.78 in the cluster; then 1.11 each."""
    poses = on_a_line(0.0, 0.3, 0.9, 20.0, 40.0)
    assert settle(Geometry(1.0), poses) == [1, 0]
    # Where the rest of the cluster may stay at its distance, only the densest goes.
    assert settle(Geometry(0.5), poses) == [1]
    assert settle(Geometry(0.25), poses) == []


def test_density_counts_who_is_within_three_spacings():
    """Of two that are as near to each other, the one with more vertices further off goes."""
    poses = on_a_line(0.0, 0.9, 3.8, 3.8)  # 2.9 m behind the second, 3.8 m behind the first
    assert settle(Geometry(1.0), poses, new=[0, 1]) == [1]
    beyond = on_a_line(0.0, 0.9, 3.91, 3.91)
    assert settle(Geometry(1.0), beyond, new=[0, 1]) == [0]


def greedy(positions, spacing):
    """Return what goes by the definition: all sums and distances anew for each removal."""
    alive, open_ = set(range(len(positions))), set(range(len(positions)))
    removed = []
    while open_:
        best, density, nearest = -1, -1.0, np.inf
        for i in sorted(open_):
            d = [np.linalg.norm(positions[i] - positions[j]) for j in alive if j != i]
            sid = sum(1 / x for x in d if x <= 3 * spacing)
            if sid > density + 1e-9:
                best, density, nearest = i, sid, min(d, default=np.inf)
        open_.discard(best)
        if nearest < spacing:
            alive.discard(best)
            removed.append(best)
    return removed


@pytest.mark.parametrize("seed", range(4))
def test_the_order_is_that_of_the_definition(seed):
    positions = scattered(seed, 60, 12.0)
    assert settle(Geometry(2.0), at(positions)) == greedy(positions, 2.0)


@pytest.mark.parametrize("scale", [2.0**-7, 2.0**10])
@pytest.mark.parametrize("view", [360.0, 70.0])
def test_the_choice_does_not_depend_on_the_unit_of_length(scale, view):
    positions, yaws = scattered(1), np.random.default_rng(1).uniform(-np.pi, np.pi, 150)
    near, far = at(positions, yaws), at(scale * positions, yaws)
    assert settle(Geometry(2.0, view), near) == settle(Geometry(2.0 * scale, view), far)
    assert Geometry(2.0, view).reduce(near, list(near), 90) == Geometry(2.0 * scale, view).reduce(
        far, list(far), 90
    )


def test_reducing_with_a_sensor_that_sees_all_around_needs_no_spacing():
    poses = at(scattered(1))
    choices = [Geometry(spacing).reduce(poses, list(poses), 90) for spacing in (0.01, 2.0, 1e4)]
    assert choices[0] == choices[1] == choices[2]


def test_the_choice_does_not_depend_on_where_the_map_begins():
    poses = at(scattered(2))
    shift = exp(np.array([0.3, -0.2, 1.1, 40.0, -70.0, 5.0]))
    moved = {i: shift @ T for i, T in poses.items()}
    assert settle(Geometry(2.0), poses) == settle(Geometry(2.0), moved)


def test_the_choice_is_the_same_each_time():
    poses = at(np.round(scattered(3)))  # with ties, and vertices in one place
    assert settle(Geometry(2.0), poses) == settle(Geometry(2.0), poses)


def test_opposite_lanes_in_one_place_both_stay_for_a_narrow_sensor():
    there = [(4.0 * i, 0.0) for i in range(10)]
    poses = at(there + there, [0.0] * 10 + [np.pi] * 10)
    assert settle(Geometry(4.0, 70.0), poses) == []
    assert len(settle(Geometry(4.0, 360.0), poses)) == 10


@pytest.mark.parametrize("view", [40.0, 70.0, 120.0, 200.0])
@pytest.mark.parametrize(("share", "gone"), [(0.99, 1), (1.01, 0)])
def test_views_that_share_less_than_half_of_what_they_see_are_different(view, share, gone):
    poses = at([(0, 0), (0, 0)], [0.0, share * np.radians(view) / 2])
    assert len(settle(Geometry(4.0, view), poses)) == gone


def test_one_that_stayed_before_goes_only_from_half_the_spacing():
    for distance, removed in ((2.1, []), (1.9, [1])):
        poses = on_a_line(0.0, distance)
        assert settle(Geometry(4.0), poses, new=[], older=[1]) == removed
        assert settle(Geometry(4.0), poses, new=[1]) == [1]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_neither_new_nor_older_ones_are_protected_and_stay(seed):
    rng = np.random.default_rng(seed)
    poses = at(scattered(seed, 80, 6.0))
    kind = rng.integers(0, 3, 80)
    new, older = (np.flatnonzero(kind == k).tolist() for k in (0, 1))
    free = {*new, *older}
    assert set(settle(Geometry(3.0), poses, new, older)) <= free
    for selection in (Geometry(3.0), Decimate(), Random()):
        assert set(selection.reduce(poses, free, 40)) <= free
    for selection in (Decimate(), Random()):
        assert set(settle(selection, poses, new, older)) <= set(new)


def test_there_may_be_nothing_to_choose_from():
    for selection in (Geometry(3.0), Decimate(), Random()):
        assert settle(selection, {}) == []
        assert selection.reduce(on_a_line(0.0, 1.0), [], 1) == []
    assert settle(Geometry(3.0), on_a_line(1.0)) == []


# Choices once and for all.


@pytest.mark.parametrize("selection", [Geometry(3.0), Decimate(), Random(seed=4)], ids=str)
@pytest.mark.parametrize("count", [0, 1, 37, 149, 150, 400])
def test_as_many_go_as_were_asked_for(selection, count):
    poses = at(scattered(4))
    removed = selection.reduce(poses, list(poses), count)
    assert len(set(removed)) == len(removed) == min(count, 150)


@pytest.mark.parametrize("keep", [30, 75, 150])
def test_those_that_are_kept_are_spread_more_evenly_than_by_lot(keep):
    # Crowded on one side, as where a robot waits.
    positions = np.vstack([scattered(5, 300, 30.0), scattered(6, 300, 10.0)])
    poses = at(positions)
    spread, largest_hole = {}, {}
    for selection in (Geometry(3.0), Random(seed=1)):
        staying = survivors(poses, selection.reduce(poses, list(poses), 600 - keep))
        nearest = nearest_others(staying)
        spread[type(selection)] = nearest.std() / nearest.mean()
        largest_hole[type(selection)] = cKDTree(staying).query(survivors(poses, []))[0].max()
    assert spread[Geometry] < 0.5 * spread[Random]
    assert largest_hole[Geometry] < 0.75 * largest_hole[Random]


def test_vertices_in_one_place_are_thinned_like_others():
    poses = at(np.repeat(scattered(7, 20, 50.0), 5, axis=0))
    removed = Geometry(3.0).reduce(poses, list(poses), 80)
    assert len({tuple(p) for p in survivors(poses, removed)}) == 20


# The others.


def test_decimation_keeps_every_third():
    poses = on_a_line(*range(12))
    assert settle(Decimate(3), poses, new=range(4, 12), older=range(4)) == [4, 5, 7, 8, 10, 11]
    assert settle(Decimate(1), poses) == []


def test_decimation_in_one_go_keeps_both_ends_and_equal_distances():
    poses = on_a_line(*range(31))
    removed = Decimate().reduce(poses, list(poses), 20)
    assert [i for i in range(31) if i not in removed] == list(range(0, 31, 3))


def test_a_lot_keeps_its_share_and_repeats_with_its_seed():
    poses = on_a_line(*range(3000))
    draws = [settle(Random(0.25, seed), poses) for seed in (1, 1, 2)]
    assert draws[0] == draws[1] != draws[2]
    assert len(draws[0]) / 3000 == pytest.approx(0.75, abs=4 * np.sqrt(0.25 * 0.75 / 3000))
    # By lot, not in runs: that two neighbours go is as likely as it should be.
    gone = np.isin(np.arange(3000), draws[0])
    assert np.mean(gone[1:] & gone[:-1]) == pytest.approx(0.75**2, abs=0.04)


def test_a_lot_is_drawn_anew_at_each_call():
    poses, selection = on_a_line(*range(100)), Random(0.5, 1)
    assert settle(selection, poses) != settle(selection, poses)


# The pruner.


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


@pytest.mark.parametrize(("moved_to", "gone"), [(1.5, True), (2.5, False)])
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
