import logging

import numpy as np
import open3d as o3d
import pytest

from lifelong_slam.errors import SourceError
from lifelong_slam.geometry import exp
from lifelong_slam.sources.folder import FolderSource
from lifelong_slam.trajectory import Trajectory, write_tum

COUNT = 12
TRUE = np.linspace(0.0, 0.09, 30)


def points(index, count=30):
    return np.random.default_rng(index).normal(scale=5, size=(count, 3)).astype(np.float32)


def write_cloud(path, values, times=None, **options):
    cloud = o3d.t.geometry.PointCloud(values)
    if times is not None:
        cloud.point["timestamp"] = o3d.core.Tensor(times.reshape(-1, 1))
    assert o3d.t.io.write_point_cloud(path, cloud, **options)


def write_bin(path, values):
    np.column_stack([values, np.ones(len(values), np.float32)]).tofile(path)


@pytest.fixture
def folder(tmp_path):
    for i in range(COUNT):
        write_bin(tmp_path / f"{i}.bin", points(i))
    return tmp_path


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        (".pcd", {}),
        (".pcd", {"write_ascii": True}),
        (".pcd", {"compressed": True}),
        (".ply", {}),
        (".ply", {"write_ascii": True}),
    ],
)
def test_point_clouds_in_natural_order(tmp_path, suffix, options):
    for i in range(COUNT):
        write_cloud(tmp_path / f"scan_{i}{suffix}", points(i), **options)
    source = FolderSource(str(tmp_path))
    assert len(source) == COUNT
    for i, scan in enumerate(source):
        assert scan.stamp == i * 100_000_000
        assert scan.offsets is None
        np.testing.assert_allclose(scan.points, points(i), rtol=1e-5, atol=1e-5)


def test_bin_files(folder, caplog):
    for i, scan in enumerate(FolderSource(str(folder))):
        np.testing.assert_array_equal(scan.points, points(i).astype(np.float64))
    assert "stamps are nominal, 10 scans a second" in caplog.text
    assert "can't be deskewed" in caplog.text


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_point_times_in_files(tmp_path, suffix):
    for i in range(3):
        write_cloud(tmp_path / f"{i}{suffix}", points(i), TRUE.copy())
    for scan in FolderSource(str(tmp_path)):
        np.testing.assert_allclose(scan.offsets, TRUE)


def test_pcd_by_others_with_any_fields_and_nan(tmp_path):
    (tmp_path / "7.pcd").write_text(
        "VERSION .7\nFIELDS t intensity x y z\nSIZE 4 4 8 4 4\nTYPE U F F F F\nCOUNT 1 1 1 1 1\n"
        "WIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"
        "0 0.5 1 2 3\n50000000 0.5 nan 2 3\n99000000 0.5 4 5 6\n"
    )
    (scan,) = list(FolderSource(str(tmp_path)))
    np.testing.assert_allclose(scan.points, [[1, 2, 3], [np.nan, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(scan.offsets, [0, 0.05, 0.099])


def test_times_to_the_nanosecond(folder):
    lines = [f"{1_600_000_000 + i}.123456789" for i in range(COUNT)]
    times = folder / "times.txt"
    times.write_text("# seconds\n" + "\n".join(lines) + "\n\n")
    stamps = [scan.stamp for scan in FolderSource(str(folder), str(times))]
    assert stamps == [(1_600_000_000 + i) * 10**9 + 123_456_789 for i in range(COUNT)]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1\n2\n", r"has 2 times, but there are 12 scans"),
        ("1\nten\n", r"line 2: 'ten' is not a time"),
    ],
)
def test_bad_times(folder, text, reason):
    path = folder / "times.txt"
    path.write_text(text)
    with pytest.raises(SourceError, match=reason):
        FolderSource(str(folder), str(path))


def poses(count):
    return exp(np.random.default_rng(5).normal(size=(count, 6)))


def write_kitti(path, values):
    np.savetxt(path, values[:, :3, :].reshape(len(values), 12), fmt="%.6g")


def test_kitti_poses_with_few_digits(folder):
    times, path = folder / "times.txt", folder / "poses.txt"
    times.write_text("\n".join(str(i) for i in range(COUNT)))
    write_kitti(path, poses(COUNT))
    reference = FolderSource(str(folder), str(times), str(path)).reference()
    np.testing.assert_array_equal(reference.stamps, np.arange(COUNT) * 10**9)
    np.testing.assert_allclose(reference.poses, poses(COUNT), atol=1e-4)
    R = reference.poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (COUNT, 1, 1)), atol=1e-12)


