"""SLAM that is killed while it keeps a map: at most one keyframe is lost, and the next run goes on."""

import multiprocessing
import os
import random
import time
from dataclasses import replace
from itertools import islice
from signal import SIGKILL

import numpy as np
import pytest
from map_support import load
from session_support import (
    SESSION_GAP,
    SETTINGS,
    circle_town,
    open_session,
    record_drive,
    run_session,
)
from slam_support import PERIOD, START, estimate
from test_slam import DriftingOdometry, pipeline

from lifelong_slam.geometry import invert
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.mapping.store import MapStore
from lifelong_slam.scan import NANOSECONDS, Scan

LAP, LENGTH = 100, 60  # scans once around, and in a session that comes to its end
WINDOW = {"window": 6, "settle_every": 3}  # short, so that kills hit settling and pruning
LIFE, REST = 40, 0.4  # keyframes up to which one lives, and seconds more


class PreparedOdometry:
    """Returns estimates that were made before, at the stamps of the scans."""

    def __init__(self, estimates):
        self._estimates = iter(estimates)
        self.counts = {}

    def register(self, scan):
        return replace(next(self._estimates), stamp=scan.end_stamp)


def prepare():
    """Return what odometry sees at each place on the circle, and the true poses there."""
    drive = record_drive(circle_town(0), 0, LAP + LENGTH, 0)
    return [estimate(scan.stamp, np.eye(4), scan.points) for scan in drive.scans], drive.truth


def map_until_killed(path, seen, truth, report):
    """Run session after session in a map; report each keyframe's id once it has been processed."""
    while True:
        with open_session(path) as session:
            here = slice(first := 37 * session.id % LAP, first + LENGTH)
            odometry = DriftingOdometry(invert(truth[first]) @ truth[here], seed=session.id)
            estimates = [
                replace(view, T_odom_sensor=T, covariance=odometry.covariance)
                for view, T in zip(seen[here], odometry.poses, strict=True)
            ]
            slam = pipeline(PreparedOdometry(estimates), **WINDOW)
            slam.begin(session)
            start, newest = START + session.id * SESSION_GAP, -1
            for i in range(LENGTH):
                slam.process(Scan(start + round(i * PERIOD * NANOSECONDS), np.zeros((0, 3))))
                if slam._track.keyframes[-1] != newest:
                    newest = slam._track.keyframes[-1]
                    os.write(report, b"%d\n" % newest)
            slam.finish()


def serve(connection):
    """Start mapping and kill it, as often as asked: each time a fork, with all of it imported.

    It starts no threads itself, which a fork would lose.
    """
    seen, truth = prepare()
    fork = multiprocessing.get_context("fork")
    while (request := connection.recv()) is not None:
        path, keyframes, seconds = request
        ours, theirs = os.pipe()
        child = fork.Process(target=map_until_killed, args=(path, seen, truth, theirs))
        child.start()
        os.close(theirs)
        with os.fdopen(ours) as report:
            written = list(islice(report, keyframes))
            time.sleep(seconds)
            child.kill()
            child.join()
            written += report
        connection.send((child.exitcode, [int(line) for line in written]))


@pytest.fixture(scope="module")
def killer():
    """Return a function that maps into a file for a while and kills: exit status, what was reported."""
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    server = spawn.Process(target=serve, args=(theirs,))
    server.start()
    theirs.close()

    def kill(path, keyframes, seconds):
        ours.send((path, keyframes, seconds))
        assert ours.poll(120), "it hangs"
        return ours.recv()

    yield kill
    ours.send(None)
    server.join()


@pytest.mark.parametrize(("maps", "kills"), [(1, 5), pytest.param(10, 10, marks=pytest.mark.slow)])
def test_a_killed_run_loses_at_most_the_keyframe_in_flight_and_the_next_goes_on(
    killer, tmp_path, maps, kills
):
    random.seed(kills)
    for number in range(maps):
        path = tmp_path / f"{number}" / "place.map"
        path.parent.mkdir()
        MapStore.create(
            path, *[SETTINGS[k] for k in ("sensor", "T_base_sensor", "voxel_size")]
        ).close()
        kill_again_and_again(killer, path, kills)
        go_on(path)


def kill_again_and_again(killer, path, kills):
    total = 0
    for kill in range(kills):
        # The first comes to the end of a session. One in five of the others lives for a moment only:
        # it is killed as it opens the map and takes it in.
        keyframes = max(0, random.randint(-LIFE // 4, LIFE)) if kill else LIFE
        status, written = killer(path, keyframes, random.uniform(0.0, REST))
        assert status == -SIGKILL, "it ended by itself"
        assert check_map(path) == []
        saved = load(path)
        assert written == list(range(total, total + len(written)))
        assert total + len(written) <= saved.next_keyframe <= total + len(written) + 1
        total = saved.next_keyframe
    assert total > 5 * kills
    assert saved.removals


def go_on(path):
    """Run a whole session in a map that was left by a killed one."""
    before = load(path)
    drive = record_drive(circle_town(0), 5, LENGTH, len(before.sessions))
    result = run_session(path, drive)
    saved = load(path)
    assert check_map(path) == []
    assert saved.sessions[-1].finished
    assert saved.next_keyframe == before.next_keyframe + result.counts["keyframes"]
    np.testing.assert_array_equal(
        saved.of_sessions([drive.number]).trajectory().stamps, drive.stamps
    )
    assert len(saved.trajectory()) == sum(len(scans.stamps) for scans in saved.scans)
    assert not any(len(keyframe.points) for keyframe in saved.keyframes.values())
    assert [p.name for p in path.parent.iterdir()] == [path.name]
