"""Front end and pipeline where tracking is interrupted, and the verdict on runs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from slam_support import PERIOD, Lidar, drive, error_of, estimate, planar, seconds, town
from test_slam import DriftingOdometry, errors, pipeline, record

from lifelong_slam.assessment import Status, assess
from lifelong_slam.geometry import invert
from lifelong_slam.graph.initialisation import connected
from lifelong_slam.odometry.kiss_icp import KissIcpOdometry
from lifelong_slam.odometry.odometry import Tracking
from lifelong_slam.odometry.tracking import TrackingLog
from lifelong_slam.result import Edge, GraphSnapshot, SlamResult
from lifelong_slam.scan import Scan

SPEED, COUNT, AT, LASTING = 8.0, 30, 12, 8
STARTED, REGISTERED, PREDICTED = Tracking.STARTED, Tracking.REGISTERED, Tracking.PREDICTED


def straight(t):
    return planar(SPEED * t, 0, 0, 1.8)


@pytest.fixture(scope="module")
def street():
    return town(1, 120, lambda xy: np.abs(xy[:, 1]) < 6)


@pytest.fixture(scope="module")
def scans(street):
    return drive(street, Lidar(columns=150), straight, np.arange(COUNT) * PERIOD)


def register(scans):
    odometry = KissIcpOdometry(0.5, 1.0, 60.0)
    return [odometry.register(scan) for scan in scans]


def motion_error(estimates, first, last):
    """Return the error (m) of the motion between two scans."""
    T = invert(estimates[first].T_odom_sensor) @ estimates[last].T_odom_sensor
    poses = [straight(seconds(estimates[i].stamp)) for i in (first, last)]
    return error_of(T, invert(poses[0]) @ poses[1])[0]


def nearly_empty(scan):
    return Scan(scan.stamp, scan.points[::2000], scan.offsets[::2000])


def covered(scan):
    """Return what is seen with a board close ahead."""
    r = np.linalg.norm(scan.points, axis=1, keepdims=True)
    ahead = scan.points[:, 0] / r[:, 0] > 0.9
    points = scan.points / scan.points[:, :1] * 2.0
    return Scan(scan.stamp, points[ahead], scan.offsets[ahead])


@pytest.mark.parametrize("spoil", [nearly_empty, covered])
def test_what_cannot_be_registered_is_extrapolated_with_a_covariance_that_grows(scans, spoil):
    spoilt = [spoil(s) if AT <= i < AT + LASTING else s for i, s in enumerate(scans)]
    estimates = register(spoilt)
    outage = estimates[AT : AT + LASTING]
    assert {e.tracking for e in outage} == {PREDICTED}
    assert [e.tracking for e in estimates[1:AT]] == [REGISTERED] * (AT - 1)
    sigmas = [np.sqrt(e.covariance[3, 3]) for e in outage]
    assert np.all(np.diff(sigmas) > 0)
    assert sigmas[-1] > 10 * np.sqrt(estimates[AT - 1].covariance[3, 3])
    # Afterwards it is found again where it was seen last.
    assert {e.tracking for e in estimates[AT + LASTING :]} == {REGISTERED}
    assert motion_error(estimates, 0, COUNT - 1) < 0.1


def elsewhere(scans, seed=7, shift=0.0, yaw=0.0):
    """Return scans that go on in another town, or at another place of the same, at the same times."""
    other = town(seed, 120, lambda xy: np.abs(xy[:, 1]) < 6)
    times = np.arange(COUNT) * PERIOD
    moved = drive(other, Lidar(columns=150), lambda t: planar(shift, 0, yaw) @ straight(t), times)
    return [*scans[:AT], *moved[AT:]]


@pytest.mark.parametrize(
    ("seed", "shift", "yaw"), [(7, 0, 0), (4, 0, 0), (1, 30, 0), (1, -40, 0.7)]
)
def test_a_kidnapped_sensor_begins_a_map_of_its_own(scans, seed, shift, yaw):
    estimates = register(elsewhere(scans, seed, shift, yaw))
    kinds = [e.tracking for e in estimates]
    assert kinds[0] is STARTED
    assert kinds[1:AT] == [REGISTERED] * (AT - 1)
    assert kinds[AT : AT + 2] == [PREDICTED, STARTED]
    assert kinds[AT + 2 :] == [REGISTERED] * (COUNT - AT - 2)
    assert motion_error(estimates, 0, AT - 1) < 0.1
    assert motion_error(estimates, AT + 1, COUNT - 1) < 0.1


def test_first_scans_that_do_not_fit_wait_for_some_that_do(scans):
    estimates = register([replace(elsewhere(scans)[-1], stamp=scans[0].stamp), *scans[1:]])
    assert [e.tracking for e in estimates[:4]] == [STARTED, PREDICTED, STARTED, REGISTERED]
    assert motion_error(estimates, 2, COUNT - 1) < 0.1


def test_outages_are_told_once_and_remembered(caplog):
    log = TrackingLog()
    kinds = [STARTED, REGISTERED, PREDICTED, PREDICTED, REGISTERED, PREDICTED, STARTED, PREDICTED]
    for i, kind in enumerate(kinds):
        seen = estimate(i * 10**9, np.eye(4))
        log.update(Scan(i, np.ones((4, 3))), SimpleNamespace(
            stamp=seen.stamp, T_odom_sensor=np.eye(4), points=np.ones((3, 3)), tracking=kind,
        ))  # fmt: skip
    assert [(o.begin // 10**9, o.seconds, o.scans, o.parted) for o in log.outages] == [
        (2, 2.0, 2, False), (5, 1.0, 1, True), (7, 0.0, 1, False),
    ]  # fmt: skip
    assert (log.scans, log.points, log.points_in_range) == (8, 32, 24)
    lines = [r.getMessage() for r in caplog.records]
    assert len(lines) == 5
    assert "extrapolated" in lines[0]
    assert "2.0 s (2 scans)" in lines[1]
    assert "lost" in lines[3]


class BreakingOdometry(DriftingOdometry):
    """Loses the way before one scan and goes on in a frame of its own."""

    def __init__(self, truth, at):
        super().__init__(truth)
        self._at = at

    def register(self, scan):
        index = self._next
        seen = super().register(scan)
        if index < self._at:
            return seen
        shifted = planar(5.0, -3.0, 0.4) @ seen.T_odom_sensor
        kind = STARTED if index == self._at else REGISTERED
        return replace(seen, T_odom_sensor=shifted, tracking=kind)


@pytest.fixture(scope="module")
def two_laps():
    return record(round(2.2 * 2 * np.pi * 16))


def test_a_part_that_comes_back_to_known_places_is_joined(two_laps):
    scans, truth = two_laps
    slam = pipeline(BreakingOdometry(truth, at=110))
    for scan in scans:
        slam.process(scan)
    result = slam.finish()
    assert len(connected(result.graph)) == 1
    assert errors(result.trajectory.poses, truth)[:, 0].max() < 1.0
    verdict = assess(finished(result, len(scans)))
    assert verdict.status is Status.DOUBTFUL
    assert "found again" in verdict.reasons[0]


def test_a_part_that_nothing_joins_stays_apart_and_the_run_is_lost(two_laps):
    scans, truth = two_laps
    slam = pipeline(BreakingOdometry(truth, at=30))
    for scan in scans[:70]:
        slam.process(scan)
    result = slam.finish()
    assert len(connected(result.graph)) == 2
    assert len(result.trajectory) == 70
    for part in (slice(0, 30), slice(30, 70)):
        poses, true = result.trajectory.poses[part], truth[part]
        np.testing.assert_allclose(invert(poses[0]) @ poses, invert(true[0]) @ true, atol=0.8)
    assert assess(finished(result, 70)).status is Status.LOST


def finished(result, used, read=None):
    return SimpleNamespace(result=result, counts={"read": read or used, "used": used})


def outcome(kinds=(), points=10, in_range=10, **settings):
    log = TrackingLog()
    for i, kind in enumerate(kinds):
        log.update(Scan(i, np.ones((points, 3))), SimpleNamespace(
            stamp=i * 10**8, T_odom_sensor=np.eye(4), points=np.ones((in_range, 3)), tracking=kind,
        ))  # fmt: skip
    edge = Edge(0, 1, np.eye(4), np.eye(6), "odometry")
    graph = settings.pop("graph", GraphSnapshot({0: np.eye(4), 1: np.eye(4)}, [edge]))
    cloud = settings.pop("map_points", np.zeros((5, 3), np.float32))
    return SlamResult(None, cloud, graph, tracking=log, **settings)


USUAL = [STARTED, *[REGISTERED] * 99]


@pytest.mark.parametrize(("result", "status", "said"), [
    (outcome(USUAL), Status.GOOD, None),
    (outcome([*USUAL, *[PREDICTED] * 5, REGISTERED]), Status.GOOD, None),
    (outcome([*USUAL, *[PREDICTED] * 15, REGISTERED]), Status.DOUBTFUL, "1.5 s"),
    (outcome([*USUAL, PREDICTED, STARTED, REGISTERED]), Status.DOUBTFUL, "found again"),
    (outcome([*USUAL, PREDICTED, STARTED, REGISTERED],
             graph=GraphSnapshot({0: np.eye(4), 1: np.eye(4)}, [])), Status.LOST, "isn't connected"),
    (outcome([PREDICTED] * 9), Status.LOST, "9 of 9"),
    (outcome(USUAL, in_range=0), Status.DOUBTFUL, "within the sensor's range"),
    (outcome(USUAL, counts={"refinements_refused": 60}), Status.DOUBTFUL, "disagree"),
    (outcome(USUAL, map_points=np.zeros((0, 3), np.float32)), Status.LOST, "map is empty"),
    (outcome(USUAL, doubts=("most closures are rejected",)), Status.DOUBTFUL, "most closures"),
])  # fmt: skip
def test_the_verdict_names_what_speaks_against_a_run(result, status, said):
    verdict = assess(finished(result, 100))
    assert verdict.status is status
    assert (said is None and not verdict.reasons) or any(said in r for r in verdict.reasons)


def test_input_of_which_little_was_used_is_doubtful():
    verdict = assess(finished(outcome(USUAL), 20, 60))
    assert (verdict.status, verdict.reasons) == (
        Status.DOUBTFUL,
        ("only 20 of 60 scans could be used",),
    )
