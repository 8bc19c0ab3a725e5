"""The loop over scans: what it records, how it ends, whom it tells."""

import os
import signal
import threading

import numpy as np
import pytest
from run_support import ListSource, SignallingSource, scans

from lifelong_slam.errors import ConfigError, SourceError
from lifelong_slam.provenance import describe_run, git_commit, seed_everything
from lifelong_slam.result import GraphSnapshot, SlamResult, StageTimes
from lifelong_slam.runner import StopRequest, ViewerObserver, run, stop_on_signals
from lifelong_slam.scan import Scan
from lifelong_slam.trajectory import Trajectory


class StandingStill:
    """A system that takes any scan and stays where it is."""

    def __init__(self):
        self.stamps = []

    def process(self, scan):
        self.stamps.append(scan.end_stamp)
        return StageTimes(odometry_ms=1.5, vertices=len(self.stamps))

    def finish(self):
        poses = np.tile(np.eye(4), (len(self.stamps), 1, 1))
        trajectory = Trajectory(np.array(self.stamps, np.int64), poses)
        return SlamResult(trajectory, np.zeros((1, 3), np.float32), GraphSnapshot({}, []))

    def watch(self):
        return np.eye(4), None


class Listener:
    def __init__(self):
        self.heard = []

    def update(self, *arguments):
        self.heard.append(arguments)


def test_records_a_row_a_scan_and_tells_observers():
    listener = Listener()
    offsets = np.array([0.0, 0.02])
    record = run(ListSource(scans(5, offsets=offsets)), StandingStill(), [listener])
    assert [row.stamp for row in record.timeline] == record.result.trajectory.stamps.tolist()
    assert [row.vertices for row in record.timeline] == [1, 2, 3, 4, 5]
    assert {row.odometry_ms for row in record.timeline} == {1.5}
    assert len(listener.heard) == 5
    assert not record.interrupted
    assert record.wall_seconds > 0
    assert record.scans_per_second == pytest.approx(5 / record.wall_seconds)
    assert record.peak_rss_mb >= max(row.rss_mb for row in record.timeline) > 10
    assert record.cpu_percent > 0


def test_counts_what_was_left_out():
    good = scans(3)
    empty = Scan(good[1].stamp - 1, np.empty((0, 3)))
    record = run(ListSource([good[0], empty, good[0], *good[1:]]), StandingStill())
    assert len(record.timeline) == 3
    assert record.counts["read"] == 5
    assert record.counts["used"] == 3
    assert record.counts["skipped: empty"] == 1
    assert record.counts["skipped: stamp repeated"] == 1


@pytest.mark.parametrize("recording", [[], [Scan(0, np.empty((0, 3)))]])
def test_no_usable_scan_is_an_error(recording):
    with pytest.raises(SourceError, match="no usable scans"):
        run(ListSource(recording), StandingStill())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_the_scan_at_hand(number):
    before = signal.getsignal(number)
    with stop_on_signals() as stop:
        record = run(SignallingSource(6, at=[3], number=number), StandingStill(), stop=stop)
    assert record.interrupted
    assert len(record.result.trajectory) in (3, 4)  # cleaning reads one scan ahead
    assert signal.getsignal(number) is before


def test_the_second_signal_aborts():
    source = SignallingSource(6, at=[3])

    class Impatient(StandingStill):
        def finish(self):
            signal.raise_signal(signal.SIGINT)

    with stop_on_signals() as stop, pytest.raises(KeyboardInterrupt):
        run(source, Impatient(), stop=stop)


def test_a_signal_before_the_first_scan_aborts():
    with stop_on_signals() as stop, pytest.raises(KeyboardInterrupt):
        run(SignallingSource(6, at=[0]), StandingStill(), stop=stop)


def test_other_threads_leave_the_handlers_alone():
    before = signal.getsignal(signal.SIGINT)
    seen = []

    def work():
        with stop_on_signals() as stop:
            seen.append((signal.getsignal(signal.SIGINT), isinstance(stop, StopRequest)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [(before, True)]


def test_viewers_see_every_scan():
    viewer, system = Listener(), StandingStill()
    run(ListSource(scans(2)), system, [ViewerObserver(viewer, system)])
    (stamp, pose, points, graph), _ = viewer.heard
    assert stamp == system.stamps[0]
    assert points.shape[1] == 3
    assert graph is None
    np.testing.assert_array_equal(pose, np.eye(4))


def test_a_system_that_cannot_be_watched_needs_no_viewer():
    with pytest.raises(ConfigError, match="viewer=none"):
        ViewerObserver(Listener(), object())


def test_description_names_no_folders_and_no_host():
    info = describe_run(["scenario.path=/home/me/x.bag", "scenario.topic=/a/b", "seed=3"], 3)
    assert info["command_line"] == ["scenario.path=x.bag", "scenario.topic=/a/b", "seed=3"]
    assert info["packages"]["kiss-icp"]
    assert info["machine"]["cores"] == os.cpu_count()
    assert os.uname().nodename not in str(info["machine"])


def test_no_commit_outside_of_a_repository(tmp_path):
    assert git_commit(tmp_path) is None


def test_seeds_repeat():
    drawn = []
    for _ in range(2):
        seed_everything(7)
        drawn.append(np.random.random())  # noqa: NPY002
    assert drawn[0] == drawn[1]
    with pytest.raises(ConfigError, match="seed"):
        seed_everything(-1)
