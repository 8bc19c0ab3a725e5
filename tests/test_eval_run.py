"""The evaluation of a whole run folder."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib import get_cachedir
from matplotlib.image import imread
from settings_support import default_settings

from eval.errors import FileError
from eval.files import read_graph, read_timeline, write_json
from eval.map_files import read_map
from eval.map_image import rasterise
from eval.run import evaluate_run

EVALUATE = str(Path(__file__).parents[1] / "scripts" / "evaluate.py")
PICTURES = {"trajectory.png", "map.png"}
SETTINGS = default_settings()
GRAPH = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 10 0 0 0 0 0 1
VERTEX_SE3:QUAT 5 20 0 0 0 0 0 1
# odometry
EDGE_SE3:QUAT 0 1 10 0 0 0 0 0 1
EDGE_SE3:QUAT 1 5 10 0 0 0 0 0 1
# loop
EDGE_SE3:QUAT 5 0 -20 0 0 0 0 0 1
"""


def write_folder(folder, count=120):
    """A run folder by hand: an estimate that floats 10 cm above its reference every other pose."""
    rng = np.random.default_rng(0)
    stamps = 1_700_000_000 + np.arange(count) * 0.1
    x, y = np.arange(count) * 1.0, 20 * np.sin(np.arange(count) / 20)
    for name, lift in (("reference", 0.0), ("trajectory", 0.1)):
        rows = [
            f"{t:.9f} {a} {b} {lift * (i % 2)} 0 0 0 1"
            for i, (t, a, b) in enumerate(zip(stamps, x, y, strict=True))
        ]
        (folder / f"{name}.tum").write_text("\n".join(rows) + "\n")
    (folder / "pose_graph.g2o").write_text(GRAPH)
    write_map(folder, rng.normal(size=(5000, 3)) * [40, 20, 2])
    header = "stamp,odometry_ms,loop_ms,optimise_ms,prune_ms,vertices,edges,rss_mb"
    rows = [f"{t:.9f},20,4,1,0,{i // 10},{i // 10},{300 + i}" for i, t in enumerate(stamps)]
    (folder / "timeline.csv").write_text("\n".join([header, *rows]) + "\n")
    return folder


def write_map(folder, points, name="map.ply"):
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (folder / name).write_bytes(header.encode() + points.astype("<f4").tobytes())


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    folder = write_folder(tmp_path_factory.mktemp("run"))
    return folder, evaluate_run(
        folder, SETTINGS, {"wall_seconds": 4.0, "peak_rss_mb": 999.0, "seed": 3}
    )


def test_metrics_have_every_section(judged):
    folder, metrics = judged
    assert list(metrics) == ["trajectory", "map", "resources", "graph", "run"]
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    assert metrics["trajectory"]["mae_m"] == pytest.approx(0.05, abs=1e-3)
    assert metrics["trajectory"]["coverage"] == pytest.approx(1)
    assert metrics["trajectory"]["poses"]["matched"] == 120
    assert not {"position_error", "path_length"} & metrics["trajectory"]["reasons"].keys()
    assert metrics["map"]["points"] == 5000
    counts = {"vertices": 3, "edges": 3, "odometry_edges": 2, "loop_edges": 1}
    counts["composed_edges"] = 0
    size = {"title": "Pose graph", "value": 3.0, "unit": "vertices", "less_is_better": None}
    headlines = {"graph_size": size}
    assert metrics["graph"] == {**counts, "reasons": {}, "warnings": [], "headlines": headlines}
    assert metrics["run"]["seed"] == 3


def test_resources_sum_up_the_timeline(judged):
    resources = judged[1]["resources"]
    assert resources["scans"] == 120
    assert resources["scans_per_s"] == pytest.approx(30)
    assert resources["processing_s"] == pytest.approx(3.0)
    assert resources["peak_rss_mb"] == 999.0
    assert resources["stages_ms"]["odometry"]["mean"] == pytest.approx(20)
    assert resources["stages_ms"]["total"]["p95"] == pytest.approx(25)


