import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifelong_slam.sources.assembly import assemble
from lifelong_slam.sources.point_times import PointTimes, Sweep, is_time_field
from lifelong_slam.sources.pointcloud2 import Cloud

EPOCH = 1_700_000_000_123_456_789
TRUE = np.linspace(0.0, 0.0995, 200)


def sweeps_of(field, encode, start=EPOCH, count=10):
    points = np.random.default_rng(0).normal(size=(len(TRUE), 3))
    stamps = [start + i * 100_000_000 for i in range(count)]
    return [Sweep(stamp, {field: encode(stamp)}, points) for stamp in stamps]


def decoded(sweeps):
    times = PointTimes("test")
    times.decide(sweeps)
    return [times.offsets(sweep) for sweep in sweeps]


DRIVERS = {
    "ouster t": ("t", lambda s: (TRUE * 1e9).astype(np.uint32), 1e-8),
    "velodyne time": ("time", lambda s: TRUE.astype(np.float32), 1e-7),
    "livox offset_time": ("offset_time", lambda s: (TRUE * 1e9).astype(np.uint32), 1e-8),
    "hesai timestamp": ("timestamp", lambda s: s / 1e9 + TRUE, 1e-6),
    "livox2 timestamp": ("timestamp", lambda s: s + TRUE * 1e9, 1e-6),
    "uint64 ns": ("time_stamp", lambda s: np.uint64(s) + (TRUE * 1e9).astype(np.uint64), 1e-8),
    "int64 us": ("stamp", lambda s: s // 1000 + (TRUE * 1e6).astype(np.int64), 3e-6),
    "float32 us": ("timeOffset", lambda s: (TRUE * 1e6).astype(np.float32), 1e-6),
    "float64 ms": ("offset_ms", lambda s: TRUE * 1e3, 1e-9),
    "int32 ns": ("time_offset_ns", lambda s: (TRUE * 1e9).astype(np.int32), 1e-8),
}


@pytest.mark.parametrize("driver", [d for d in DRIVERS if DRIVERS[d][0] != "offset_ms"])
def test_encodings_of_drivers(driver):
    field, encode, tolerance = DRIVERS[driver]
    for offsets in decoded(sweeps_of(field, encode)):
        np.testing.assert_allclose(offsets, TRUE, atol=tolerance)


def test_stamps_at_the_end_of_the_sweep_give_negative_offsets():
    for offsets in decoded(sweeps_of("time", lambda s: (TRUE - 0.1).astype(np.float32))):
        np.testing.assert_allclose(offsets, TRUE - 0.1, atol=1e-7)
    for offsets in decoded(sweeps_of("timestamp", lambda s: (s - 10**8) / 1e9 + TRUE)):
        np.testing.assert_allclose(offsets, TRUE - 0.1, atol=1e-6)


@pytest.mark.parametrize("start", [0, 30 * 10**9])
def test_absolute_times_of_a_clock_that_starts_at_zero(start):
    for offsets in decoded(sweeps_of("t", lambda s: (s + TRUE * 1e9).astype(np.uint64), start)):
        np.testing.assert_allclose(offsets, TRUE, atol=1e-8)


@pytest.mark.parametrize("kind", [np.uint64, np.float64])
def test_clock_of_its_own_counts_from_the_first_point(kind, caplog):
    caplog.set_level(logging.INFO)
    uptime = 5_000 * 10**9
    encode = lambda s: (s - EPOCH + uptime + TRUE * 1e9).astype(kind)  # noqa: E731
    for offsets in decoded(sweeps_of("t", encode)):
        np.testing.assert_allclose(offsets, TRUE, atol=1e-6)
    assert "clock of their own" in caplog.text


@given(
    unit=st.sampled_from([1e9, 1e6, 1e3, 1.0]),
    duration=st.floats(0.01, 1.0),
    shift=st.floats(-1.0, 0.0),
    kind=st.sampled_from([np.float32, np.float64, np.int64]),
)
def test_any_relative_encoding(unit, duration, shift, kind):
    true = np.linspace(0, duration, 100) + shift * duration
    values = (true * unit).astype(kind)
    points = np.ones((100, 3))
    sweeps = [Sweep(EPOCH + i * 10**8, {"t": values}, points) for i in range(3)]
    offsets = decoded(sweeps)[0]
    if len(np.unique(values)) < 5:  # whole numbers too coarse for the unit
        return
    np.testing.assert_allclose(offsets, true, atol=1.01 / unit + 1e-6)


def test_the_choice_is_logged_once(caplog):
    caplog.set_level(logging.INFO)
    field, encode, _ = DRIVERS["ouster t"]
    decoded(sweeps_of(field, encode))
    assert [r.message for r in caplog.records] == [
        "test: point times in field 't', ns from the header stamp"
    ]


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(200),
        np.full(200, 1.7e9, np.float32),
        np.linspace(0, 1e12, 200),
        np.full(200, np.nan),
    ],
)
def test_garbage_counts_as_absent(values, caplog):
    assert decoded(sweeps_of("t", lambda s: values)) == [None] * 10
    assert "treated as absent" in caplog.text
    assert len(caplog.records) == 1


