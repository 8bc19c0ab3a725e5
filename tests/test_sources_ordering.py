"""Scans that come late."""

import numpy as np
import pytest
from sources_support import PERIOD, sweeps, write_bag

from lifelong_slam.scan import Scan
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.cleaning import InputCounts, clean
from lifelong_slam.sources.ordering import in_order


def scan(index):
    return Scan(index * PERIOD, np.ones((4, 3)))


def swapped(indices, pairs):
    indices = list(indices)
    for i in pairs:
        indices[i : i + 2] = reversed(indices[i : i + 2])
    return indices


@pytest.mark.parametrize(
    ("indices", "late"),
    [
        (swapped(range(30), range(3, 27, 6)), 4),
        (swapped(range(30), range(0, 30, 2)), 15),
        ([0, 1, 5, 2, 3, 4, *range(6, 20)], 3),
        ([*range(10), 13, 12, 11, 10, *range(14, 20)], 3),
        ([1, 0, 2], 1),
        ([*range(10), 11, 13, 12, 14, 15], 1),  # 10 was lost
    ],
)
def test_late_scans_are_put_back_in_order(indices, late):
    moved = []
    out = list(in_order([scan(i) for i in indices], moved.append))
    assert [s.stamp // PERIOD for s in out] == sorted(indices)
    assert len(moved) == late


def test_late_scans_of_an_uneven_clock():
    jitter = np.random.default_rng(1).integers(-PERIOD // 8, PERIOD // 8, 40)
    stamps = np.arange(40) * PERIOD + jitter
    scans = [Scan(int(stamps[i]), np.ones((4, 3))) for i in swapped(range(40), range(1, 39, 3))]
    assert [s.stamp for s in in_order(scans, print)] == sorted(stamps)


@pytest.mark.parametrize("back", [0.5, 1, 1.3, 1.5, 2, 2.5, 3.7, 5, 50])
def test_scans_after_a_clock_was_set_back_are_not_mixed_with_those_before(back):
    """They are left out until the clock is where it was."""
    stamps = [i * PERIOD for i in range(30)]
    stamps += [round(stamps[-1] + (1 - back + i) * PERIOD) for i in range(60)]
    scans = [Scan(stamp, np.ones((4, 3))) for stamp in stamps]
    moved = []
    assert [s.stamp for s in in_order(scans, moved.append)] == stamps
    assert not moved


@pytest.mark.parametrize("position", [0, 1, 2, 10])
def test_a_stamp_far_ahead_moves_nothing(position):
    indices = list(range(20))
    indices.insert(position, 10_000)
    moved = []
    out = in_order([scan(i) for i in indices], moved.append)
    assert [s.stamp // PERIOD for s in out] == indices
    assert not moved


def test_repeated_stamps_stay_where_they_are():
    indices = [0, 1, 2, 2, 3, 1, 4, 5, 5, 6]
    assert [s.stamp // PERIOD for s in in_order(map(scan, indices), print)] == indices


def test_late_scans_of_a_bag_are_used_and_counted(tmp_path, caplog):
    messages = sweeps("db3", 12)
    times = [time for _, _, time, _ in messages]
    late = [messages[i] for i in swapped(range(12), [2, 7])]
    late = [(*m[:2], time, m[3]) for m, time in zip(late, times, strict=True)]
    counts = InputCounts()
    source = BagSource(str(write_bag(tmp_path, "db3", late)))
    assert [s.stamp for s in clean(source, counts)] == times
    assert counts == InputCounts(read=12, used=12, reordered=2)
    assert "2 put back in order" in counts.summary()
    assert len([r for r in caplog.records if "put back in order" in r.message]) == 1
