"""The archive for evo_res, as evo itself reads it."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from eval_support import disturbed, make, winding
from evo.core.metrics import PoseRelation
from evo.core.trajectory import PosePath3D
from evo.main_ape import ape
from evo.tools.file_interface import load_res_file

from eval.association import pair_by_index
from eval.evo_archive import write_evo_archive
from eval.trajectory import compare_pairs, compare_trajectories


def evos(comparison, **how):
    """What evo_ape finds for the same pairs."""
    pair = (
        PosePath3D(t.positions_xyz, t.orientations_quat_wxyz, name=t.name)
        for t in (comparison.reference, comparison.pairs.estimate)
    )
    return ape(*pair, PoseRelation.translation_part, **how)


@pytest.mark.parametrize(
    ("method", "how"),
    [
        ("se3", {"align": True}),
        ("sim3", {"align": True, "correct_scale": True}),
        ("none", {}),
        ("first_pose", {"align_origin": True}),
    ],
)
def test_evo_reads_what_its_own_ape_would_have_written(tmp_path, method, how):
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference, method)
    write_evo_archive(tmp_path / "evo.zip", comparison)
    read, expected = load_res_file(tmp_path / "evo.zip"), evos(comparison, **how)
    assert read.stats == pytest.approx(expected.stats)
    assert read.info == expected.info
    errors, evos_errors = (r.np_arrays["error_array"] for r in (read, expected))
    np.testing.assert_allclose(errors, evos_errors, atol=1e-9)
    if method != "none":
        name = "alignment_transformation_sim3"
        np.testing.assert_allclose(read.np_arrays[name], expected.np_arrays[name], atol=1e-9)


def test_there_is_nothing_pickled_in_it(tmp_path):
    write_evo_archive(tmp_path / "evo.zip", compare_trajectories(winding(), winding()))
    with zipfile.ZipFile(tmp_path / "evo.zip") as archive:
        arrays = [name for name in archive.namelist() if name.endswith(".npy")]
        assert {Path(name).suffix for name in archive.namelist()} == {".json", ".npy"}
        for name in arrays:
            with archive.open(name) as file:
                np.lib.format.read_array(file, allow_pickle=False)


def test_poses_without_stamps_have_none_in_it(tmp_path):
    pairs = pair_by_index(make(np.eye(3)), make(np.eye(3)))
    write_evo_archive(tmp_path / "evo.zip", compare_pairs(pairs))
    arrays = load_res_file(tmp_path / "evo.zip").np_arrays
    assert "timestamps" not in arrays
    assert len(arrays["distances_from_start"]) == 3


def test_it_is_named_by_its_files(tmp_path):
    estimate, reference = winding(), winding()
    estimate.name, reference.name = "ours.tum", "truth.tum"
    write_evo_archive(tmp_path / "evo.zip", compare_trajectories(estimate, reference))
    info = load_res_file(tmp_path / "evo.zip").info
    assert (info["est_name"], info["ref_name"]) == ("ours.tum", "truth.tum")


def test_evo_res_prints_our_rmse(tmp_path):
    reference = winding()
    comparison = compare_trajectories(disturbed(reference), reference)
    write_evo_archive(tmp_path / "evo.zip", comparison)
    done = subprocess.run(
        [Path(sys.executable).with_name("evo_res"), "evo.zip", "--use_filenames"],
        cwd=tmp_path,
        env={**os.environ, "HOME": str(tmp_path)},  # evo writes its settings there
        capture_output=True,
        text=True,
        check=True,
    )
    rmse = np.sqrt((comparison.errors**2).mean())
    assert re.search(rf"evo\.zip\s+{rmse:.6f}\b", done.stdout)
