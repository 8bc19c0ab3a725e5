"""Maps from PLY, PCD, LAS and LAZ files, and the files that are none."""

import logging
import os
import signal

import laspy
import numpy as np
import open3d as o3d
import pytest

from eval.errors import FileError
from eval.map_files import read_map

UTM = np.array([500_000.0, 5_400_000.0, 300.0])


def cloud(count=500, dtype=np.float32, seed=0):
    return (np.random.default_rng(seed).normal(size=(count, 3)) * [40, 20, 2]).astype(dtype)


def write_open3d(path, points, **options):
    assert o3d.t.io.write_point_cloud(str(path), o3d.t.geometry.PointCloud(points), **options)
    return path


def write_las(path, points):
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = points.min(axis=0), [0.001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(path)
    return path


def write(path, points, **options):
    las = path.suffix in (".las", ".laz")
    return write_las(path, points) if las else write_open3d(path, points, **options)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("options", [{}, {"compressed": True}, {"write_ascii": True}])
@pytest.mark.parametrize("name", ["map.ply", "map.pcd"])
def test_points_come_back_as_they_were_written(tmp_path, name, options, dtype):
    points = cloud(dtype=dtype)
    read = read_map(write_open3d(tmp_path / name, points, **options))
    if options.get("write_ascii"):
        np.testing.assert_allclose(read, points, rtol=1e-5, atol=1e-6)
    else:
        np.testing.assert_array_equal(read, points)
        assert read.dtype == dtype


def test_other_properties_and_faces_are_no_trouble(tmp_path):
    text = (
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty uchar red\n"
        "property double x\nproperty float y\nproperty float z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
        "9 1 2 3\n9 4 5 6\n9 7 8 9\n3 0 1 2\n"
    )
    (tmp_path / "mesh.ply").write_text(text)
    read = read_map(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(read, np.arange(1, 10).reshape(3, 3))
    assert read.dtype == np.float64


def test_a_big_endian_ply_is_read_in_its_precision(tmp_path):
    points = cloud(20)
    header = (
        "ply\nformat binary_big_endian 1.0\nelement vertex 20\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (tmp_path / "map.ply").write_bytes(header.encode() + points.astype(">f4").tobytes())
    read = read_map(tmp_path / "map.ply")
    np.testing.assert_array_equal(read, points)
    assert read.dtype == np.float32


@pytest.mark.parametrize("name", ["map.las", "map.LAZ"])
def test_las_keeps_the_millimetres_of_utm_coordinates(tmp_path, name):
    points = cloud(dtype=np.float64) + UTM
    read = read_map(write_las(tmp_path / name, points))
    assert read.dtype == np.float64
    np.testing.assert_allclose(read, points, rtol=0, atol=0.00051)


@pytest.mark.parametrize("name", ["map.ply", "map.pcd"])
@pytest.mark.parametrize("lost", ["in the file", "before"])
def test_single_precision_far_from_the_origin_is_said_with_its_step(tmp_path, caplog, name, lost):
    points = (cloud() + UTM).astype(np.float32)
    saved = points if lost == "in the file" else points.astype(np.float64)
    np.testing.assert_array_equal(read_map(write(tmp_path / name, saved)), points)
    assert "coordinates of single precision are 0.5 m apart at 5400" in caplog.text


@pytest.mark.parametrize("name", ["map.ply", "map.pcd", "map.las"])
def test_double_precision_far_from_the_origin_is_fine(tmp_path, caplog, name):
    read_map(write(tmp_path / name, cloud(dtype=np.float64) + UTM))
    assert caplog.text == ""


@pytest.mark.parametrize("shift", [0.0, 5_000.0, 50_000.0])
def test_single_precision_that_holds_centimetres_is_fine(tmp_path, caplog, shift):
    read_map(write(tmp_path / "map.ply", cloud() + np.float32(shift)))
    assert caplog.text == ""


@pytest.mark.parametrize(("scale", "said"), [(0.001, False), (0.01, False), (0.5, True)])
def test_a_coarse_scale_of_a_las_file_is_said(tmp_path, caplog, scale, said):
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = [0.001, 0.001, scale]
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud(dtype=np.float64).T
    las.write(tmp_path / "map.las")
    read_map(tmp_path / "map.las")
    assert ("coordinates are 0.5 m apart" in caplog.text) == said


@pytest.mark.parametrize("name", ["map.ply", "map.pcd"])
def test_points_with_nan_are_dropped_and_counted(tmp_path, caplog, name):
    points = cloud(100)
    points[7, 1] = np.nan
    points[50, 0] = np.inf if name == "map.pcd" else np.nan  # Open3D's writer of PLY knows no inf
    with caplog.at_level(logging.WARNING):
        read = read_map(write_open3d(tmp_path / name, points))
    np.testing.assert_array_equal(read, np.delete(points, [7, 50], axis=0))
    assert "2 of 100 points dropped" in caplog.text


def test_a_whole_file_is_read_without_a_word(tmp_path, caplog):
    with caplog.at_level(logging.DEBUG):
        read_map(write_open3d(tmp_path / "map.pcd", cloud()))
    assert not caplog.records


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "map.ply",
            "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\n"
            "property float y\nproperty float z\nend_header\n",
        ),
        (
            "map.pcd",
            "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 0\nHEIGHT 1\n"
            "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 0\nDATA binary\n",
        ),
    ],
)
def test_a_map_without_points_is_empty(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert read_map(tmp_path / name).shape == (0, 3)


@pytest.mark.parametrize("content", [b"", b"hello " * 100, b"\x00\xff" * 400])
@pytest.mark.parametrize("name", ["map.ply", "map.pcd", "map.las", "map.laz"])
def test_files_of_another_kind_are_refused(tmp_path, capfd, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=f"{name} is not a whole"):
        read_map(tmp_path / name)
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("map.ply", {}),
        ("map.ply", {"write_ascii": True}),
        ("map.pcd", {}),
        ("map.pcd", {"write_ascii": True}),
        ("map.pcd", {"compressed": True}),
        ("map.las", {}),
        ("map.laz", {}),
    ],
)
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_truncated_files_are_refused(tmp_path, name, options, share):
    path = write(tmp_path / name, cloud(dtype=np.float64), **options)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(FileError, match=name):
        read_map(path)


