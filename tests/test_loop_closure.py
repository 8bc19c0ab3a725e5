"""Loop closures: which candidates are tried, what is refused, and what an accepted one says."""

import logging
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from slam_support import (
    SIGMAS,
    Lidar,
    corridor,
    error_of,
    keyframe,
    planar,
    surfaces,
    town,
)

from lifelong_slam.geometry import adjoint, invert, transform
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.loop_closure.closer import LoopCloser, relative_covariance
from lifelong_slam.loop_closure.verification import Verdict, Verifier
from lifelong_slam.registration import Cloud
from lifelong_slam.result import Edge

VOXEL = 0.5
NOWHERE = np.zeros((0, 3))
FLASH = Lidar(rings=24, columns=240, duration=0.0, reach=50.0)


def view(world, T, seed=0):
    """Return what a sensor at rest sees."""
    return FLASH.sweep(world, T, T, rng=np.random.default_rng(seed)).points


class Drive:
    """Feeds keyframes at given poses to a closer, and keeps what it returns."""

    def __init__(self, closer):
        self.closer, self.edges, self.again = closer, [], []
        self.graph, self.keyframes = PoseGraph(), {}
        self.travelled = 0.0

    def go(self, T_map_sensor, points=NOWHERE, travelled=None, sigma=0.0, belief=None):
        """Arrive at a pose that the graph believes to be `belief`; return the new closures."""
        T = T_map_sensor if belief is None else belief
        i = len(self.keyframes)
        if i:
            self.travelled += float(np.linalg.norm((self.last_true - T_map_sensor)[:3, 3]))
            motion = invert(self.graph.pose(i - 1)) @ T
            self.graph.add_odometry(Edge(i - 1, i, motion, np.diag(SIGMAS**2), "odometry"))
        else:
            self.graph.add_vertex(0, T)
        self.travelled = self.travelled if travelled is None else travelled
        self.last_true = T_map_sensor
        cloud = Cloud.prepare(points, VOXEL)
        self.keyframes[i] = keyframe(i, T_map_sensor, cloud.positions, self.travelled)
        again = self.closer.look_back(self.keyframes, self.graph)
        self.again += again
        edges = self.closer.close(self.keyframes[i], cloud, self.keyframes, self.graph, sigma)
        self.edges += edges
        return edges

    @property
    def tried(self):
        return sum(n for what, n in self.closer.counts.items() if what.startswith("loop by place"))


def closer(**settings):
    return LoopCloser(VOXEL, **{"min_travel": 30.0} | settings)


@pytest.fixture(scope="module")
def place():
    return town(3, 50, lambda xy: np.abs(xy[:, 1]) < 5)


def test_no_place_counts_as_revisited_before_enough_was_driven(place):
    points = view(place, planar(0, 0, 0, 1.8))
    for travelled, tried in ((29.0, 0), (31.0, 1)):
        drive = Drive(closer())
        drive.go(planar(0, 0, 0, 1.8), points, travelled=0.0)
        drive.go(planar(0, 0, 0, 1.8), points, travelled=travelled)
        assert drive.tried == tried


@pytest.mark.parametrize(
    ("distance", "sigma", "tried"),
    [(5.0, 0.0, 1), (7.0, 0.0, 0), (7.0, 2.5, 1), (19.0, 100.0, 1), (21.0, 100.0, 0)],
)
def test_the_reach_follows_the_uncertainty_between_its_limits(distance, sigma, tried):
    drive = Drive(closer(min_reach=6.0, max_reach=20.0))
    drive.go(planar(0, 0), travelled=0.0)
    drive.go(planar(distance, 0), travelled=100.0, sigma=sigma)
    assert drive.tried == tried


def test_attempts_by_place_keep_their_spacing():
    drive = Drive(closer(spacing=8.0))
    drive.go(planar(0, 0), travelled=0.0)
    tried = [drive.go(planar(0, 0), travelled=100.0 + i) or drive.tried for i in range(20)]
    assert tried[0] == 1
    assert tried[7] == 1
    assert tried[8] == 2
    assert tried[19] == 3


