"""Which vertices go: those that stay are spread evenly, whatever the order, unit or frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from slam_support import planar

from lifelong_slam.geometry import exp
from lifelong_slam.graph.selection import Decimate, Geometry, Random


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
def test_those_that_stay_cover_where_all_have_been(seed, spacing):
    poses = at(scattered(seed))
    removed = settle(Geometry(spacing), poses)
    assert len(set(removed)) == len(removed)
    distances = cKDTree(survivors(poses, removed)).query(survivors(poses, []))[0]
    # A spacing from the spots of the trail, which lie a quarter of it from where vertices were.
    assert distances.max() <= 1.25 * spacing
    assert np.mean(distances > spacing) < 0.1


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), spacing=st.floats(0.5, 8.0))
def test_none_of_those_that_stay_could_go(seed, spacing):
    poses = at(scattered(seed))
    staying = survivors(poses, settle(Geometry(spacing), poses))
    for i in range(len(staying) if len(staying) > 1 else 0):
        others = np.delete(staying, i, axis=0)
        assert cKDTree(others).query(survivors(poses, []))[0].max() > spacing


@pytest.mark.parametrize("seed", range(5))
def test_the_cover_holds_visit_after_visit(seed):
    """Each visit lies elsewhere, and its vertices may replace those of earlier ones."""
    selection, poses, older = Geometry(3.0), at(scattered(seed, 1000)), []
    for first in range(0, 1000, 10):
        new = list(range(first, first + 10))
        present = {i: poses[i] for i in (*older, *new)}
        removed = settle(selection, present, new, older)
        older = [i for i in present if i not in removed]
        visited = np.array([poses[i][:3, 3] for i in range(first + 10)])
        staying = np.array([poses[i][:3, 3] for i in older])
        assert cKDTree(staying).query(visited)[0].max() <= 1.25 * 3.0
    assert len(older) < 60  # of 1000; a disc of 3 m radius is 28 of 625 square metres


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
    spots, removed = [], []
    for p in positions:
        if all(np.linalg.norm(p - spot) > 0.25 * spacing for spot in spots):
            spots.append(p)

    def is_covered(without):
        left = [positions[i] for i in alive - {without}]
        return all(min(np.linalg.norm(left - spot, axis=1)) <= spacing for spot in spots)

    while open_:
        best, density = -1, -1.0
        for i in sorted(open_):
            d = [np.linalg.norm(positions[i] - positions[j]) for j in alive if j != i]
            sid = sum(1 / x for x in d if x <= 3 * spacing)
            if sid > density + 1e-9:
                best, density = i, sid
        open_.discard(best)
        if is_covered(without=best):
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
    there = [(4.1 * i, 0.0) for i in range(10)]
    poses = at(there + there, [0.0] * 10 + [np.pi] * 10)
    assert settle(Geometry(4.0, 70.0), poses) == []
    assert len(settle(Geometry(4.0, 360.0), poses)) == 10


@pytest.mark.parametrize("view", [40.0, 70.0, 120.0, 200.0])
@pytest.mark.parametrize(("share", "gone"), [(0.99, 1), (1.01, 0)])
def test_views_that_share_less_than_half_of_what_they_see_are_different(view, share, gone):
    poses = at([(0, 0), (0, 0)], [0.0, share * np.radians(view) / 2])
    assert len(settle(Geometry(4.0, view), poses)) == gone


@pytest.mark.parametrize(("third", "gone"), [(-10.0, "new"), (-3.0, "older")])
def test_an_older_one_goes_before_a_new_one_only_if_it_is_a_tenth_denser(third, gone):
    """Closed form: densities are 0.6 and 0.583 with a third one far away, 0.833 and 0.7 with a near one."""
    poses = on_a_line(0.0, 2.0, third)
    assert settle(Geometry(4.0), poses, new=[1], older=[0]) == [{"older": 0, "new": 1}[gone]]


def test_where_a_removed_one_was_is_still_covered():
    poses = on_a_line(0.0, 3.0, -3.0)
    selection = Geometry(4.0)
    assert settle(selection, {i: poses[i] for i in (0, 1)}, new=[1]) == [1]
    # Alone, the one in the middle could go for the one on the left; but that doesn't reach to 3 m.
    both = {i: poses[i] for i in (0, 2)}
    assert settle(Geometry(4.0), both, new=[], older=[0]) == [0]
    assert settle(selection, both, new=[], older=[0]) == []


def test_what_was_settled_in_earlier_sessions_is_still_covered():
    poses = on_a_line(0.0, 3.0, -3.0)
    selection = Geometry(4.0)
    selection.adopt(poses, {0: 0, 1: 0})
    assert settle(selection, {i: poses[i] for i in (0, 2)}, new=[], older=[0]) == []


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


@pytest.mark.parametrize(
    "selection",
    [Geometry(3.0), Decimate(), Random(seed=4)],
    ids=lambda selection: type(selection).__name__,
)
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


@pytest.mark.parametrize("seed", range(3))
def test_density_is_summed_over_three_of_the_spacings_that_are_left(seed):
    """By the definition: of 60, 20 stay, and stand for three each: the third other is a spacing away."""
    positions = scattered(seed, 60, 12.0)
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    reach = 3 * np.median(np.sort(apart, axis=1)[:, 3])
    pull = np.where((apart <= reach) & (apart > 0), 1 / np.maximum(apart, 1e-9), 0.0)
    removed, alive = [], np.ones(60, dtype=bool)
    for _ in range(40):
        densest = int(np.argmax(np.where(alive, pull @ alive, -1.0)))
        alive[densest] = False
        removed.append(densest)
    poses = at(positions)
    assert Geometry(1.0).reduce(poses, list(poses), 40) == removed


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