def test_no_time_field(caplog):
    sweeps = [Sweep(EPOCH, {}, np.ones((5, 3)))]
    assert decoded(sweeps) == [None]
    assert "can't be deskewed" in caplog.text


def test_a_good_field_beside_a_constant_one():
    sweeps = sweeps_of("timestamp", lambda s: s / 1e9 + TRUE)
    for sweep in sweeps:
        sweep.times["t"] = np.zeros(len(TRUE))
    np.testing.assert_allclose(decoded(sweeps)[3], TRUE, atol=1e-6)


def test_unset_times_of_missing_returns_do_not_disturb():
    sweeps = sweeps_of("timestamp", lambda s: s / 1e9 + TRUE)
    for sweep in sweeps:
        sweep.points[::3] = 0.0
        sweep.times["timestamp"][::3] = 0.0
    for offsets in decoded(sweeps):
        assert np.isnan(offsets[::3]).all()
        np.testing.assert_allclose(offsets[1::3], TRUE[1::3], atol=1e-6)


def test_partial_first_sweeps_do_not_decide():
    sweeps = sweeps_of("t", lambda s: (TRUE * 1e9).astype(np.uint32))
    sweeps[0].times["t"][:] = np.linspace(0, 1e5, len(TRUE)).astype(np.uint32)
    np.testing.assert_allclose(decoded(sweeps)[5], TRUE, atol=1e-8)


def test_one_odd_sweep_is_not_deskewed(caplog):
    sweeps = sweeps_of("timestamp", lambda s: s / 1e9 + TRUE)
    times = PointTimes("test")
    times.decide(sweeps)
    odd = Sweep(EPOCH, {"timestamp": TRUE.copy()}, sweeps[0].points)
    assert times.offsets(odd) is None
    assert times.offsets(odd) is None
    assert times.odd_sweeps == 2
    assert len([r for r in caplog.records if "not deskewed" in r.message]) == 1


def test_names():
    for name in ("t", "time", "timestamp", "time_stamp", "offset_time", "timeOffset", "t_ns"):
        assert is_time_field(name)
    for name in ("x", "intensity", "ring", "tag", "reflectivity", "line", "ambient", "rgb"):
        assert not is_time_field(name)


# What a 32-bit counter makes of times before zero, in its own width or copied to another.
WRAPPED = {
    "uint32 ns": (1e9, np.uint32),
    "uint32 us": (1e6, np.uint32),
    "uint64 of uint32 ns": (1e9, np.uint64),
    "int64 of uint32 ns": (1e9, np.int64),
    "float64 of uint32 ns": (1e9, np.float64),
    "float32 of uint32 ns": (1e9, np.float32),
}


def wrapped(true, rate, kind):
    return (np.round(true * rate).astype(np.int64) % 2**32).astype(kind)


@pytest.mark.parametrize("late", [0.02, 0.06, 0.1])  # 0.1: the header is later than all points
@pytest.mark.parametrize("counter", WRAPPED)
def test_times_before_the_header_in_a_counter_without_a_sign(counter, late):
    rate, kind = WRAPPED[counter]
    encode = lambda s: wrapped(TRUE - late, rate, kind)  # noqa: E731
    for offsets in decoded(sweeps_of("t", encode)):
        np.testing.assert_allclose(offsets, TRUE - late, atol=2e-6)


def test_wrapped_nanoseconds_as_seconds():
    encode = lambda s: wrapped(TRUE - 0.02, 1e9, np.float64) * 1e-9  # noqa: E731
    for offsets in decoded(sweeps_of("time", encode)):
        np.testing.assert_allclose(offsets, TRUE - 0.02, atol=1e-8)


def test_negative_64_bit_counts_without_a_sign():
    encode = lambda s: ((TRUE - 0.02) * 1e9).astype(np.int64).astype(np.uint64)  # noqa: E731
    for offsets in decoded(sweeps_of("t", encode)):
        np.testing.assert_allclose(offsets, TRUE - 0.02, atol=1e-8)