def test_of_places_as_near_the_one_with_the_same_view_is_tried(place):
    same, across, far = planar(0, 2, 0, 1.8), planar(0, -2, np.pi, 1.8), planar(5, 0, 0, 1.8)
    drive = Drive(closer(spacing=0.0))
    for i, T in enumerate((across, same, far)):
        drive.go(T, view(place, T), travelled=float(i))
    here = planar(0, 0, 0, 1.8)
    (edge,) = drive.go(here, view(place, here, 1), travelled=100.0)
    assert (edge.source, edge.target) == (1, 3)
    back = planar(0, 0, np.pi, 1.8)
    (edge,) = drive.go(back, view(place, back, 2), travelled=101.0)
    assert (edge.source, edge.target) == (0, 4)


def test_an_accepted_edge_measures_the_true_motion_whatever_the_graph_believes(place):
    first, again = planar(-3, 0, 0.1, 1.8), planar(-2, 1, -0.2, 1.8)
    drive = Drive(closer())
    drive.go(first, view(place, first), travelled=0.0)
    belief = again @ planar(1.0, -0.8, 0.08)
    (edge,) = drive.go(again, view(place, again, 1), travelled=100.0, belief=belief)
    assert (edge.source, edge.target, edge.kind) == (0, 1, "loop")
    distance, angle = error_of(edge.T_source_target, invert(first) @ again)
    assert distance < 0.05
    assert angle < 0.003
    np.testing.assert_allclose(edge.covariance, edge.covariance.T)
    assert np.linalg.eigvalsh(edge.covariance).min() > 0
    assert drive.closer.counts == Counter({"loop by place: accepted": 1})


def test_an_edge_is_at_least_as_uncertain_as_the_keyframes_at_its_ends(place):
    first, again = planar(-3, 0, 0.1, 1.8), planar(-2, 1, 1.2, 1.8)
    drive = Drive(closer())
    drive.go(first, view(place, first), travelled=0.0)
    (edge,) = drive.go(again, view(place, again, 1), travelled=100.0)
    ends = [keyframe(i, T, NOWHERE) for i, T in enumerate((first, again))]
    own = relative_covariance(*ends, edge.T_source_target)
    assert np.linalg.eigvalsh(edge.covariance - own).min() > -1e-12


def test_covariances_of_two_ends_meet_in_the_frame_of_the_target():
    rng = np.random.default_rng(0)
    A, B = (rng.normal(size=(6, 6)) for _ in range(2))
    source, target = (
        keyframe(i, np.eye(4), NOWHERE, covariance=M @ M.T) for i, M in enumerate((A, B))
    )
    T = planar(4.0, 1.0, np.pi / 2)
    carried = adjoint(invert(T)) @ (A @ A.T) @ adjoint(invert(T)).T
    np.testing.assert_allclose(relative_covariance(source, target, T), carried + B @ B.T)


def room(sample, width=8.0, length=20.0, count=3000):
    """Return points on the floor and the four walls of a room."""
    rng = np.random.default_rng(sample)
    x, y = rng.uniform(-0.5, 0.5, (2, count)) * [[length], [width]]
    up, half = rng.uniform(0, 3, count), np.full(count, 0.5)
    return np.vstack(
        [np.stack([x, y, 0 * up], 1)]
        + [np.stack([x, side * width * half, up], 1) for side in (-1, 1)]
        + [np.stack([side * length * half, y, up], 1) for side in (-1, 1)]
    ) + rng.normal(scale=0.01, size=(5 * count, 3))