def test_every_plot_is_a_picture(judged):
    folder, _ = judged
    plots = sorted((folder / "plots").iterdir())
    assert {path.name for path in plots} > PICTURES | {"graph_size.png", "stage_times.png"}
    assert any(path.name.startswith("position_error") for path in plots)
    for path in plots:
        image = imread(path)
        assert image.shape[1] > 800
        assert np.ptp(image[..., :3]) > 0.5


def test_nothing_temporary_is_left(judged):
    assert not [path for path in judged[0].rglob("*") if path.name.startswith(".")]


def test_without_reference_the_rest_is_still_there(tmp_path):
    folder = write_folder(tmp_path)
    (folder / "reference.tum").unlink()
    metrics = evaluate_run(folder, SETTINGS, {})
    assert metrics["trajectory"]["mae_m"] is None
    assert metrics["trajectory"]["headlines"]["position_error"]["value"] is None
    assert metrics["trajectory"]["reasons"]["position_error"] == "there is no reference trajectory"
    assert metrics["trajectory"]["path_length_m"] > 119
    assert metrics["resources"]["scans_per_s"] == pytest.approx(40)
    assert metrics["resources"]["peak_rss_mb"] == 419
    plots = {path.name for path in (folder / "plots").iterdir()}
    assert plots > PICTURES
    assert not {name for name in plots if name.startswith("position_error")}


def test_a_reference_of_another_day_is_a_reason(tmp_path):
    folder = write_folder(tmp_path)
    text = (folder / "reference.tum").read_text()
    (folder / "reference.tum").write_text(text.replace("17000000", "16000000"))
    metrics = evaluate_run(folder, SETTINGS, {})
    assert metrics["trajectory"]["rmse_m"] is None
    assert "lie within the reference's time" in metrics["trajectory"]["reasons"]["position_error"]


def test_a_surface_in_the_run_folder_judges_the_map(tmp_path):
    folder = write_folder(tmp_path)
    write_map(folder, np.random.default_rng(2).normal(size=(4000, 3)), "reference_map.ply")
    metrics = evaluate_run(folder, SETTINGS, {})
    judged = {key for key, value in metrics["map"].items() if value is not None}
    (folder / "reference_map.ply").unlink()
    without = evaluate_run(folder, SETTINGS, {})
    assert judged > {key for key, value in without["map"].items() if value is not None}
    assert str(tmp_path) not in json.dumps(metrics)


def test_a_surface_that_is_gone_is_said(tmp_path, caplog):
    folder = write_folder(tmp_path)
    (folder / "reference_map.ply").symlink_to("gone.ply")
    metrics = evaluate_run(folder, SETTINGS, {})
    assert "reference_map.ply leads to a file that isn't there" in caplog.text
    assert metrics["map"]["points"] == 5000


def test_judging_again_keeps_what_is_known_of_the_run(tmp_path):
    folder = write_folder(tmp_path)
    evaluate_run(folder, SETTINGS, {"seed": 7, "wall_seconds": 2.0})
    again = evaluate_run(folder, SETTINGS)
    assert again["run"] == {"seed": 7, "wall_seconds": 2.0}
    assert again["resources"]["scans_per_s"] == pytest.approx(60)


def test_an_empty_map_and_graph_and_one_scan(tmp_path):
    folder = write_folder(tmp_path, count=1)
    write_map(folder, np.zeros((0, 3)))
    (folder / "pose_graph.g2o").write_text("")
    metrics = evaluate_run(folder, SETTINGS, {})
    assert metrics["map"]["points"] == 0
    assert metrics["graph"]["vertices"] == 0
    assert metrics["trajectory"]["mae_m"] is None


def test_a_timeline_without_rows(tmp_path):
    folder = write_folder(tmp_path)
    header = (folder / "timeline.csv").read_text().splitlines()[0]
    (folder / "timeline.csv").write_text(header + "\n")
    resources = evaluate_run(folder, SETTINGS, {})["resources"]
    assert (resources["scans"], resources["scans_per_s"]) == (0, None)
    assert resources["stages_ms"]["odometry"] is None


