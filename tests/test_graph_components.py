"""Components of a pose graph: sessions in frames of their own, and what joins them."""

import numpy as np
import pytest
from graph_support import edge, graph_of, laps
from slam_support import error_of, planar

from lifelong_slam.geometry import invert
from lifelong_slam.graph.pose_graph import PoseGraph


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