# What the keyframe sees, what the place looked like, and what must become of it.
CASES = {
    Verdict.ACCEPTED: (surfaces(1, 1, noise=0.01), surfaces(1, 2, noise=0.01)),
    Verdict.DIVERGED: (NOWHERE, surfaces(1, 2)),
    Verdict.OVERLAP: (surfaces(2, 1), surfaces(3, 1, boxes=30)[2500:] + np.array([0, 0, 60.0])),
    # A room 15 cm narrower: centred in the other, both its long walls are beside theirs.
    Verdict.RESIDUAL: (room(1, width=7.85, count=1000)[1000:3000], room(2)[3000:9000]),
    Verdict.DEGENERATE: (corridor(1, length=30.0), corridor(2)),
}


@pytest.mark.parametrize("verdict", CASES, ids=lambda v: v.name.lower())
def test_each_verdict_is_reached_counted_and_logged_with_its_figures(verdict, caplog):
    query, reference = CASES[verdict]
    drive = Drive(closer())
    drive.go(np.eye(4), reference, travelled=0.0)
    with caplog.at_level(logging.INFO):
        edges = drive.go(np.eye(4), query, travelled=100.0)
    assert drive.closer.counts == Counter({f"loop by place: {verdict}": 1})
    assert len(edges) == (verdict is Verdict.ACCEPTED)
    (message,) = [r.getMessage() for r in caplog.records if "loop 1 -> 0" in r.getMessage()]
    assert f"by place: {verdict}" in message
    for figure in ("overlap", "residual", "degeneracy"):
        assert figure in message


def test_a_place_that_only_looks_alike_in_part_is_refused(place):
    elsewhere = town(4, 50, lambda xy: np.abs(xy[:, 1]) < 5)
    T = planar(0, 0, 0, 1.8)
    drive = Drive(closer())
    drive.go(T, view(place, T), travelled=0.0)
    assert drive.go(T, view(elsewhere, T), travelled=100.0) == []


def test_a_keyframe_is_verified_against_its_candidates_whole_surroundings(place):
    # From the far end only the submap, not the candidate alone, shows what the query sees.
    poses = [planar(2.0 * i, 0, 0, 1.8) for i in range(7)]
    drive = Drive(closer())
    for i, T in enumerate(poses):
        drive.go(T, view(place, T, i), travelled=float(i))
    here = planar(6.5, 0.5, 0.0, 1.8)
    (edge,) = drive.go(here, view(place, here, 9), travelled=100.0)
    assert edge.source == 3
    assert error_of(edge.T_source_target, invert(poses[3]) @ here)[0] < 0.05
    alone = Verifier(VOXEL).verify(
        view(place, poses[0], 0), Cloud.prepare(view(place, here, 9), VOXEL),
        [invert(poses[0]) @ here],
    )  # fmt: skip
    joined = np.vstack(
        [transform(invert(poses[0]) @ T, view(place, T, i)) for i, T in enumerate(poses)]
    )
    together = Verifier(VOXEL).verify(
        joined, Cloud.prepare(view(place, here, 9), VOXEL), [invert(poses[0]) @ here]
    )
    assert together[1].overlap > alone[1].overlap + 0.05


@pytest.fixture(scope="module")
def rich_place():
    return town(5, 60, lambda xy: np.abs(xy[:, 1]) < 5, spacing=4.0)


def pass_through(drive, world, drift=None, offset=0.0, yaw=0.0, begin=None):
    """Drive 50 m through a town, `begin` metres into the run; return the true poses by keyframe."""
    truth = {}
    for x in np.arange(-24.0, 25.0, 2.0):
        T = planar(x * np.cos(yaw), offset, yaw, 1.8)
        travelled = None if begin is None else begin + x + 24.0
        truth[len(drive.keyframes)] = T
        belief = T if drift is None else drift @ T
        drive.go(T, view(world, T, len(truth)), travelled, sigma=5.0, belief=belief)
    return truth


DRIFT = planar(45.0, -60.0, 0.8)


def true_motion(edge, truth):
    return invert(truth[edge.source]) @ truth[edge.target]


