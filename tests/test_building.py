"""The graph-level simulation of a robot in a building."""

import numpy as np
import pytest
from scipy.stats import chi2

from lifelong_slam.geometry import invert, log
from lifelong_slam.simulation.building import (
    CORRIDOR,
    CROSS_CORRIDORS,
    LONG_CORRIDORS,
    draw_building,
)
from lifelong_slam.simulation.building_run import (
    LOOP_REACH,
    LOOP_SPACING,
    MIN_TRAVEL,
    BuildingRun,
)

HOURS = 2.0


@pytest.fixture(scope="module")
def run():
    return BuildingRun(HOURS, seed=1)


def all_loops(run, survivors):
    """Return the closures of a whole run to those keyframes of which survivors(id) is true."""
    kept = np.flatnonzero(survivors(np.arange(len(run))))
    return [
        edge
        for step in run
        for edge in run.loops(step, kept[: np.searchsorted(kept, step.keyframe)])
    ]


def errors(run, edges):
    """Return (N, 6) differences between measurement and truth, and (N, 6, 6) covariances."""
    source, target = run.truth[[e.source for e in edges]], run.truth[[e.target for e in edges]]
    measured = np.array([e.T_source_target for e in edges])
    return log(invert(invert(source) @ target) @ measured), np.array([e.covariance for e in edges])