@pytest.mark.parametrize("count", [5, COUNT])
def test_tum_poses_beside_times(folder, count):
    times, path = folder / "times.txt", folder / "poses.txt"
    times.write_text("\n".join(str(i) for i in range(COUNT)))
    given = Trajectory(np.arange(count) * 7, poses(count))
    write_tum(path, given)
    reference = FolderSource(str(folder), str(times), str(path)).reference()
    np.testing.assert_array_equal(reference.stamps, given.stamps)
    np.testing.assert_allclose(reference.poses, given.poses, atol=1e-12)


def test_tum_poses_without_times_give_the_stamps(folder):
    path = folder / "poses.txt"
    given = Trajectory(1_600_000_000_000_000_001 + np.arange(COUNT) * 10**8, poses(COUNT))
    write_tum(path, given)
    assert [s.stamp for s in FolderSource(str(folder), None, str(path))] == given.stamps.tolist()
    write_tum(path, Trajectory(given.stamps[1:], given.poses[1:]))
    with pytest.raises(SourceError, match="11 TUM poses without times, but there are 12 scans"):
        FolderSource(str(folder), None, str(path))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no poses"),
        ("1 2 3\n", r"12 numbers \(KITTI 3x4\) or 8 \(TUM\), its first has 3"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "has 3 poses, but there are 12 scans"),
        ("1 0 0 0 0 1 0 0 0 0 1 x\n" * 12, "line 1: expected 12 finite numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 nan\n" * 12, "line 1: expected 12 finite numbers"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n" * 12, "pose 1 is not a rotation"),
        ("0 0 0 0 0 0 0 0\n" * 12, "quaternion of length zero"),
    ],
)
def test_bad_poses(folder, text, reason):
    path = folder / "poses.txt"
    path.write_text(text)
    with pytest.raises(SourceError, match=reason):
        FolderSource(str(folder), None, str(path))


def test_missing_files_are_named(folder, tmp_path):
    with pytest.raises(SourceError, match=r"no such folder: .*none"):
        FolderSource(str(tmp_path / "none"))
    with pytest.raises(SourceError, match=r"no such file: .*none"):
        FolderSource(str(folder), str(tmp_path / "none"))
    with pytest.raises(SourceError, match=r"no such file: .*none"):
        FolderSource(str(folder), None, str(tmp_path / "none"))
    with pytest.raises(SourceError, match="is a file: expected a folder"):
        FolderSource(str(folder / "0.bin"))


def test_folder_without_scans(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(SourceError, match="holds no scans"):
        FolderSource(str(tmp_path))


def test_scans_one_folder_down(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    (tmp_path / "scans").mkdir()
    write_bin(tmp_path / "scans" / "0.bin", points(0))
    assert len(FolderSource(str(tmp_path))) == 1
    assert "scans taken from its folder scans" in caplog.text


def test_the_most_frequent_kind_is_read(folder, caplog):
    write_cloud(folder / "map.ply", points(0))
    assert len(FolderSource(str(folder))) == COUNT
    assert "the 1 others left" in caplog.text


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".bin"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.97])
@pytest.mark.parametrize("ascii_text", [False, True])
def test_cut_files_are_left_out(tmp_path, suffix, share, ascii_text, caplog):
    for i in range(3):
        path = tmp_path / f"{i}{suffix}"
        if suffix == ".bin":
            write_bin(path, points(i))
        else:
            write_cloud(path, points(i), write_ascii=ascii_text)
    data = path.read_bytes()
    path.write_bytes(data[: max(0, int(share * len(data)) - 5)])
    scans = list(FolderSource(str(tmp_path)))
    assert [s.stamp for s in scans if len(s.points)] == [0, 100_000_000]
    if share or suffix != ".bin":
        assert "1 of 3 files left out as damaged" in caplog.text


def test_pcd_with_the_padding_fields_that_pcl_writes(tmp_path):
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "u1", 4), ("t", "<f8"), ("e", "u1")]
    records = np.zeros(30, kinds)
    records["x"], records["t"] = np.arange(30), TRUE
    (tmp_path / "0.pcd").write_bytes(
        b"VERSION 0.7\nFIELDS x y z _ t _\nSIZE 4 4 4 1 8 1\nTYPE F F F U F U\nCOUNT 1 1 1 4 1 1\n"
        b"WIDTH 30\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 30\nDATA binary\n" + records.tobytes()
    )
    (scan,) = list(FolderSource(str(tmp_path)))
    np.testing.assert_array_equal(scan.points[:, 0], np.arange(30))
    np.testing.assert_allclose(scan.offsets, TRUE)


def test_empty_pcd_is_an_empty_scan(tmp_path):
    (tmp_path / "0.pcd").write_text(
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 0\nHEIGHT 1\nDATA ascii\n"
    )
    assert [len(scan.points) for scan in FolderSource(str(tmp_path))] == [0]


