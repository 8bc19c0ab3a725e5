"""Trajectories: interpolation, checks, and the TUM format to the nanosecond."""

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from lifelong_slam.errors import SourceError
from lifelong_slam.geometry import exp
from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.trajectory import Trajectory, parse_seconds, read_tum, write_tum

EPOCH = 1_700_000_000_123_456_789


def turning(count=50, step=100_000_000):
    """A trajectory of constant twist, sampled every `step` nanoseconds."""
    seconds = np.arange(count) * step / NANOSECONDS
    twist = np.array([0.02, -0.05, 0.4, 5.0, 0.3, -0.1])
    return Trajectory(EPOCH + np.arange(count) * step, exp(seconds[:, None] * twist)), twist


def test_interpolation_follows_a_constant_twist_exactly():
    trajectory, twist = turning()
    stamps = EPOCH + np.array([0, 1, 12_345_678, 250_000_000, 4_900_000_000])
    expected = exp(((stamps - EPOCH) / NANOSECONDS)[:, None] * twist)
    np.testing.assert_allclose(trajectory.at(stamps), expected, atol=1e-10)


def test_interpolation_at_its_own_stamps_returns_its_own_poses():
    trajectory, _ = turning()
    np.testing.assert_allclose(trajectory.at(trajectory.stamps), trajectory.poses, atol=1e-10)


def test_interpolation_at_no_stamps_is_empty():
    trajectory, _ = turning()
    assert trajectory.at(np.zeros(0, dtype=np.int64)).shape == (0, 4, 4)


@pytest.mark.parametrize("outside", [EPOCH - 1, EPOCH + 4_900_000_001])
def test_interpolation_refuses_to_extrapolate(outside):
    trajectory, _ = turning()
    with pytest.raises(ValueError, match="outside"):
        trajectory.at(np.array([outside]))


def test_length_of_a_known_path():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, :3, 3] = [3, 4, 0]
    poses[2, :3, 3] = [3, 4, 12]
    assert Trajectory(np.arange(3), poses).length == pytest.approx(17.0)


@pytest.mark.parametrize("stamps", [[0, 0, 1], [0, 2, 1]])
def test_stamps_that_do_not_increase_are_refused(stamps):
    with pytest.raises(ValueError, match="increase"):
        Trajectory(np.array(stamps), np.tile(np.eye(4), (3, 1, 1)))


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="do not fit"):
        Trajectory(np.arange(3), np.tile(np.eye(4), (2, 1, 1)))


def test_tum_round_trip_to_the_nanosecond(tmp_path):
    trajectory, _ = turning()
    write_tum(tmp_path / "a.tum", trajectory)
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.stamps, trajectory.stamps)
    np.testing.assert_array_equal(back.positions, trajectory.positions)
    np.testing.assert_allclose(back.poses, trajectory.poses, atol=1e-14)


@given(st.lists(st.integers(-(2**61), 2**61), unique=True, min_size=1, max_size=20))
def test_any_stamp_survives_the_tum_format(tmp_path_factory, stamps):
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    ordered = np.array(sorted(stamps), dtype=np.int64)
    write_tum(path, Trajectory(ordered, np.tile(np.eye(4), (len(ordered), 1, 1))))
    np.testing.assert_array_equal(read_tum(path).stamps, ordered)


def test_evo_reads_what_we_write(tmp_path):
    trajectory, _ = turning()
    write_tum(tmp_path / "a.tum", trajectory)
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    np.testing.assert_allclose(read.timestamps, trajectory.stamps / NANOSECONDS, rtol=1e-15)
    np.testing.assert_array_equal(read.positions_xyz, trajectory.positions)
    np.testing.assert_allclose(np.array(read.poses_se3), trajectory.poses, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("0", 0),
        ("1.5", 1_500_000_000),
        (".25", 250_000_000),
        ("1311868164.363181", 1_311_868_164_363_181_000),
        ("1700000000.123456789", EPOCH),
        ("1700000000.1234567899", EPOCH),
        ("-0.5", -500_000_000),
        ("-1.5", -1_500_000_000),
        ("1e3", 1_000_000_000_000),
    ],
)
def test_seconds_keep_their_digits(text, nanoseconds):
    assert parse_seconds(text) == nanoseconds


@pytest.mark.parametrize(
    "content", ["", "# only a comment\n", "1 2 3\n", "a 0 0 0 0 0 0 1\n", "1 0 0 0 0 0 0 0\n"]
)
def test_what_is_not_a_tum_file_is_named(tmp_path, content):
    path = tmp_path / "bad.tum"
    path.write_text(content)
    with pytest.raises(SourceError, match=r"bad\.tum is not a TUM trajectory"):
        read_tum(path)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(SourceError, match="no such trajectory"):
        read_tum(tmp_path / "none.tum")


def test_comments_and_blank_lines_are_skipped(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("# stamp x y z ...\n\n1 1 2 3 0 0 0 1\n# more\n2 1 2 4 0 0 0 1\n")
    assert read_tum(path).length == pytest.approx(1.0)


def test_a_writer_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    trajectory, _ = turning(5)
    path = tmp_path / "a.tum"
    write_tum(path, trajectory)
    old = path.read_bytes()
    monkeypatch.setattr("lifelong_slam.trajectory.NANOSECONDS", 0)  # fails at the first row
    with pytest.raises(ZeroDivisionError):
        write_tum(path, trajectory)
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]