def assert_consistent(run, edges):
    """Assert that the mean NEES lies within the 95 % band of its chi-square distribution."""
    error, covariance = errors(run, edges)
    nees = np.einsum("ij,ij->i", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    low, high = chi2.ppf([0.025, 0.975], 6 * len(edges)) / len(edges)
    assert low < nees.mean() < high


def test_equal_seeds_give_equal_buildings_and_others_do_not():
    assert np.array_equal(draw_building(3).areas, draw_building(3).areas)
    assert not np.array_equal(draw_building(3).nodes, draw_building(4).nodes)


def test_no_two_rooms_overlap_and_each_touches_its_corridor():
    building = draw_building(0)
    rooms, corridors = (building.areas[building.kinds != CORRIDOR], building.areas[:3])
    for i, room in enumerate(rooms):
        others = np.delete(rooms, i, axis=0)
        overlap = np.minimum(room[2:], others[:, 2:]) - np.maximum(room[:2], others[:, :2])
        assert not (overlap > 1e-9).all(axis=1).any()
        gaps = np.abs(np.stack([room[1] - corridors[:, 3], corridors[:, 1] - room[3]]))
        assert gaps.min() == pytest.approx(0)


def test_the_route_between_two_rooms_is_the_shortest():
    building = draw_building(0)
    corners = building.route(1.0, np.random.default_rng(5))
    length = np.linalg.norm(np.diff(corners[1:-1], axis=0), axis=1).sum()  # from entry to entry
    (start_x, start_y), (end_x, end_y) = corners[1], corners[-2]
    along = [min(LONG_CORRIDORS, key=lambda y: abs(y - at)) for at in (start_y, end_y)]
    to_corridors = abs(start_y - along[0]) + abs(end_y - along[1])
    crossings = CROSS_CORRIDORS if along[0] != along[1] else (start_x,)
    detour = min(abs(start_x - x) + abs(x - end_x) for x in crossings)
    assert length == pytest.approx(to_corridors + detour + abs(along[0] - along[1]))


def test_the_robot_stays_inside_and_on_the_floor(run):
    building = draw_building(1)
    assert building.contains(run.truth[:, :2, 3]).any(axis=1).all()
    assert np.abs(run.truth[:, 2, 3]).max() < 0.02
    assert run.truth[:, 2, 2].min() > np.cos(0.02)


def test_the_robot_comes_by_every_room():
    building, run = draw_building(1), BuildingRun(6.0, seed=1)
    inside = building.contains(run.truth[:, :2, 3])
    assert inside.any(axis=0).all()


def test_a_longer_run_begins_as_a_shorter_one(run):
    shorter = BuildingRun(HOURS / 2, seed=1)
    same = len(shorter) - 10  # the end of the way is rounded differently
    assert np.array_equal(run.truth[:same], shorter.truth[:same])


def test_a_keyframe_comes_every_two_metres_or_one_radian(run):
    motions = invert(run.truth[:-1]) @ run.truth[1:]
    distance = np.linalg.norm(motions[:, :3, 3], axis=1)
    turn = np.arccos(np.clip(motions[:, 0, 0], -1, 1))
    assert ((distance >= 1.999) | (turn >= 0.999)).all()
    assert distance.max() < 2.3
    assert run.travelled[-1] == pytest.approx(3600 * HOURS, abs=5)
    assert [step.seconds for step in run] == pytest.approx(run.travelled)


def test_cells_are_counted_when_they_are_first_entered(run):
    counts = run.cells_entered(4.0)
    seen = set()
    for (x, y), count in zip(run.truth[:300, :2, 3], counts, strict=False):
        seen.add((x // 4, y // 4))
        assert count == len(seen)
    assert len(counts) == len(run)


def test_odometry_edges_chain_the_keyframes_and_are_consistent(run):
    steps = list(run)
    edges = [step.odometry for step in steps[1:]]
    assert steps[0].odometry is None
    assert [(e.source, e.target) for e in edges] == [(i - 1, i) for i in range(1, len(steps))]
    assert {e.kind for e in edges} == {"odometry"}
    assert_consistent(run, edges)


def test_loop_closures_are_near_in_sight_long_ago_and_consistent(run):
    edges = all_loops(run, lambda ids: ids >= 0)
    assert 0.5 * HOURS * 3600 / LOOP_SPACING < len(edges) <= HOURS * 3600 / LOOP_SPACING
    source, target = np.array([(e.source, e.target) for e in edges]).T
    positions = run.truth[:, :2, 3]
    assert np.linalg.norm(positions[source] - positions[target], axis=1).max() <= LOOP_REACH
    assert (run.travelled[target] - run.travelled[source]).min() >= MIN_TRAVEL
    inside = draw_building(1).contains(positions)
    assert (inside[source] & inside[target]).any(axis=1).all()
    assert {e.kind for e in edges} == {"loop"}
    assert_consistent(run, edges)


def test_pruning_changes_neither_the_odometry_nor_the_noise_of_closures(run):
    again = BuildingRun(HOURS, seed=1)
    full = {e.target: e for e in all_loops(run, lambda ids: ids >= 0)}
    half = {e.target: e for e in all_loops(again, lambda ids: ids % 2 == 0)}
    assert all(
        np.array_equal(a.odometry.T_source_target, b.odometry.T_source_target)
        for a, b in list(zip(run, again, strict=True))[1:]
    )
    assert set(half) <= set(full)
    assert len(half) > 0.9 * len(full)
    shared = sorted(half)
    errors_full, _ = errors(run, [full[i] for i in shared])
    errors_half, _ = errors(run, [half[i] for i in shared])
    assert np.allclose(errors_full, errors_half, atol=1e-9)
    assert any(full[i].source != half[i].source for i in shared)


def test_the_share_of_wrong_closures_is_as_asked_and_they_look_alike():
    run = BuildingRun(HOURS, seed=1, wrong_share=0.2)
    edges = all_loops(run, lambda ids: ids >= 0)
    error, covariance = errors(run, edges)
    wrong = np.linalg.norm(error[:, 3:], axis=1) > 1.0
    count = len(edges)
    assert abs(wrong.sum() - 0.2 * count) < 3 * np.sqrt(0.2 * 0.8 * count)
    assert_consistent(run, [e for e, bad in zip(edges, wrong, strict=True) if not bad])
    assert np.array_equal(covariance[wrong][0], covariance[~wrong][0])
    building = draw_building(1)
    kinds = building.kinds[building.contains(run.truth[:, :2, 3]).argmax(axis=1)]
    ends = [(kinds[e.source], kinds[e.target]) for e, bad in zip(edges, wrong, strict=True) if bad]
    assert all(source == target for source, target in ends)
    assert {kind for kind, _ in ends} == {0, 1, 2, 3}
    measured = np.array([e.T_source_target[:3, 3] for e in edges])[wrong]
    assert np.linalg.norm(measured, axis=1).max() < LOOP_REACH


def test_true_closures_are_the_same_with_and_without_wrong_ones(run):
    clean = {e.target: e for e in all_loops(run, lambda ids: ids >= 0)}
    mixed = all_loops(BuildingRun(HOURS, seed=1, wrong_share=0.2), lambda ids: ids >= 0)
    same = [np.array_equal(e.T_source_target, clean[e.target].T_source_target) for e in mixed]
    assert 0.7 < np.mean(same) < 0.9
