"""Spots where vertices have been: they outlast the vertices, move with the graph and stay few."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from slam_support import planar

from lifelong_slam.geometry import exp
from lifelong_slam.graph.trail import Trail


def positions(T):
    return T[:, :3, 3]


def stacked(points):
    return np.array([planar(x, y, 0.3 * x) for x, y in points]).reshape(-1, 4, 4)


def trail_of(points, grain=1.0):
    """Return a trail of vertices at points, and the vertices with their poses."""
    ids, T = np.arange(len(points)), stacked(points)
    trail = Trail(positions, grain)
    trail.extend(ids, T)
    return trail, ids, T


def scattered(seed, count=200, size=10.0):
    return np.random.default_rng(seed).uniform(0, size, (count, 2))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), grain=st.floats(0.2, 5.0))
def test_spots_lie_a_grain_apart_and_every_vertex_has_one_within_it(seed, grain):
    trail, ids, T = trail_of(scattered(seed), grain)
    spots = trail.places(ids, T)
    assert cKDTree(spots).query(positions(T))[0].max() <= grain
    if len(spots) > 1:
        assert cKDTree(spots).query(spots, k=2)[0][:, 1].min() > grain


def test_there_are_no_more_spots_however_often_the_place_is_visited():
    ids, T = np.arange(20_000), stacked(scattered(0, 20_000))
    trail = Trail(positions, 1.0)
    counts = []
    for visit in range(1, 21):
        trail.extend(ids[: 1000 * visit], T[: 1000 * visit])
        counts.append(len(trail.places(ids, T)))
    assert counts[-1] < 11 * 11 / (np.pi / 4 * 0.5)  # discs of 1 m across, as densely as they lie


def test_spots_move_with_the_vertices_they_hang_on():
    trail, ids, T = trail_of([(0, 0), (10, 0), (11.5, 0)])
    trail.rehome(ids, T, [2])
    shift = exp(np.array([0, 0, np.pi / 2, 0, 3.0, 0]))
    moved = np.array([T[0], shift @ T[1]])
    expected = positions(np.array([T[0], shift @ T[1], shift @ T[2]]))
    np.testing.assert_allclose(trail.places(ids[:2], moved), expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_spots_stay_where_they_are_when_their_vertex_goes(seed):
    trail, ids, T = trail_of(scattered(seed))
    spots = trail.places(ids, T)
    rng = np.random.default_rng(seed)
    while len(ids) > 1:
        removed = rng.choice(len(ids), len(ids) // 2, replace=False).tolist()
        trail.rehome(ids, T, removed)
        ids, T = np.delete(ids, removed), np.delete(T, removed, axis=0)
        np.testing.assert_allclose(trail.places(ids, T), spots, atol=1e-9)


def test_a_spot_goes_to_the_nearest_vertex_that_stays():
    trail, ids, T = trail_of([(0, 0), (4, 0), (7, 0)])
    trail.rehome(ids, T, [1])
    assert len(trail.places(ids[:1], T[:1])) == 1
    assert len(trail.places(ids[2:], T[2:])) == 2


def test_spots_of_vertices_in_another_frame_are_left_alone():
    trail, ids, T = trail_of([(0, 0), (5, 0)])
    trail.extend(np.array([7]), stacked([(0, 0)]))  # at the origin of its own frame
    assert len(trail.places(np.array([7]), T[:1])) == 1
    trail.rehome(ids, T, [0])
    assert len(trail.places(ids[1:], T[1:])) == 2


def test_an_adopted_trail_is_the_one_that_was_left():
    points = scattered(4)
    trail, ids, T = trail_of(points)
    removed = list(range(3, 200))
    trail.rehome(ids, T, removed)
    adopted = Trail(positions, 1.0)
    hosts = {int(i): int(i) if i < 3 else int(i % 3) for i in ids}
    adopted.adopt(dict(zip(ids.tolist(), T, strict=True)), hosts)
    np.testing.assert_allclose(
        np.sort(adopted.places(ids[:3], T[:3]), axis=0),
        np.sort(trail.places(ids[:3], T[:3]), axis=0),
        atol=1e-9,
    )