def test_a_las_file_cut_between_two_points_is_refused(tmp_path):
    path = write_las(tmp_path / "map.las", cloud(dtype=np.float64))
    with laspy.open(path) as file:
        size = file.header.point_format.size
    path.write_bytes(path.read_bytes()[: -3 * size])
    with pytest.raises(FileError, match="497 points of the 500"):
        read_map(path)


def test_columns_of_a_pcd_are_found_by_name(tmp_path):
    text = (
        "VERSION 0.7\nFIELDS normal z y x\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 3 1 1 1\nWIDTH 2\n"
        "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n0 0 1 3 2 1\n0 0 1 6 nan 4\n"
    )
    (tmp_path / "map.pcd").write_text(text)
    read = read_map(tmp_path / "map.pcd")
    np.testing.assert_array_equal(read, [[1, 2, 3]])
    assert read.dtype == np.float64


def test_a_ply_without_heights_is_refused(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n"
    (tmp_path / "map.ply").write_text(text)
    with pytest.raises(FileError, match=r"map\.ply is not a whole PLY file of points"):
        read_map(tmp_path / "map.ply")


def test_missing_and_unknown_files_are_named(tmp_path):
    with pytest.raises(FileError, match="no such map file"):
        read_map(tmp_path / "map.ply")
    (tmp_path / "map.obj").write_text("v 1 2 3\n")
    with pytest.raises(FileError, match=r"\.ply, \.pcd, \.las, \.laz"):
        read_map(tmp_path / "map.obj")


def test_a_forked_process_reads_laz_as_its_parent_did(tmp_path):
    path = write_las(tmp_path / "map.laz", cloud())
    read_map(path)
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)  # in place of pytest-timeout's handler
        signal.alarm(30)
        os._exit(0 if len(read_map(path)) == 500 else 1)
    assert os.wait4(child, 0)[1] == 0
