"""scripts/evaluate.py as a user meets it: a table and files, or one line that says what is wrong."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from eval_support import disturbed, winding
from test_eval_run import write_folder
from test_evaluation import write_ply, write_tum

import evaluate

ROOT = Path(__file__).parents[1]


@pytest.fixture
def cli(tmp_path, monkeypatch, capfd):
    """Run scripts/evaluate.py's main in a folder with files; return its status, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    reference = winding()
    write_tum(tmp_path / "a.tum", disturbed(reference, size=0.1))
    write_tum(tmp_path / "b.tum", reference)
    cloud = np.random.default_rng(0).uniform(0, 50, (2000, 3))
    write_ply(tmp_path / "a.ply", cloud)
    write_ply(tmp_path / "b.ply", cloud + np.array([0, 0, 0.01]))

    def call(*arguments):
        status = evaluate.main([*map(str, arguments)])
        return (status, *capfd.readouterr())

    return call


def row(out, title):
    """Return the cells of a row of the table."""
    (line,) = [line for line in out.splitlines() if line.startswith(title + " ")]
    return line.removeprefix(title).split()


def test_prints_headlines_with_units_and_what_is_better(cli, tmp_path):
    status, out, err = cli("estimate=a.tum", "reference=b.tum")
    assert (status, err) == (0, "")
    value, unit, better = row(out, "Position error")
    assert 0.1 < float(value) < 0.2
    assert (unit, better) == ("m", "less")
    assert row(out, "Coverage of the reference") == ["1", "more"]
    assert "map" not in out
    assert {path.name for path in tmp_path.iterdir()} == {"a.tum", "b.tum", "a.ply", "b.ply"}


def test_writes_what_is_asked_for(cli, tmp_path):
    status, out, _ = cli("estimate=a.tum", "reference=b.tum", "out=new/folder")
    assert status == 0
    folder = tmp_path / "new" / "folder"
    names = {path.name for path in folder.iterdir()}
    assert names == {"metrics.json", "report.html", "plots", "evo_ape.zip"}
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["trajectory"]["mae_m"] == pytest.approx(
        float(row(out, "Position error")[0]), rel=1e-3
    )
    assert metrics["map"]["reasons"]
    assert str(tmp_path) not in (folder / "metrics.json").read_text()


def test_maps_alone(cli):
    status, out, _ = cli("map=a.ply", "reference_map=b.ply")
    assert status == 0
    assert float(row(out, "Map distance")[0]) == pytest.approx(0.01, rel=0.01)
    assert "Position error" not in out


def test_settings_change_what_is_measured(cli, tmp_path):
    arguments = ("estimate=a.tum", "reference=b.tum", "out=out", "alignment=yaw")
    status, out, _ = cli(
        *arguments,
        "eval.metrics.relative_pose_error.metres=[5]",
        "eval.metrics.kitti_errors=null",
        "+eval.metrics.mine._target_=test_evaluation.Count",
    )
    assert status == 0
    assert row(out, "Count") == ["3"]
    assert "warning: doubtful" in out
    trajectory = json.loads((tmp_path / "out" / "metrics.json").read_text())["trajectory"]
    assert trajectory["alignment"]["method"] == "yaw"
    assert "5 m" in trajectory["rpe"]
    assert "kitti" not in trajectory
    assert trajectory["count"] == 3


def test_a_straight_line_is_warned_of(cli, tmp_path):
    line = winding(100)
    line.positions_xyz[:, 1:] = 0
    write_tum(tmp_path / "line.tum", line)
    status, out, _ = cli("estimate=line.tum", "reference=line.tum")
    assert status == 0
    assert "warning: the path is nearly a straight line" in out


def test_what_a_metric_refuses_has_a_reason(cli):
    _, out, _ = cli("estimate=a.tum", "+eval.metrics.mine._target_=test_evaluation.Refusing")
    assert "no count: not with these poses" in out
    assert "relation_error" not in out


def test_a_run_folder_is_evaluated_again(cli, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    write_folder(folder)
    (folder / "metrics.json").write_text('{"run": {"seed": 7, "wall_seconds": 2.0}}')
    status, out, _ = cli("run=run")
    assert status == 0
    assert row(out, "Speed") == ["60", "scans/s", "more"]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["run"] == {"seed": 7, "wall_seconds": 2.0}
    assert metrics["trajectory"]["mae_m"] == pytest.approx(0.05, abs=1e-3)
    status, *_ = cli("run=run", "out=elsewhere", "reference=b.tum")
    assert status == 2  # the other reference isn't of this run
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "nothing to judge: give estimate="),
        ("out=x", "nothing to judge"),
        ("estimat=a.tum", "Did you mean 'estimate'"),
        ("estimate=nowhere.tum", "no such .*nowhere.tum"),
        ("estimate=a.ply", "a.ply"),
        ("map=a.tum", "a.tum"),
        ("run=nowhere", "no such .*trajectory.tum"),
        ("estimate=a.tum reference=late.tum", "within the reference's time"),
        ("estimate=a.tum reference=short.tum", "only 2 of 400|too few|fewer|2 of 400"),
        ("estimate=nan.tum", "nan.tum.*NaN"),
        ("estimate=a.tum alignment=se4", "alignment.*'se3'"),
        ("estimate=a.tum max_gap=much", "max_gap.*number"),
        ("estimate=a.tum eval=mine", "no such eval.*default"),
        ("estimate=a.tum eval.metrics.speed._target_=no.Such", "no.Such can't be loaded"),
        ("estimate=a.tum out=a.tum/x", "a.tum"),
    ],
)
def test_bad_input_is_one_line(cli, tmp_path, arguments, message):
    late = winding()
    late.timestamps = late.timestamps + 1e6
    write_tum(tmp_path / "late.tum", late)
    write_tum(tmp_path / "short.tum", winding(2))
    (tmp_path / "nan.tum").write_text("0 nan 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    status, _, err = cli(*arguments.split())
    assert status == 2
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    assert re.search(message, err), err


def test_help_names_every_file_setting(cli):
    status, out, _ = cli("--help")
    assert status == 0
    for setting in ("estimate=", "reference_map=", "relations=", "grid=", "run=", "out=", "topic="):
        assert setting in out
    assert "Exit status" in out


def test_trajectories_take_neither_open3d_nor_matplotlib_nor_plotly(cli, tmp_path):
    program = (
        "import sys, evaluate\n"
        "status = evaluate.main(['estimate=a.tum', 'reference=b.tum'])\n"
        "slow = {'open3d', 'matplotlib', 'plotly', 'pandas', 'gtsam', 'laspy'} & {*sys.modules}\n"
        "sys.exit(f'{status}: {slow}' if slow or status else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env={"PYTHONPATH": f"{ROOT / 'scripts'}:{ROOT}"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