def test_pcd_without_z(tmp_path):
    (tmp_path / "0.pcd").write_text(
        "VERSION 0.7\nFIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 1\nDATA ascii\n1 2\n"
    )
    with pytest.raises(SourceError, match=r"not one of its 1 .* has no z; its fields: x, y"):
        list(FolderSource(str(tmp_path)))


@pytest.mark.parametrize("order", ["<", ">", "="])
def test_ply_by_others(tmp_path, order):
    formats = {"<": "binary_little_endian", ">": "binary_big_endian", "=": "ascii"}
    header = (
        f"ply\nformat {formats[order]} 1.0\ncomment by another\nelement camera 1\n"
        "property float f\nelement vertex 4\nproperty double x\nproperty float y\n"
        "property float z\nproperty uint t\nelement face 1\nproperty list uchar int i\nend_header\n"
    )
    kinds = [("x", f"{order}f8"), ("y", f"{order}f4"), ("z", f"{order}f4"), ("t", f"{order}u4")]
    records = np.array([(i, 2, 3, i * 30_000_000) for i in range(4)], kinds)
    if order == "=":
        body = b"1.5\n" + "".join(f"{i} 2 3 {i * 30_000_000}\n" for i in range(4)).encode()
        body += b"3 0 1 2\n"
    else:
        body = np.array([1.5], f"{order}f4").tobytes() + records.tobytes() + b"\3" + bytes(12)
    (tmp_path / "0.ply").write_bytes(header.encode() + body)
    (scan,) = list(FolderSource(str(tmp_path)))
    np.testing.assert_array_equal(scan.points, [[i, 2, 3] for i in range(4)])
    np.testing.assert_allclose(scan.offsets, [0, 0.03, 0.06, 0.09])


def test_compressed_pcd_with_long_repeats(tmp_path):
    values = np.zeros((5000, 3), np.float32)
    values[2000:2100] = 1.5
    write_cloud(tmp_path / "0.pcd", values, compressed=True)
    np.testing.assert_array_equal(next(iter(FolderSource(str(tmp_path)))).points, values)


def test_compressed_pcd_cut(tmp_path):
    for i in range(2):
        write_cloud(tmp_path / f"{i}.pcd", points(i), compressed=True)
    path = tmp_path / "0.pcd"
    path.write_bytes(path.read_bytes()[:-20])
    assert [s.stamp for s in FolderSource(str(tmp_path))] == [100_000_000]


def test_noise_instead_of_files(tmp_path, caplog):
    for i in range(3):
        (tmp_path / f"{i}.pcd").write_bytes(np.random.default_rng(i).bytes(500))
    with pytest.raises(SourceError, match="not one of its 3 scan files can be read"):
        list(FolderSource(str(tmp_path)))
    assert caplog.text.count("scan left out") == 3


# BIN files of other layouts, and stamps in names


def street(index, count=3000):
    """(N, 3) points: ground and walls around a LiDAR that rings sweep in turn."""
    rng = np.random.default_rng(index)
    azimuth, elevation = np.linspace(-np.pi, np.pi, count), np.radians(np.arange(count) % 32 - 20)
    ranges = np.minimum(1.8 / np.maximum(np.sin(-elevation), 1e-3), rng.uniform(5, 60, count))
    level = ranges * np.cos(elevation)
    xyz = [level * np.cos(azimuth), level * np.sin(azimuth), ranges * np.sin(elevation)]
    return np.column_stack(xyz).astype(np.float32)


def columns_of(kind, count, rng):
    ring = np.arange(count) % 32
    values = {
        "i": rng.integers(0, 200, count),  # intensity
        "u": rng.uniform(0, 1, count),  # the same as a share
        "r": ring,
        "t": np.linspace(0, 0.1, count),
        "n": rng.normal(size=count),  # of a normal
        "0": np.zeros(count),
        "1": np.ones(count),
    }
    return values[kind]


def write_layout(path, points, kinds):
    rng = np.random.default_rng(0)
    more = [columns_of(kind, len(points), rng) for kind in kinds]
    np.column_stack([points, *more]).astype("<f4").tofile(path)


@pytest.mark.parametrize(
    "kinds", ["", "i", "u", "0", "ir", "ur", "0r", "irt", "nnn", "irt0", "innnu", "1i000", "irtui"]
)
@pytest.mark.parametrize("order", ["as swept", "shuffled"])
def test_the_columns_of_bin_files_are_found(tmp_path, kinds, order):
    # 2520 points divide by every number of columns up to ten
    expected = [street(i, 2520) for i in range(3)]
    for i, points in enumerate(expected):
        if order == "shuffled":
            np.random.default_rng(i).shuffle(points)
        write_layout(tmp_path / f"{i}.bin", points, kinds)
    for scan, points in zip(FolderSource(str(tmp_path)), expected, strict=True):
        np.testing.assert_array_equal(scan.points, points)