def test_headers_that_are_late_now_and_then():
    sweeps = sweeps_of("t", lambda s: wrapped(TRUE, 1e9, np.uint32))
    for sweep in sweeps[5::6]:
        sweep.times["t"][:] = wrapped(TRUE - 0.06, 1e9, np.uint32)
    for i, offsets in enumerate(decoded(sweeps)):
        np.testing.assert_allclose(offsets, TRUE - 0.06 * (i % 6 == 5), atol=1e-8)


@pytest.mark.parametrize("kind", [np.uint32, np.int32])
def test_a_free_counter_that_overflows_within_a_sweep(kind):
    top = 2**32 if kind is np.uint32 else 2**31
    start = top - 250_000_000  # within the third sweep
    encode = lambda s: (  # noqa: E731
        (start + s - EPOCH + (TRUE * 1e9).astype(np.int64)).astype(np.uint32).astype(kind)
    )
    for offsets in decoded(sweeps_of("t", encode)):
        np.testing.assert_allclose(offsets, TRUE, atol=1e-8)


@given(
    unit=st.sampled_from([("ns", 1e9), ("us", 1e6)]),
    duration=st.floats(0.01, 1.0),
    shift=st.floats(-1.0, 0.0),
)
def test_any_wrapped_sweep(unit, duration, shift):
    true = np.linspace(0, duration, 100) + shift * duration
    sweeps = [
        Sweep(EPOCH + i * 10**8, {"t": wrapped(true, unit[1], np.uint32)}, np.ones((100, 3)))
        for i in range(3)
    ]
    np.testing.assert_allclose(decoded(sweeps)[0], true, atol=1.01 / unit[1])


# Sweeps that tell nothing, as drivers send them before the first real one.
STARTS = {
    "empty": (np.zeros((0, 3)), lambda v: v[:0]),
    "one point": (np.ones((1, 3)), lambda v: v[:1]),
    "no returns": (np.zeros((200, 3)), lambda v: v),
    "all NaN": (np.full((200, 3), np.nan), lambda v: v),
    "constant times": (np.ones((200, 3)), np.zeros_like),
    "no times": (np.ones((200, 3)), None),
}
ENCODINGS = [
    *(DRIVERS[name][:2] for name in DRIVERS if name != "float64 ms"),
    ("t", lambda s: wrapped(TRUE - 0.02, 1e9, np.uint32)),
    ("time", lambda s: TRUE - 0.1),
    ("timestamp", lambda s: (s - 10**8) / 1e9 + TRUE),
]


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("number", range(len(ENCODINGS)))
def test_sweeps_that_tell_nothing_come_first(start, number):
    field, encode = ENCODINGS[number]
    real = sweeps_of(field, encode)
    expected = decoded(real)
    points, cut = STARTS[start]
    mute = [
        (stamp, Cloud(points, {field: cut(encode(stamp))} if cut else {}))
        for stamp in (EPOCH - (i + 1) * 10**8 for i in reversed(range(32)))
    ]
    scans = list(assemble([*mute, *((s.stamp, Cloud(s.points, s.times)) for s in real)], "test"))
    assert len(scans) == 42
    for scan, offsets in zip(scans[-10:], expected, strict=True):
        np.testing.assert_array_equal(scan.offsets, offsets)


def test_the_reason_without_times_is_logged_once(caplog):
    clouds = [(EPOCH + i * 10**8, Cloud(np.ones((5, 3)), {"t": np.zeros(5)})) for i in range(35)]
    assert [scan.offsets for scan in assemble(clouds, "test")] == [None] * 35
    (record,) = caplog.records
    assert "treated as absent" in record.message


def test_one_sweep_that_tells_does_not_decide_alone():
    # on a clock of its own, started 1 s before: one sweep alone may be late by that
    encode = lambda s: (s - EPOCH + 10**9 + TRUE * 1e9).astype(np.uint64)  # noqa: E731
    real = sweeps_of("t", encode)
    mute = [(EPOCH - (9 - i) * 10**8, Cloud(np.ones((9, 3)), {"t": np.zeros(9)})) for i in range(9)]
    scans = list(assemble([*mute, *((s.stamp, Cloud(s.points, s.times)) for s in real)], "test"))
    for scan in scans[-10:]:
        np.testing.assert_allclose(scan.offsets, TRUE, atol=1e-8)
