import numpy as np
import pytest

from lifelong_slam.errors import SourceError
from lifelong_slam.geometry import exp, invert
from lifelong_slam.sources.kitti import KittiSource

TR = np.array([[0, -1, 0, 0.01], [0, 0, -1, -0.07], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])


def points(index):
    return np.random.default_rng(index).normal(size=(20, 3)).astype(np.float32)


def write_scans(folder, numbers):
    folder.mkdir(parents=True)
    for i in numbers:
        values = np.column_stack([points(i), np.ones(20, np.float32)])
        values.tofile(folder / f"{i:010d}.bin")


def row(T):
    return " ".join(repr(float(v)) for v in T[:3].ravel())


@pytest.fixture
def benchmark(tmp_path):
    """An odometry root with sequences 00 and 07 of 6 scans, and poses for 00."""
    T_lidar = exp(np.cumsum(np.full((6, 6), 0.1), axis=0) - 0.1)
    for name in ("00", "07"):
        sequence = tmp_path / "sequences" / name
        write_scans(sequence / "velodyne", range(6))
        (sequence / "times.txt").write_text("\n".join(f"{i / 10:e}" for i in range(6)))
        (sequence / "calib.txt").write_text(f"P0: {row(np.eye(4))}\nTr: {row(TR)}\n")
    (tmp_path / "poses").mkdir()
    camera = TR @ T_lidar @ invert(TR)
    (tmp_path / "poses" / "00.txt").write_text("\n".join(row(T) for T in camera))
    return tmp_path, T_lidar


@pytest.mark.parametrize("sequence", ["00", "0", 0])
def test_odometry_layout(benchmark, sequence, caplog):
    root, T_lidar = benchmark
    source = KittiSource(str(root), sequence)
    scans = list(source)
    assert [s.stamp for s in scans] == [i * 10**8 for i in range(6)]
    for i, scan in enumerate(scans):
        np.testing.assert_array_equal(scan.points, points(i).astype(np.float64))
        assert scan.offsets is None
    np.testing.assert_allclose(source.reference().poses, T_lidar, atol=1e-12)
    assert "can't be deskewed" in caplog.text


def test_one_sequence_by_its_own_folder(benchmark):
    root, T_lidar = benchmark
    source = KittiSource(str(root / "sequences" / "00"))
    np.testing.assert_allclose(source.reference().poses, T_lidar, atol=1e-12)
    assert KittiSource(str(root / "sequences" / "07")).reference() is None


def test_sequence_must_be_named_and_there(benchmark):
    root, _ = benchmark
    with pytest.raises(SourceError, match="2 sequences; name one: 00, 07"):
        KittiSource(str(root))
    with pytest.raises(SourceError, match=r"no sequence '08'.*It has: 00, 07"):
        KittiSource(str(root), "08")


def test_poses_without_calibration(benchmark, caplog):
    root, _ = benchmark
    (root / "sequences" / "00" / "calib.txt").unlink()
    assert KittiSource(str(root), "00").reference() is None
    assert "calib.txt" in caplog.text


def test_calibration_without_the_lidar(benchmark):
    root, _ = benchmark
    (root / "sequences" / "00" / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(SourceError, match="no Tr row"):
        KittiSource(str(root), "00").reference()


def drive(folder, numbers, lines):
    write_scans(folder / "velodyne_points" / "data", numbers)
    text = "\n".join(f"2011-09-26 13:02:{25 + i}.594360375" for i in range(lines))
    (folder / "velodyne_points" / "timestamps.txt").write_text(text)


def test_raw_drive_with_lost_scans(tmp_path):
    drive(tmp_path / "drive_0009_sync", [0, 1, 4], 6)
    for path in (tmp_path, tmp_path / "drive_0009_sync"):
        source = KittiSource(str(path))
        first = 1_317_042_145_594_360_375
        assert [s.stamp for s in source] == [first, first + 10**9, first + 4 * 10**9]
        assert source.reference() is None


def test_fewer_times_than_scans(tmp_path):
    drive(tmp_path, range(6), 3)
    with pytest.raises(SourceError, match="has 3 rows, but the scans go up to number 5"):
        KittiSource(str(tmp_path))


def test_a_cut_scan_is_left_out(benchmark, caplog):
    root, _ = benchmark
    path = root / "sequences" / "00" / "velodyne" / "0000000002.bin"
    path.write_bytes(path.read_bytes()[:-7])
    assert [s.stamp // 10**8 for s in KittiSource(str(root), "00")] == [0, 1, 3, 4, 5]
    assert "1 of 6 files left out" in caplog.text


def test_what_is_not_kitti(tmp_path):
    with pytest.raises(SourceError, match="no such folder"):
        KittiSource(str(tmp_path / "none"))
    with pytest.raises(SourceError, match="is not a KITTI folder"):
        KittiSource(str(tmp_path))
    (tmp_path / "velodyne").mkdir()
    with pytest.raises(SourceError, match=r"holds no .bin scans"):
        KittiSource(str(tmp_path))