def test_other_than_four_columns_are_said_once(tmp_path, caplog):
    for i in range(3):
        write_layout(tmp_path / f"{i}.bin", street(i, 2520), "ir")
    list(FolderSource(str(tmp_path)))
    assert len([r for r in caplog.records if "float32 in 5 columns" in r.message]) == 1
    caplog.clear()
    list(FolderSource(str(tmp_path), columns=5))
    assert "float32" not in caplog.text


def test_sizes_tell_where_values_do_not(tmp_path):
    for i in range(5):
        np.ones((31 + 2 * i, 5), np.float32).tofile(tmp_path / f"{i}.bin")
    assert [len(scan.points) for scan in FolderSource(str(tmp_path))] == [31, 33, 35, 37, 39]


def test_columns_are_asked_for_where_nothing_tells(tmp_path):
    for i in range(3):
        np.ones((21, 10), np.float32).tofile(tmp_path / f"{i}.bin")  # or 3, 5, 6, 7 columns
    with pytest.raises(SourceError, match=r"may have 3, 5, 6, 7, 10 columns.*scenario\.columns"):
        FolderSource(str(tmp_path))
    with pytest.raises(SourceError, match="at least 3"):
        FolderSource(str(tmp_path), columns=2)


@pytest.mark.parametrize("kind", ["<f8", ">f4", "<i4"])
def test_bin_files_of_other_numbers_are_refused(tmp_path, kind):
    for i in range(3):
        values = np.column_stack([street(i, 2520), np.arange(2520) % 32])
        (values * (1000 if kind == "<i4" else 1)).astype(kind).tofile(tmp_path / f"{i}.bin")
    with pytest.raises(SourceError, match="no float32 coordinates"):
        FolderSource(str(tmp_path))


def test_a_damaged_file_among_those_of_five_columns(tmp_path, caplog):
    for i in range(4):
        write_layout(tmp_path / f"{i}.bin", street(i, 2520), "ir")
    path = tmp_path / "2.bin"
    path.write_bytes(path.read_bytes()[:-8])
    assert [scan.stamp for scan in FolderSource(str(tmp_path))] == [0, 100_000_000, 300_000_000]
    assert "whole points of 5 float32 columns" in caplog.text


FIRST = 1_533_202_202_399_496_123


@pytest.mark.parametrize(
    ("name", "step"),
    [
        (lambda ns: f"n015__LIDAR_TOP__{ns // 1000}.pcd", 1000),
        (lambda ns: f"{ns}.pcd", 1),
        (lambda ns: f"scan-{ns // 10**6}.pcd", 10**6),
        (lambda ns: f"{ns // 10**9}.{ns % 10**9:09d}.pcd", 1),
        (lambda ns: f"{ns // 10**9}_{ns % 10**9 // 1000:06d}.pcd", 1000),
    ],
)
def test_stamps_in_names(tmp_path, name, step):
    true = [FIRST + i * 99_999_999 for i in range(4)]
    for i, stamp in enumerate(true):
        write_cloud(tmp_path / name(stamp), points(i))
    source = FolderSource(str(tmp_path))
    assert [scan.stamp for scan in source] == [stamp // step * step for stamp in true]


@pytest.mark.parametrize(
    "names",
    [
        ["1533202202399496", "2"],
        ["a_1533202202399496", "b_1533202202299496"],  # in order of another number
        ["20180802093002", "20180802093003"],
        ["0000000001", "0000000002"],
    ],
)
def test_other_numbers_are_no_stamps(tmp_path, names, caplog):
    for i, name in enumerate(names):
        write_cloud(tmp_path / f"{name}.pcd", points(i))
    assert FolderSource(str(tmp_path)).stamps.tolist() == [0, 100_000_000]
    assert "nominal" in caplog.text


def test_tum_poses_of_any_number_beside_stamps_in_names(tmp_path):
    (tmp_path / "scans").mkdir()
    stamps = FIRST // 1000 * 1000 + np.arange(3) * 10**8
    for i, stamp in enumerate(stamps):
        write_cloud(tmp_path / "scans" / f"{stamp // 1000}.pcd", points(i))
    given = Trajectory(stamps[0] + np.arange(20) * 10**7, poses(20))
    write_tum(tmp_path / "poses.txt", given)
    source = FolderSource(str(tmp_path / "scans"), None, str(tmp_path / "poses.txt"))
    np.testing.assert_array_equal(source.stamps, stamps)
    np.testing.assert_array_equal(source.reference().stamps, given.stamps)
