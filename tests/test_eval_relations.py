"""Relation errors against closed forms and figures of real logs."""

import bz2
import os
from pathlib import Path

import numpy as np
import pytest
from eval_support import disturbed, make, values_of, winding
from scipy.spatial.transform import Rotation

from eval.errors import AssociationError, FileError
from eval.evidence import Evidence
from eval.metrics.relations import RelationError
from eval.relations import Relations, read_relations
from eval.relative import over_time
from eval.trajectory import compare_trajectories

DATA = (
    Path(os.environ.get("LIFELONG_SLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    / "lidar2d"
)
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"no recordings in {DATA}; LIFELONG_SLAM_DATA names their folder"
)


def relations_of(path, pairs):
    """The relations that hold on a path between pairs of its poses."""
    T = np.array([np.linalg.inv(path.poses_se3[i]) @ path.poses_se3[j] for i, j in pairs])
    return Relations(path.timestamps[np.array(pairs)], T)


def relation_error(estimate, relations, **settings):
    metric = RelationError(**settings)
    return values_of(metric, estimate=estimate, relations=relations)["relations"]


# errors


def test_a_true_path_keeps_all_relations_whatever_its_frame():
    path = winding()
    relations = relations_of(path, [(0, 5), (100, 20), (7, 399)])
    moved = disturbed(path, size=0)
    for found in (relation_error(path, relations), relation_error(moved, relations)):
        assert found["used"] == 3
        assert found["missed"] == 0
    assert relation_error(path, relations)["translation_m"]["max"] < 1e-9
    assert relation_error(path, relations)["rotation_deg"]["max"] < 1e-5


def test_errors_of_known_size():
    """Two relations of a straight path, off by 0.3 and 0.4 m and by 0 and 90 degrees."""
    path = make(np.arange(10)[:, None] * [1.0, 0.0, 0.0])
    true = np.tile(np.eye(4), (2, 1, 1))
    true[0, :3, 3] = [1.0, 0.3, 0.0]
    true[1, :3, 3] = [2.0, 0.0, 0.4]
    true[1, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    relations = Relations(np.array([[0.0, 0.1], [0.4, 0.6]]), true)
    found = relation_error(path, relations)
    assert found["translation_m"]["mean"] == pytest.approx(0.35)
    assert found["translation_m"]["max"] == pytest.approx(0.4)
    assert found["translation_squared_m2"] == pytest.approx((0.09 + 0.16) / 2)
    assert found["rotation_deg"]["mean"] == pytest.approx(45)
    assert found["rotation_squared_deg2"] == pytest.approx(90**2 / 2)


def test_consecutive_relations_give_the_relative_pose_error():
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    relations = relations_of(reference, [(i, i + 10) for i in range(0, 390, 10)])
    found = relation_error(comparison.pairs.estimate, relations)
    expected = over_time(comparison.estimate, comparison.reference, 1.0)
    assert found["used"] == len(expected.translation)
    assert found["translation_m"]["rmse"] == pytest.approx(
        np.sqrt((expected.translation**2).mean())
    )
    assert found["rotation_deg"]["mean"] == pytest.approx(expected.rotation.mean())


def test_poses_are_interpolated_at_the_relations_stamps():
    path = make(np.arange(10)[:, None] * [1.0, 0.0, 0.0])
    T = np.eye(4)[None].copy()
    T[0, 0, 3] = 2.5
    found = relation_error(path, Relations(np.array([[0.12, 0.37]]), T))
    assert found["translation_m"]["max"] == pytest.approx(0, abs=1e-9)


def test_relations_out_of_reach_are_missed_and_counted():
    stamps = np.concatenate([np.arange(0, 1.05, 0.1), np.arange(5, 6.05, 0.1)])
    path = make(np.column_stack([stamps, stamps, stamps]), stamps=stamps)
    pairs = np.array([[0.0, 0.5], [0.5, 3.0], [-1.0, 0.5], [5.0, 7.0]])
    relations = Relations(pairs, np.tile(np.eye(4), (4, 1, 1)))
    measured = RelationError().measure(Evidence(estimate=path, relations=relations))
    assert measured.values["relations"]["used"] == 1
    assert measured.values["relations"]["missed"] == 3
    assert "3 of 4 relations" in measured.warnings[0]
    assert relation_error(path, relations, max_gap=5.0)["used"] == 2


@pytest.mark.parametrize("count", [1, 5])
def test_no_relation_within_reach_is_an_error(count):
    relations = Relations(np.array([[100.0, 101.0]]), np.eye(4)[None])
    with pytest.raises(AssociationError, match="none of 1 relations"):
        relation_error(make(np.zeros((count, 3))), relations)


# files


def test_a_line_is_two_stamps_and_a_pose(tmp_path):
    path = tmp_path / "a.relations"
    path.write_bytes(b"\xef\xbb\xbf# from a survey\r\n\r\n1.5 2.5 1 2 3 0.1 0.2 0.3\r\n")
    relations = read_relations(path)
    np.testing.assert_array_equal(relations.stamps, [[1.5, 2.5]])
    np.testing.assert_array_equal(relations.T_first_second[0, :3, 3], [1, 2, 3])
    yaw, pitch, roll = (
        Rotation.from_euler(axis, angle) for axis, angle in zip("zyx", (0.3, 0.2, 0.1), strict=True)
    )
    np.testing.assert_allclose(
        relations.T_first_second[0, :3, :3], (yaw * pitch * roll).as_matrix(), atol=1e-12
    )


@pytest.mark.parametrize(
    "content", ["", "# nothing\n", "1 2 3 4 5 6 7\n", "1 2 3 4 5 6 7 x\n", "1 2 3 4 5 6 7 nan\n"]
)
def test_bad_relations_are_named(tmp_path, content):
    (tmp_path / "bad.relations").write_text(content)
    with pytest.raises(FileError, match=r"bad\.relations"):
        read_relations(tmp_path / "bad.relations")


def test_missing_relations_are_named(tmp_path):
    with pytest.raises(FileError, match="no such"):
        read_relations(tmp_path / "none.relations")


# real logs


def flat(rows):
    """A trajectory of (N, 4) rows of stamp, x, y and heading."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    positions = np.column_stack([rows[:, 1:3], np.zeros(len(rows))])
    return make(positions, Rotation.from_euler("z", rows[:, 3:]), rows[:, 0])


def odometry(path):
    """The odometry of a CARMEN log at its laser scans: ``... odom_x odom_y odom_theta stamp host t``."""
    with bz2.open(path, "rt") as file:
        scans = [line.split() for line in file if line.startswith("FLASER")]
    return flat(np.array([[scan[-3], *scan[-6:-3]] for scan in scans], dtype=float))


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    ("name", "error", "count"), [("intel", 0.042, 2984), ("fr079", 0.058, 1685)]
)
def test_corrected_logs_have_the_published_kind_of_error(name, error, count):
    estimate = flat(np.loadtxt(DATA / f"{name}_rbpf_corrected_dense.txt"))
    found = relation_error(estimate, read_relations(DATA / f"{name}.relations"))
    assert (found["used"], found["missed"]) == (count, 0)
    assert found["translation_m"]["mean"] == pytest.approx(error, abs=5e-4)


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(("name", "error"), [("intel", 7.37), ("fr079", 6.50)])
def test_odometry_has_the_known_error(name, error):
    found = relation_error(
        odometry(DATA / f"{name}.clf.bz2"), read_relations(DATA / f"{name}.relations")
    )
    assert found["translation_m"]["mean"] == pytest.approx(error, abs=5e-3)
    assert found["missed"] == 0
