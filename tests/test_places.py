"""Places: as many as there are, where the graph has them, and recognised when that means something."""

from itertools import pairwise

import numpy as np
import pytest
from slam_support import error_of, keyframe, planar

from lifelong_slam.geometry import exp, invert
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.loop_closure.places import Places
from lifelong_slam.loop_closure.relocalisation import LOCAL_MAP_SPACING, LocalMap, Location
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.registration import Registration
from lifelong_slam.result import Edge

NOTHING = np.zeros((0, 3), dtype=np.float32)
VOXEL = 0.5


def local_map(i, travelled=0.0, session=0, T_odom=None):
    T_odom = np.eye(4) if T_odom is None else T_odom
    k = keyframe(i, T_odom, NOTHING, travelled)
    k = Keyframe(
        k.id, session, k.stamp, k.T_odom_sensor, k.covariance, k.travelled, NOTHING, NOTHING
    )
    return LocalMap(k, travelled, NOTHING)


def chain_of(poses, first=0):
    """Return a graph of one component in which the vertices, numbered on, have the given poses."""
    graph = PoseGraph()
    extend(graph, poses, first)
    return graph


def extend(graph, poses, first):
    graph.add_vertex(first, poses[0])
    for i, (a, b) in enumerate(pairwise(poses), first):
        graph.add_odometry(Edge(i, i + 1, invert(a) @ b, 1e-4 * np.eye(6), "odometry"))


class Scripted:
    """Stands for the search by appearance: says what it was told to, about the places asked for."""

    def __init__(self, *answers):
        self.asked, self._answers = [], list(answers)

    def add_place(self, reference_id, points):
        pass

    def locate(self, query, among):
        self.asked.append(set(among))
        return [
            Location(place, query.reference, fit(T))
            for place, T in self._answers.pop(0)
            if place in among
        ]


def fit(T):
    return Registration(T, np.eye(6), 1.0, 1000, 0.7, 0.7, 0.03, converged=True)


def scripted(*answers, min_travel=30.0):
    places = Places(VOXEL, min_travel)
    places._relocaliser = Scripted(*answers)
    return places


@pytest.mark.parametrize(
    ("second", "kept"),
    [
        (planar(0, 0), [0]),
        (planar(0.85 * LOCAL_MAP_SPACING, 0), [0]),
        (planar(0.95 * LOCAL_MAP_SPACING, 0), [0, 1]),
        (planar(0, 0, 0.45), [0]),
        (planar(0, 0, 0.55), [0, 1]),
        (planar(0, 0, np.pi), [0, 1]),
    ],
)
def test_where_a_place_looks_the_same_way_no_second_one_is_added(second, kept):
    graph = chain_of([planar(0, 0), second])
    places = Places(VOXEL, 30.0)
    for i in range(2):
        places.add(local_map(i), graph, graph.component(i))
    assert list(places.take_new()) == kept


def test_laps_add_no_places_after_the_first():
    angles = np.arange(100) * 2 * np.pi / 25  # four laps
    poses = [planar(20 * np.sin(a), -20 * np.cos(a), a) for a in angles]
    graph = chain_of(poses)
    places = Places(VOXEL, 30.0)
    added = []
    for i in range(100):
        places.add(local_map(i, 5.0 * i), graph, graph.component(i))
        added += places.take_new()
    assert 8 <= len(added) <= 16  # 125 m of path, turned by 0.5 rad each 10 m
    assert max(added) < 25


def test_the_places_of_another_component_do_not_count():
    """Where they are is not known yet."""
    graph = chain_of([planar(0, 0)])
    graph.add_vertex(1, planar(0, 0))
    places = Places(VOXEL, 30.0)
    for i in range(2):
        places.add(local_map(i), graph, graph.component(i))
    assert list(places.take_new()) == [0, 1]


def test_new_places_are_told_of_once():
    graph = chain_of([planar(20.0 * i, 0) for i in range(3)])
    places = Places(VOXEL, 30.0)
    places.add(local_map(0), graph, graph.component(0))
    assert list(places.take_new()) == [0]
    assert places.take_new() == {}
    places.add(local_map(2), graph, graph.component(0))
    assert list(places.take_new()) == [2]


def test_a_new_place_hangs_on_its_own_vertex():
    graph = chain_of([planar(3, 4, 1.0)])
    places = Places(VOXEL, 30.0)
    places.add(local_map(0), graph, graph.component(0))
    vertex, T = places.anchor(0)
    assert vertex == 0
    np.testing.assert_array_equal(T, np.eye(4))


def test_a_place_stays_where_it_is_when_its_vertex_goes():
    rng = np.random.default_rng(0)
    poses = {i: exp(rng.normal(size=6) * [0.5, 0.5, 0.5, 20, 20, 20]) for i in range(12)}
    graph = chain_of(list(poses.values()))
    places = Places(VOXEL, 30.0)
    for i in range(12):
        places.add(local_map(i), graph, graph.component(0))
    kept = list(places.take_new())
    assert len(kept) > 6
    left = dict(poses)
    for removed in ({2, 3, 5}, {0, 7}, {1, 4, 6, 8, 9}):
        # The third time some places are rehomed that hang on others' vertices already.
        lasting = {i: T for i, T in left.items() if i not in removed}
        places.rehome(removed, left, lasting)
        left = lasting
        for place in kept:
            vertex, T_vertex_place = places.anchor(place)
            assert vertex in left
            assert error_of(left[vertex] @ T_vertex_place, poses[place])[0] < 1e-9
            if place in left:
                assert vertex == place


