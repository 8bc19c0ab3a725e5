"""Stamps of headers that can't be right."""

import numpy as np
import pytest
from sources_support import CLOUD, PERIOD, START, cloud_message, write_bag, xyz

from lifelong_slam.errors import SourceError
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.cleaning import REPEATED, UNREADABLE, InputCounts, clean

LAG = 30_000_000
COUNT = 60
RIGHT = [START + i * PERIOD for i in range(COUNT)]


def source(folder, stamps, received=None, contents=None):
    received = received or [START + i * PERIOD + LAG for i in range(len(stamps))]
    contents = contents or range(len(stamps))
    messages = [
        ("/lidar", CLOUD, time, cloud_message(xyz(8, seed), stamp))
        for stamp, time, seed in zip(stamps, received, contents, strict=True)
    ]
    return BagSource(str(write_bag(folder, "db3", messages)))


def stamps_of(recording):
    return [scan.stamp for scan in recording]


@pytest.mark.parametrize(
    "stamps",
    [
        [0] * COUNT,
        [START] * COUNT,
        [5_000_000_000] * COUNT,
        [START] * 30 + RIGHT[30:],
        [stamp // 10**9 * 10**9 for stamp in RIGHT],
        [stamp // 1000 for stamp in RIGHT],  # microseconds
        [i * PERIOD * 1000 for i in range(COUNT)],
        [s // 10**9 * 10**9 + s % 10**9 // 1000 for s in RIGHT],  # in the nanoseconds alone
    ],
)
def test_receive_times_where_stamps_are_of_no_use(tmp_path, stamps, caplog):
    assert stamps_of(source(tmp_path, stamps)) == [stamp + LAG for stamp in RIGHT]
    assert len([r for r in caplog.records if "receive times used" in r.message]) == 1


@pytest.mark.parametrize("wrong", [0, 123_000_000, 90_000_000_000])
@pytest.mark.parametrize("count", [1, 3])
def test_first_stamps_of_another_clock(tmp_path, wrong, count, caplog):
    stamps = [wrong + i * PERIOD * (wrong > 0) for i in range(count)] + RIGHT[count:]
    recording = source(tmp_path, stamps)
    assert stamps_of(recording) == RIGHT
    assert stamps_of(recording) == RIGHT  # and again
    assert "receive time less the usual lag" in caplog.text


def test_a_stamp_is_missing_in_the_middle(tmp_path):
    assert stamps_of(source(tmp_path, [*RIGHT[:40], 0, *RIGHT[41:]])) == RIGHT


def test_stamps_stand_still_for_a_while(tmp_path, caplog):
    stamps = [*RIGHT[:25], *[RIGHT[25]] * 20, *RIGHT[45:]]
    assert stamps_of(source(tmp_path, stamps)) == RIGHT
    assert len(caplog.records) == 2  # the other says that there are no point times


def test_a_clock_that_is_set_stays_for_cleaning(tmp_path):
    stamps = [*RIGHT[:40], *(stamp - 10**12 for stamp in RIGHT[40:])]
    assert stamps_of(source(tmp_path, stamps)) == stamps


@pytest.mark.parametrize("start", [0, 1])
def test_simulated_time_may_start_at_zero(tmp_path, start):
    stamps = [(start + i) * PERIOD for i in range(COUNT)]
    rng = np.random.default_rng(0)
    received = [START + i * PERIOD + int(rng.integers(0, PERIOD // 2)) for i in range(COUNT)]
    assert stamps_of(source(tmp_path, stamps, received)) == stamps


@pytest.mark.parametrize("times", [2, 3])
def test_clouds_published_again_and_again_are_used_once(tmp_path, times):
    stamps = [RIGHT[i - i % times] for i in range(COUNT)]
    counts = InputCounts()
    recording = source(tmp_path, stamps, contents=[i // times for i in range(COUNT)])
    assert [s.stamp for s in clean(recording, counts)] == RIGHT[::times]
    assert counts.skipped == {REPEATED: COUNT - COUNT // times}


def test_two_returns_as_two_clouds_of_one_stamp(tmp_path):
    stamps = [RIGHT[i - i % 2] for i in range(COUNT)]
    received = [stamp + LAG + i % 2 * 1_000_000 for i, stamp in enumerate(stamps)]
    assert stamps_of(source(tmp_path, stamps, received)) == stamps


def test_stamps_are_kept_where_receive_times_are_those_of_a_conversion(tmp_path):
    received = [START + 10**13 + i * 1000 for i in range(COUNT)]
    assert stamps_of(source(tmp_path, RIGHT, received)) == RIGHT
    slow = [START + i * 10 * PERIOD for i in range(COUNT)]
    assert stamps_of(source(tmp_path / "slow", slow, received)) == slow


def test_a_missing_stamp_among_such_is_left_out(tmp_path):
    received = [START + 10**13 + i * 1000 for i in range(COUNT)]
    counts = InputCounts()
    recording = source(tmp_path, [0, *RIGHT[1:]], received)
    assert [s.stamp for s in clean(recording, counts)] == RIGHT[1:]
    assert counts.skipped == {UNREADABLE: 1}


def test_nothing_tells_when_clouds_were_measured(tmp_path):
    with pytest.raises(SourceError, match=r"stand still.*receive times are all the same"):
        source(tmp_path, [START] * COUNT, [START] * COUNT)
