"""Rows of a timeline."""

from lifelong_slam.timeline import COLUMNS, Timeline, TimelineRow

START = 1_700_000_000_123_456_789


def row(i):
    return TimelineRow(START + i, 20.5, 0.1 + i, 0.0, 1 / 3, i, 2 * i, 512.25, 0.0, 150.0)


def test_rows_come_back_as_they_were_to_the_nanosecond():
    rows = [row(i) for i in range(3000)]
    timeline = Timeline(rows[:10])
    for one in rows[10:]:
        timeline.append(one)
    assert len(timeline) == 3000
    assert list(timeline) == rows


def test_counts_stay_whole_numbers():
    kept = next(iter(Timeline([row(7)])))
    assert [type(getattr(kept, name)) for name in COLUMNS] == [
        int, float, float, float, float, int, int, float, float, float
    ]  # fmt: skip