@pytest.mark.parametrize(("offset", "yaw"), [(1.0, 0.0), (2.0, np.pi)])
def test_appearance_closes_a_loop_however_far_the_graph_has_drifted(rich_place, offset, yaw):
    drive = Drive(closer(min_travel=60.0))
    truth = pass_through(drive, rich_place)
    assert drive.edges == []
    truth |= pass_through(drive, rich_place, DRIFT, offset, yaw, begin=400.0)
    assert drive.edges
    assert drive.closer.counts == Counter({"loop by appearance": len(drive.edges)})
    for edge in drive.edges:
        assert (edge.source < 25, edge.target >= 25, edge.kind) == (True, True, "loop")
        distance, angle = error_of(edge.T_source_target, true_motion(edge, truth))
        assert distance < 0.1
        assert angle < 0.005
        ends = [drive.keyframes[i] for i in (edge.source, edge.target)]
        own = relative_covariance(*ends, edge.T_source_target)
        assert np.linalg.eigvalsh(edge.covariance - own).min() > -1e-12


def test_appearance_is_not_asked_while_closures_by_place_confirm_the_graph(rich_place):
    drive = Drive(closer(min_travel=60.0, spacing=8.0))
    pass_through(drive, rich_place)
    pass_through(drive, rich_place, begin=400.0)
    assert drive.closer.counts["loop by place: accepted"] >= 5
    assert drive.closer.counts["loop by appearance"] == 0


def test_another_town_is_not_taken_for_the_one_that_was_seen(rich_place):
    drive = Drive(closer(min_travel=60.0))
    pass_through(drive, rich_place)
    elsewhere = town(30, 60, lambda xy: np.abs(xy[:, 1]) < 5, spacing=4.0)
    pass_through(drive, elsewhere, DRIFT, begin=400.0)
    assert drive.edges == []


def test_a_drive_where_nothing_is_seen_is_recognised_nowhere():
    drive = Drive(closer())
    for i in range(120):
        drive.go(planar(2.0 * (i % 30), 0, 0, 1.8), belief=planar(2.0 * i, 0), travelled=2.0 * i)
    assert drive.edges == []
    assert drive.tried == 0


def test_a_look_without_result_is_repeated_after_a_while_only(monkeypatch):
    drive, looks = Drive(closer()), []
    locate = drive.closer.places.locate

    def counted(*arguments):
        looks.append(drive.travelled)
        return locate(*arguments)

    monkeypatch.setattr(drive.closer.places, "locate", counted)
    for x in np.arange(0.0, 240.0, 2.0):
        drive.go(planar(x, 0))
    assert len(looks) >= 4
    assert np.diff(looks, prepend=0.0).min() >= 40.0


def test_an_earlier_session_is_old_at_once(place):
    T = planar(0, 0, 0, 1.8)
    points = view(place, T)
    for session, tried in ((0, 0), (1, 1)):
        drive = Drive(closer(spacing=0.0))
        drive.go(T, points, travelled=5.0)
        drive.keyframes[0] = replace(drive.keyframes[0], session=session)
        drive.go(T, points, travelled=6.0)
        assert drive.tried == tried


def test_another_component_is_out_of_reach_by_place(place):
    """Its poses are in a frame of their own, so that being near means nothing."""
    T = planar(0, 0, 0, 1.8)
    drive = Drive(closer(spacing=0.0))
    drive.go(T, view(place, T), travelled=0.0)
    alone = PoseGraph()
    for i in range(2):
        alone.add_vertex(i, T)
    k = keyframe(1, T, view(place, T, 1), 100.0)
    cloud = Cloud.prepare(k.features.astype(float), VOXEL)
    keyframes = {**drive.keyframes, 1: k}
    assert drive.closer.close(k, cloud, keyframes, alone, 0.0) == []
    assert drive.tried == 0


