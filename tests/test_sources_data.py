"""Real recordings, where they are at hand."""

import os
from pathlib import Path

import numpy as np
import pytest

from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.cleaning import InputCounts, clean
from lifelong_slam.sources.folder import FolderSource

ROOT = Path(__file__).parent.parent
DATA = ROOT / os.environ.get("LIFELONG_SLAM_DATA", "../shared/data") / "lidar3d"


def recording(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not there (LIFELONG_SLAM_DATA names the data folder)")
    return path


@pytest.mark.data
@pytest.mark.slow
def test_kitti_drive_as_a_bag():
    counts = InputCounts()
    source = BagSource(str(recording("kitti_2011_09_26_drive_0005.bag")))
    scans = list(clean(source, counts))
    assert len(scans) == len(source) == counts.used == counts.read == 154
    assert all(scan.offsets is None for scan in scans)
    assert 90_000 < np.mean([len(scan.points) for scan in scans]) < 130_000


@pytest.mark.data
def test_a_part_of_the_drive_as_if_its_recorder_had_crashed(tmp_path):
    path = recording("kitti_2011_09_26_drive_0005.bag")
    with path.open("rb") as file:
        (tmp_path / "cut.bag").write_bytes(file.read(path.stat().st_size // 50))
    scans = list(BagSource(str(tmp_path / "cut.bag")))
    assert len(scans) >= 2


@pytest.mark.data
@pytest.mark.parametrize(("name", "count", "length"), [("1", 314, 63.6), ("2", 266, 58.5)])
def test_solid_state_session(name, count, length):
    folder = recording(f"hku_session_{name}")
    source = FolderSource(
        str(folder / "scans"), str(folder / "times.txt"), str(folder / "odom_poses.txt")
    )
    counts = InputCounts()
    scans = list(clean(source, counts))
    assert len(scans) == counts.used == count
    assert len(source.reference()) == count
    assert source.reference().length == pytest.approx(length, abs=0.1)
