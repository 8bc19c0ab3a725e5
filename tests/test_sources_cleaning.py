import logging

import numpy as np
import pytest

from lifelong_slam.errors import SourceError
from lifelong_slam.scan import Scan
from lifelong_slam.sources.cleaning import (
    AHEAD,
    BACKWARDS,
    EMPTY,
    REPEATED,
    STUMP,
    InputCounts,
    clean,
)

PERIOD = 100_000_000


def scan(index, count=4, offsets=True):
    points = np.full((count, 3), float(index))
    return Scan(index * PERIOD, points, np.linspace(0, 0.1, count) if offsets else None)


def run(scans):
    counts = InputCounts()
    return list(clean(scans, counts)), counts


def test_good_scans_pass_untouched():
    scans = [scan(i) for i in range(20)]
    out, counts = run(scans)
    assert all(a is b for a, b in zip(out, scans, strict=True))
    assert counts == InputCounts(read=20, used=20)
    assert counts.summary() == "20 of 20 scans used"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_points_go_with_their_offsets(bad, caplog):
    dirty = scan(0)
    dirty.points[1, 2] = bad
    out, counts = run([dirty])
    np.testing.assert_array_equal(out[0].points, dirty.points[[0, 2, 3]])
    np.testing.assert_array_equal(out[0].offsets, dirty.offsets[[0, 2, 3]])
    assert counts.dropped_points == 1
    assert "1 non-finite points" in caplog.text


def test_points_without_a_time_go_too():
    dirty = scan(0)
    dirty.offsets[0] = np.nan
    out, _ = run([dirty])
    assert len(out[0].points) == len(out[0].offsets) == 3


def test_huge_finite_coordinates_are_not_taken_for_infinite():
    large = scan(0, offsets=False)
    large.points[:] = 1e308
    assert len(run([large])[0][0].points) == 4


def test_scans_without_offsets():
    dirty = scan(0, offsets=False)
    dirty.points[0] = np.nan
    out, _ = run([dirty])
    assert out[0].offsets is None
    assert len(out[0].points) == 3


def test_empty_repeated_and_backward_scans_are_counted(caplog):
    blind = scan(3)
    blind.points[:] = np.nan
    scans = [scan(0), scan(1), scan(1), scan(2, 0), blind, scan(5), scan(4), scan(0), scan(6)]
    out, counts = run(scans)
    assert [s.stamp // PERIOD for s in out] == [0, 1, 5, 6]
    assert counts.skipped == {EMPTY: 2, REPEATED: 1, BACKWARDS: 2}
    assert (counts.read, counts.used) == (9, 4)
    assert len([r for r in caplog.records if "skipped" in r.message]) == 3
    assert "2 skipped (empty)" in counts.summary()


@pytest.mark.parametrize("position", [0, 3])
def test_one_stamp_far_ahead_does_not_cost_the_rest(position):
    scans = [scan(i) for i in range(8)]
    scans.insert(position, scan(10_000))
    out, counts = run(scans)
    assert [s.stamp // PERIOD for s in out] == list(range(8))
    assert counts.skipped == {AHEAD: 1}


def test_a_clock_set_back_for_good_ends_the_use():
    out, counts = run([scan(i) for i in (1000, 1001, 1002, 0, 1, 2)])
    assert [s.stamp // PERIOD for s in out] == [1000, 1001, 1002]
    assert counts.skipped == {BACKWARDS: 3}


def test_gaps_are_noted_not_mended(caplog):
    indices = [*range(10), 20, 21, 22, 40]
    out, counts = run([scan(i) for i in indices])
    assert len(out) == len(indices)
    assert counts.gaps == 2
    assert len([r for r in caplog.records if "gap" in r.message]) == 1


def test_no_gaps_in_a_slow_recording():
    assert run([scan(10 * i) for i in range(20)])[1].gaps == 0


@pytest.mark.parametrize("scans", [[], [scan(0, 0)]])
def test_nothing_usable_is_an_error(scans):
    with pytest.raises(SourceError, match="no usable scans"):
        run(scans)


def test_counts_are_live(caplog):
    caplog.set_level(logging.ERROR)
    counts = InputCounts()
    stream = clean((scan(i) for i in range(5)), counts)
    next(stream)
    next(stream)
    assert counts.used == 2


def test_a_stump_that_would_send_poses_back_in_time_is_skipped():
    stump = Scan(PERIOD // 4, np.ones((4, 3)), np.linspace(0, 0.01, 4))
    out, counts = run([scan(0), stump, scan(1)])
    assert [s.stamp for s in out] == [0, PERIOD]
    assert counts.skipped == {STUMP: 1}
    assert out[0].middle_stamp < out[1].middle_stamp