def test_a_closure_leads_to_a_vertex_that_is_still_there(place):
    """Of a removed keyframe there is neither a candidate nor a part of the submap."""
    drive = Drive(closer(spacing=0.0))
    for i, x in enumerate((0.0, 1.0, 2.0)):
        T = planar(x, 0, 0, 1.8)
        drive.go(T, view(place, T, i), travelled=float(i))
    step = planar(2.0, 0)
    drive.graph.add_edge(Edge(0, 2, step, np.diag(2 * SIGMAS**2), "odometry"))
    drive.graph.remove_vertex(1)
    del drive.keyframes[1]
    here = planar(1.0, 0.1, 0, 1.8)
    drive.keyframes[3] = keyframe(3, here, view(place, here, 5), 100.0)
    drive.graph.add_odometry(
        Edge(2, 3, invert(drive.graph.pose(2)) @ here, np.diag(SIGMAS**2), "odometry")
    )
    cloud = Cloud.prepare(view(place, here, 5), VOXEL)
    (edge,) = drive.closer.close(drive.keyframes[3], cloud, drive.keyframes, drive.graph, 0.0)
    assert edge.source in (0, 2)
    assert edge.target == 3


def test_two_closers_find_the_same_edges_to_the_last_bit(place):
    found = []
    for _ in range(2):
        drive = Drive(closer(spacing=0.0))
        for i, x in enumerate((0.0, 2.0, 4.0, 1.0, 3.0)):
            T = planar(x, 0, 0, 1.8)
            drive.go(T, view(place, T, i), travelled=float(i if i < 3 else 100 + i))
        found.append(drive.edges)
    assert len(found[0]) == len(found[1]) == 2
    for a, b in zip(*found, strict=True):
        np.testing.assert_array_equal(a.T_source_target, b.T_source_target)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_what_a_closure_has_moved_is_looked_at_again(place):
    """Odometry is 2 m off on the second way along a street, until its end is recognised."""
    drive = Drive(closer(spacing=4.0, min_reach=1.0))
    street = [planar(x, 0, 0, 1.8) for x in range(-10, 11, 2)]
    for T in street:
        drive.go(T, view(place, T))
    away = planar(200.0, 0, 0, 1.8)
    drive.go(away)
    off = planar(0, 2.0, 0)
    for T in street[:-1]:
        drive.go(T, view(place, T, seed=1), belief=off @ T)
    assert not drive.edges
    found = drive.go(
        street[-1], view(place, street[-1], seed=1), belief=off @ street[-1], sigma=7.0
    )
    assert len(found) == 1
    assert not drive.again
    drive.graph.add_edge(found[0])
    odometry = [edge for edge in drive.graph.edges if edge.kind == "odometry"]
    turn = next(edge for edge in odometry if edge.source == len(street))
    drive.graph.remove_edge(
        turn
    )  # it claims to be sure; the closure alone holds the second way now
    loose = replace(turn, covariance=1e4 * turn.covariance)
    drive.graph.add_edge(loose)
    drive.graph.optimise()
    drive.go(planar(200.0, 50.0, 0, 1.8))
    drive.go(planar(200.0, 60.0, 0, 1.8))
    again = drive.again
    assert [edge.target for edge in again] == sorted({e.target for e in again}, reverse=True)
    assert 2 <= len(again) <= 4
    assert drive.closer.counts["loop in hindsight"] == len(again)
    for edge in again:
        true = invert(street[edge.source]) @ street[edge.target - len(street) - 1]
        assert error_of(edge.T_source_target, true)[0] < 0.1


def test_where_a_closure_was_tried_already_is_not_looked_at_again(place):
    drive = Drive(closer(spacing=4.0))
    street = [planar(x, 0, 0, 1.8) for x in range(-10, 11, 2)]
    for T in street:
        drive.go(T, view(place, T))
    drive.go(planar(200.0, 0, 0, 1.8))
    for T in street:
        drive.go(T, view(place, T, seed=1))
    assert len(drive.edges) > 3
    drive.go(planar(200.0, 50.0, 0, 1.8))
    assert not drive.again