@pytest.mark.parametrize("name", ["trajectory.tum", "map.ply", "pose_graph.g2o", "timeline.csv"])
def test_missing_and_broken_files_are_named(tmp_path, name):
    folder = write_folder(tmp_path)
    (folder / name).write_text("VERTEX_SE3:QUAT nonsense\n1,2\nx\n")
    with pytest.raises(FileError, match=name):
        evaluate_run(folder, SETTINGS)
    (folder / name).unlink()
    with pytest.raises(FileError, match=name):
        evaluate_run(folder, SETTINGS)
    assert not (folder / "metrics.json").exists()


def test_kinds_of_edges_are_inferred_where_the_file_does_not_say(tmp_path):
    lines = [line for line in GRAPH.splitlines() if not line.startswith("#")]
    (tmp_path / "a.g2o").write_text("\n".join(lines))
    assert read_graph(tmp_path / "a.g2o").is_loop.tolist() == [False, False, True]


def test_a_planar_graph_with_kinds_fixed_vertices_and_priors_is_read(tmp_path):
    unit = "1 0 0 1 0 1"
    (tmp_path / "a.g2o").write_text(
        "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 3 1 2 0\nVERTEX_SE2 8 4 5 0\nFIX 0\n"
        f"EDGE_SE2 3 0 1 0 0 {unit}\nEDGE_SE2 3 8 1 0 0 {unit} # composed\n"
        f"EDGE_SE2 0 8 1 0 0 {unit} # loop\nEDGE_PRIOR_SE2 8 4 5 0 {unit}\n"
    )
    graph = read_graph(tmp_path / "a.g2o")
    np.testing.assert_array_equal(graph.positions, [[0, 0, 0], [1, 2, 0], [4, 5, 0]])
    assert graph.edges.tolist() == [[1, 0], [1, 2], [0, 2]]
    assert graph.is_loop.tolist() == [False, False, True]
    assert graph.is_composed.tolist() == [False, True, False]


def test_edges_between_unknown_vertices_are_refused(tmp_path):
    (tmp_path / "a.g2o").write_text("EDGE_SE3:QUAT 0 1 10 0 0 0 0 0 1\n")
    with pytest.raises(FileError, match="2 vertices that are not there"):
        read_graph(tmp_path / "a.g2o")


def test_json_is_strict_and_typed(tmp_path):
    value = {"nan": float("nan"), "inf": np.float64("inf"), "array": np.arange(3), "path": tmp_path}
    write_json(tmp_path / "a.json", {**value, "yes": np.True_, "n": np.int32(4), "none": None})
    text = (tmp_path / "a.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == {
        "nan": None,
        "inf": None,
        "array": [0, 1, 2],
        "path": str(tmp_path),
        "yes": True,
        "n": 4,
        "none": None,
    }


def test_points_and_timeline_are_read_as_they_were_written(tmp_path):
    folder = write_folder(tmp_path)
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    write_map(folder, points)
    np.testing.assert_array_equal(read_map(folder / "map.ply"), points)
    assert read_timeline(folder / "timeline.csv")["rss_mb"][-1] == 419


def test_raster_counts_points_and_averages_heights():
    x, y = np.meshgrid(np.arange(10) + 0.5, np.arange(5) + 0.5)
    points = np.column_stack([x.ravel(), y.ravel(), x.ravel()]).astype(np.float32)
    image = rasterise(np.repeat(points, 3, axis=0), pixels=10, finest=1.0)
    assert image.cell == 1.0
    assert image.count.max() == 3
    assert np.nanmax(np.abs(image.height - np.nanmean(image.height, axis=0))) < 1e-6


def test_evaluation_neither_needs_nor_touches_the_home_folder(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    folder = tmp_path / "run"
    folder.mkdir()
    write_folder(folder)
    command = [sys.executable, EVALUATE, f"run={folder}"]
    settings = {**os.environ, "HOME": str(home), "MPLCONFIGDIR": get_cachedir()}
    subprocess.run(command, env=settings, check=True, capture_output=True)
    assert not (home / ".evo").exists()
    assert (folder / "metrics.json").is_file()
    shutil.rmtree(home)
    subprocess.run(command, env=settings, check=True, capture_output=True)


def test_eval_knows_nothing_of_the_slam_system():
    program = (
        "import sys, eval.run, eval.plots, eval.testing, eval.report.run_report\n"
        "print('lifelong_slam' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"
