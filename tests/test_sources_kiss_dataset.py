import logging

import numpy as np
import pytest
from sources_support import START, sweeps, write_bag

from lifelong_slam.errors import SourceError
from lifelong_slam.sources.kiss_dataset import KissDatasetSource


def write_mulran(folder, full=True):
    """A MulRan sequence of 4 scans of 64 x 1024 points with poses."""
    (folder / "Ouster").mkdir()
    stamps = [START + i * 100_000_000 for i in range(4)]
    for stamp in stamps:
        count = 64 * 1024 if full else 100
        np.ones((count, 4), np.float32).tofile(folder / "Ouster" / f"{stamp}.bin")
    rows = [[stamp, *np.eye(4)[:3].ravel()] for stamp in stamps]
    np.savetxt(folder / "global_pose.csv", rows, delimiter=",", fmt="%.0f")
    return stamps


def test_mulran(tmp_path):
    stamps = write_mulran(tmp_path)
    source = KissDatasetSource("mulran", str(tmp_path))
    scans = list(source)
    assert [s.stamp for s in scans] == stamps
    for scan in scans:
        assert scan.points.shape == (64 * 1024, 3)
        assert scan.offsets.min() == 0.0
        assert scan.offsets.max() == pytest.approx(0.1 * 1023 / 1024)
    reference = source.reference()
    assert reference.stamps.tolist() == stamps
    np.testing.assert_allclose(reference.positions, 0, atol=1e-9)


def test_scans_without_point_times(tmp_path, caplog):
    write_mulran(tmp_path, full=False)
    assert all(s.offsets is None for s in KissDatasetSource("mulran", str(tmp_path)))
    assert "can't be deskewed" in caplog.text


def test_stamps_that_come_with_reading(tmp_path):
    path = write_bag(tmp_path, "ros1", sweeps("ros1", 5, 300))
    source = KissDatasetSource("rosbag", str(path), topic="/lidar")
    for _ in range(2):
        scans = list(source)
        assert [round((s.stamp - START) / 1e8) for s in scans] == [0, 1, 2, 3, 4]
        assert all(len(s.points) == 300 and s.duration == pytest.approx(0.1) for s in scans)


def test_a_loader_that_exits_becomes_an_error(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    path = write_bag(tmp_path, "ros1", sweeps("ros1", 2))
    with pytest.raises(SourceError, match=r"loader 'rosbag'.*/nothing.*--topic /lidar") as caught:
        KissDatasetSource("rosbag", str(path), topic="/nothing")
    assert "\n" not in str(caught.value)
    assert "--topic /lidar" in caplog.text


def test_loaders_that_lack_something(tmp_path, capsys):
    with pytest.raises(SourceError, match="nuscenes"):
        KissDatasetSource("nuscenes", str(tmp_path), sequence="1")
    with pytest.raises(SourceError, match="sequence"):
        KissDatasetSource("kitti", str(tmp_path))
    with pytest.raises(SourceError, match="loader 'mulran'"):
        KissDatasetSource("mulran", str(tmp_path))
    assert capsys.readouterr().out == ""


def test_unknown_loader_and_path(tmp_path):
    with pytest.raises(SourceError, match=r"no loader 'mulram'. Did you mean 'mulran'"):
        KissDatasetSource("mulram", str(tmp_path))
    with pytest.raises(SourceError, match="no such file or folder"):
        KissDatasetSource("mulran", str(tmp_path / "none"))


def test_scans_that_fail_are_left_out(tmp_path, caplog):
    stamps = write_mulran(tmp_path, full=False)
    (tmp_path / "Ouster" / f"{stamps[1]}.bin").write_bytes(b"123456789")
    source = KissDatasetSource("mulran", str(tmp_path))
    assert [s.stamp for s in source] == [stamps[0], *stamps[2:]]
    assert source.unreadable == 1
    assert "1 unreadable scans left out" in caplog.text
    for stamp in stamps:
        (tmp_path / "Ouster" / f"{stamp}.bin").write_bytes(b"123456789")
    with pytest.raises(SourceError, match="failed on every scan"):
        list(source)