def test_a_place_is_hung_on_the_nearest_vertex():
    poses = {i: planar(2.0 * i, 0) for i in range(5)}
    graph = chain_of(list(poses.values()))
    places = Places(VOXEL, 30.0)
    places.add(local_map(2), graph, graph.component(0))
    lasting = {0: poses[0], 3: planar(5.9, 0), 4: poses[4]}
    places.rehome({1, 2}, poses, lasting)
    assert places.anchor(2)[0] == 3


def test_saved_places_hang_on_the_vertices_that_carry_their_keyframes():
    """Some of the keyframes that they were seen from are no vertices any more."""
    vertices = {7: planar(0, 0, 1.0), 9: planar(50, 0), 12: planar(50, 40, -2.0)}
    seen_from = {3: planar(2, 1, 0.5, 1.0), 9: planar(50, 0), 11: planar(45, 33)}
    places = Places(VOXEL, 30.0)
    hosts = {3: 7, 9: 9, 11: 12}
    places.restore(dict.fromkeys(seen_from, NOTHING), vertices | seen_from, hosts)
    assert [places.anchor(i)[0] for i in seen_from] == [7, 9, 12]
    for i, T in seen_from.items():
        vertex, T_vertex_place = places.anchor(i)
        np.testing.assert_allclose(vertices[vertex] @ T_vertex_place, T, atol=1e-12)
    assert places.take_new() == {}


def test_a_place_is_asked_for_once_enough_was_driven_since():
    graph = chain_of([planar(20.0 * i, 0) for i in range(4)])
    places = scripted([], [], min_travel=30.0)
    for i in range(3):
        places.add(local_map(i, 20.0 * i), graph, graph.component(0))
    places.locate(local_map(3, 49.0), graph, graph.component(0))
    places.locate(local_map(3, 50.0), graph, graph.component(0))
    assert places._relocaliser.asked == [{0}, {0, 1}]


def test_places_of_earlier_sessions_are_asked_for_at_once():
    graph = chain_of([planar(20.0 * i, 0) for i in range(3)])
    poses = graph.poses()
    places = scripted([])
    places.restore({0: NOTHING}, poses, {0: 0})
    places.add(local_map(1, 500.0, session=1), graph, graph.component(0))
    places.locate(local_map(2, 0.0, session=2), graph, graph.component(0))
    assert places._relocaliser.asked == [{0, 1}]


def test_in_its_own_component_a_local_map_is_located_by_the_best_place():
    graph = chain_of([planar(20.0 * i, 0) for i in range(4)])
    places = scripted([(1, planar(1, 0)), (0, planar(5, 5))])
    for i in range(2):
        places.add(local_map(i), graph, graph.component(0))
    (found,) = places.locate(local_map(3, 100.0), graph, graph.component(3))
    assert (found.reference_id, found.query.id) == (1, 3)


def two_sessions():
    """Return a map and a second session, begun 10 m behind the map's first place, unlocated."""
    graph = chain_of([planar(0, 0), planar(10, 0), planar(300, 0)])
    extend(graph, [planar(0, 0), planar(10, 0), planar(20, 0)], 100)
    return graph


def queries():
    return [local_map(100 + i, 10.0 * i, 1, planar(10.0 * i, 0)) for i in range(3)]


def locate_in(answers):
    graph, places = two_sessions(), scripted(*answers)
    for i in range(3):
        places.add(local_map(i), graph, graph.component(0))
    found = []
    for query, _ in zip(queries(), answers, strict=False):
        locations = places.locate(query, graph, graph.component(query.reference.id))
        found.append([(each.reference_id, each.query.id) for each in locations])
    return found


def test_in_another_component_two_local_maps_must_agree():
    here, on = (0, planar(1, 0)), (1, planar(1, 0))
    astray = (2, planar(1, 0))
    assert locate_in([[here]]) == [[]]
    assert locate_in([[here], [on]]) == [[], [(0, 100), (1, 101)]]
    assert locate_in([[here], [astray]]) == [[], []]
    assert locate_in([[here], [astray], [(1, planar(11, 0))]]) == [[], [], [(0, 100), (1, 102)]]


def test_agreement_follows_the_graph_and_the_vertices_that_places_hang_on():
    """Between the two queries a place's vertex is removed, and the map is moved as a whole."""
    graph, places = two_sessions(), scripted([(0, planar(1, 0))], [(1, planar(1, 0))])
    for i in range(3):
        places.add(local_map(i), graph, graph.component(0))
    first, second, _ = queries()
    assert places.locate(first, graph, graph.component(100)) == []
    poses = graph.poses()
    places.rehome({1}, poses, {0: poses[0], 2: poses[2]})
    shift = planar(-40, 25, 1.3)
    moved = chain_of([shift @ planar(0, 0), shift @ planar(10, 0), shift @ planar(300, 0)])
    extend(moved, [planar(0, 0), planar(10, 0), planar(20, 0)], 100)
    moved.add_edge(Edge(0, 2, planar(300, 0), np.eye(6), "odometry"))
    moved.remove_vertex(1)
    assert len(places.locate(second, moved, moved.component(101))) == 2
