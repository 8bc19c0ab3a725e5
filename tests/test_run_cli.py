"""scripts/run.py as a user meets it: a run folder, or one line that says what is wrong."""

import json
import logging
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from run_support import room, write_folder

import run
from lifelong_slam.io.ply import write_ply
from lifelong_slam.mapping.map_check import check_map
from lifelong_slam.run_start import claimed
from lifelong_slam.trajectory import read_tum

ROOT = Path(__file__).parent.parent
SYSTEM = ["system=kiss_icp", "sensor=solid_state"]
FILES = {"trajectory.tum", "trajectory.bag", "map.ply", "map.bag", "pose_graph.g2o"} | {
    "metrics.json",
    "report.html",
    "timeline.csv",
    "plots",
    ".hydra",
    "run.log",
}


@pytest.fixture
def cli(tmp_path, monkeypatch, capfd):
    """Run scripts/run.py's main in an empty folder; return its status, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    logger = logging.getLogger()
    level, handlers = logger.level, logger.handlers[:]

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["run.py", *map(str, arguments)])
        try:
            status = run.main()
        except SystemExit as end:
            status = end.code
        out, err = capfd.readouterr()
        return status, out, err

    yield call
    logger.setLevel(level)
    logger.handlers[:] = handlers


def test_leaves_a_whole_run_folder(cli, tmp_path):
    scans = write_folder(tmp_path / "scans", 12)
    status, out, _ = cli(*SYSTEM, "scenario=folder", f"scenario.path={scans}", "seed=5")
    assert status == 0
    folder = Path(out.splitlines()[-1].removeprefix("Run folder: "))
    assert folder.parent == tmp_path / "outputs"
    assert folder.name.endswith("_folder_solid_state_kiss_icp")
    assert {path.name for path in folder.iterdir()} == FILES
    assert len(read_tum(folder / "trajectory.tum")) == 12
    info = json.loads((folder / "metrics.json").read_text())["run"]
    assert info["seed"] == 5
    assert info["command_line"][-1] == "seed=5"
    assert info["choices"]["system"] == "kiss_icp"
    assert info["input"]["used"] == 12
    assert not info["interrupted"]
    assert str(tmp_path) not in json.dumps(info)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["scenaro=E"], "no setting 'scenaro'. Did you mean 'scenario'"),
        (["scenario=Z"], "Choices: A, B"),
        (["sensor=bosh"], "Did you mean 'bosch'"),
        (["-m", "scenaro=A,B"], "Did you mean 'scenario'"),
        (["scenario=loop", "scenario.lapps=2"], "Did you mean 'laps'"),
        (["scenario=loop", "scenario.laps=many"], "laps: .*integer"),
        (["seed=x"], "seed: .*integer"),
        (["scenario=bag"], "scenario.path has no value"),
        (["scenario=bag", "scenario.path=nowhere.bag"], "no such file.*nowhere.bag"),
        (["scenario=folder", "scenario.path=empty"], "empty holds no scans"),
        (["~scenario"], "nothing is chosen for scenario"),
        (["sensor.min_range=90", "scenario=folder", "scenario.path=empty"], "min_range"),
        (["--config-dir=nowhere"], "no such folder of configs: nowhere"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(cli, tmp_path, arguments, message):
    (tmp_path / "empty").mkdir()
    flags = [a for a in arguments if a.startswith("-")]
    status, out, err = cli(*flags, *SYSTEM, *[a for a in arguments if a not in flags])
    assert status == 2
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    assert re.search(message, err)
    assert {path.name for path in tmp_path.iterdir()} == {"empty"}


def test_scans_without_points_leave_nothing(cli, tmp_path):
    scans = tmp_path / "scans"
    scans.mkdir()
    for i in range(3):
        np.full((5, 4), np.nan, np.float32).tofile(scans / f"{i}.bin")
    status, _, err = cli(*SYSTEM, "scenario=folder", f"scenario.path={scans}")
    assert status == 2
    assert "error: no usable scans" in err.splitlines()[-1]
    assert {path.name for path in tmp_path.iterdir()} == {"scans"}


def test_a_run_folder_that_cannot_be_made(cli, tmp_path):
    (tmp_path / "file").write_text("")
    status, _, err = cli(*SYSTEM, "hydra.run.dir=file/run", "scenario=folder", "scenario.path=x")
    assert status == 2
    assert err.count("\n") == 1
    assert "can't make the run folder" in err
    assert "hydra.run.dir" in err


def test_a_failed_run_leaves_what_was_in_its_folder(cli, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    status, _, _ = cli(*SYSTEM, "hydra.run.dir=mine", "scenario=folder", "scenario.path=x")
    assert status == 2
    assert (tmp_path / "mine" / "notes.txt").read_text() == "keep"


def test_a_sweep_goes_on_after_a_job_that_failed(cli, tmp_path):
    scans = write_folder(tmp_path / "scans", 2)
    paths = f"scenario.path={tmp_path}/nowhere,{scans}"
    status, out, err = cli("-m", *SYSTEM, "scenario=folder", paths)
    assert status == 2
    assert "error: no such folder" in err
    folder = Path(out.splitlines()[-1].removeprefix("Run folder: "))
    assert (folder / "metrics.json").is_file()
    sweep = folder.parent
    assert [path.name for path in sweep.iterdir() if path.is_dir()] == [folder.name]
    assert folder.name.startswith("1_")


def spoil(folder, scans):
    """Leave five points of each of some scans."""
    for i in scans:
        path = folder / f"{i:06d}.bin"
        np.fromfile(path, np.float32).reshape(-1, 4)[::1200].tofile(path)


def test_a_lost_run_is_written_and_says_why(cli, tmp_path):
    scans = write_folder(tmp_path / "scans", 10)
    spoil(scans, range(2, 10))
    status, out, err = cli("sensor=solid_state", "scenario=folder", f"scenario.path={scans}")
    assert status == 3
    folder = Path(out.splitlines()[-1].removeprefix("Run folder: "))
    assert {path.name for path in folder.iterdir()} == FILES
    verdict = json.loads((folder / "metrics.json").read_text())["run"]["verdict"]
    assert verdict["status"] == "lost"
    assert "8 of 10 scans could not be registered" in verdict["reasons"][0]
    assert verdict["reasons"][0] in err
    assert verdict["reasons"][0] in (folder / "report.html").read_text()


def test_a_sweep_goes_on_after_a_run_that_was_lost(cli, tmp_path):
    folders = [write_folder(tmp_path / name, 8) for name in ("lost", "good")]
    spoil(folders[0], range(2, 8))
    paths = f"scenario.path={folders[0]},{folders[1]}"
    status, _, _ = cli("-m", "sensor=solid_state", "scenario=folder", paths, "hydra.sweep.dir=all")
    assert status == 3
    verdicts = [
        json.loads(path.read_text())["run"]["verdict"]["status"]
        for path in sorted((tmp_path / "all").glob("*/metrics.json"))
    ]
    assert verdicts == ["lost", "good"]


def test_help_lists_groups_and_examples(cli):
    status, out, _ = cli("--help")
    assert status == 0
    for words in ("scenario: A, B, C", "sensor: bosch", "python scripts/run.py", "Exit status"):
        assert words in out


def test_a_source_that_knows_the_place_has_its_map_judged(cli, tmp_path):
    (tmp_path / "conf" / "scenario").mkdir(parents=True)
    text = "_target_: run_support.SurveyedSource\ncount: 20\nsurface: room.ply\n"
    (tmp_path / "conf" / "scenario" / "room.yaml").write_text(text)
    write_ply(tmp_path / "room.ply", room().astype(np.float32))
    status, out, _ = cli("--config-dir", "conf", *SYSTEM, "scenario=room", "hydra.run.dir=run")
    assert status == 0
    assert "mean distance from the true surface" in out
    metrics = json.loads(Path("run/metrics.json").read_text())
    assert metrics["trajectory"]["max_m"] < 0.2
    assert 0 < metrics["map"]["mean_distance_m"]["map_to_reference"] < 0.3
    assert metrics["resources"]["mean_rss_mb"] > 10
    assert str(tmp_path) not in json.dumps(metrics)


def test_a_metric_that_cannot_be_made_ends_the_run_before_it_begins(cli, tmp_path):
    scans = write_folder(tmp_path / "scans", 2)
    wrong = "eval.metrics.speed._target_=nowhere.Speed"
    status, out, err = cli(*SYSTEM, "scenario=folder", f"scenario.path={scans}", wrong)
    assert (status, out) == (2, "")
    assert "nowhere.Speed can't be loaded" in err
    assert {path.name for path in tmp_path.iterdir()} == {"scans"}


def ids(folder):
    """Return the ids of the runs that config and figures are of."""
    config = yaml.safe_load((folder / ".hydra" / "config.yaml").read_text())
    return config["run_id"], json.loads((folder / "metrics.json").read_text())["run"]["id"]


def test_a_run_folder_used_twice_has_the_second_run_and_keeps_the_first(cli, tmp_path):
    scans = write_folder(tmp_path / "scans", 4)
    command = [*SYSTEM, "scenario=folder", f"scenario.path={scans}", "hydra.run.dir=run"]
    folder, before = Path("run"), Path("run/.previous")
    assert cli(*command, "seed=1")[0] == 0
    (first, same) = ids(folder)
    assert first == same
    (folder / ".map-abcd1234.ply").write_text("half")
    status, _, err = cli(*command, "seed=2")
    assert status == 0
    assert "run had results of an earlier run: they are in .previous now" in err
    assert {path.name for path in folder.iterdir()} == FILES | {".previous"}
    assert {path.name for path in before.iterdir()} == FILES - {"run.log"}
    assert ids(before) == (first, first)
    assert len({*ids(folder), first}) == 2
    overrides = [
        yaml.safe_load((f / ".hydra/overrides.yaml").read_text()) for f in (folder, before)
    ]
    assert [lines[-1] for lines in overrides] == ["seed=2", "seed=1"]


@pytest.mark.parametrize("wrong", ["scenario.path=nowhere", "sensor.min_range=90"])
def test_a_run_that_cannot_begin_leaves_the_results_of_an_earlier_one(cli, tmp_path, wrong):
    scans = write_folder(tmp_path / "scans", 3)
    command = [*SYSTEM, "scenario=folder", f"scenario.path={scans}", "hydra.run.dir=run"]
    assert cli(*command)[0] == 0
    before = {p: p.read_bytes() for p in Path("run").rglob("*") if p.is_file()}
    assert cli(*command, wrong)[0] == 2
    assert {p: p.read_bytes() for p in Path("run").rglob("*") if p.is_file()} == before


def test_a_folder_in_which_another_run_is_at_work_is_left_alone(cli, tmp_path):
    scans = write_folder(tmp_path / "scans", 3)
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    (tmp_path / "run" / ".hydra" / "config.yaml").write_text("run_id: other\n")
    with claimed(tmp_path / "run"):
        status, _, err = cli(
            *SYSTEM, "scenario=folder", f"scenario.path={scans}", "hydra.run.dir=run"
        )
    assert status == 2
    assert err.count("\n") == 1
    assert re.search(r"another run is at work in .*/run: choose a folder by hydra\.run\.dir", err)
    assert (tmp_path / "run" / ".hydra" / "config.yaml").read_text() == "run_id: other\n"
    assert {path.name for path in (tmp_path / "run").iterdir()} <= {".hydra", "run.log"}


@pytest.fixture
def room_for():
    """Have the system refuse files of more than some bytes, as a disk that is nearly full does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_what_does_not_fit_on_the_disk_is_named_and_the_rest_is_written(cli, tmp_path, room_for):
    scans = write_folder(tmp_path / "scans", 12)
    room_for(100_000)
    status, out, err = cli(
        "sensor=solid_state", "scenario=folder", f"scenario.path={scans}", "hydra.run.dir=run",
        "map=place.map",
    )  # fmt: skip
    room_for(resource.RLIM_INFINITY)
    assert status == 1
    message = err.splitlines()[-1]
    assert message.startswith("error: not all could be written: map.ply, ")
    assert re.search(
        rf"report\.html, map\.bag in {tmp_path}/run: File too large; {tmp_path}/place\.map", message
    )
    assert "place.map can't be used: " in err
    assert "the run goes on without it" in err
    assert "Traceback" not in err
    assert {"trajectory.tum", "metrics.json", "timeline.csv", "pose_graph.g2o"} <= {
        path.name for path in (tmp_path / "run").iterdir()
    }
    assert not [path for path in (tmp_path / "run").iterdir() if path.name.startswith(".map")]
    metrics = json.loads(Path("run/metrics.json").read_text())
    assert metrics["trajectory"]["path_length_m"] > 0
    assert metrics["map"]["points"] is None
    assert check_map(tmp_path / "place.map") == []
    assert f"Run folder: {tmp_path}/run" in out


SIGNALLING = """
_target_: run_support.SignallingSource
count: 8
at: []
"""


@pytest.mark.parametrize(("at", "mapped"), [([3], (3, 4)), ([0], None)])
def test_ctrl_c(tmp_path, at, mapped):
    """Once scans flow, Ctrl-C writes what is mapped so far; before, it leaves nothing."""
    (tmp_path / "conf" / "scenario").mkdir(parents=True)
    (tmp_path / "conf" / "scenario" / "signalling.yaml").write_text(SIGNALLING)
    command = [sys.executable, str(ROOT / "scripts" / "run.py"), "--config-dir", "conf", *SYSTEM]
    done = subprocess.run(
        [*command, "scenario=signalling", f"scenario.at={at}"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT / "tests")},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 130
    if mapped is None:
        assert done.stderr.splitlines()[-1] == "Aborted."
        assert {path.name for path in tmp_path.iterdir()} == {"conf"}
        return
    assert "Stopped early" in done.stderr
    (folder,) = (tmp_path / "outputs").iterdir()
    assert {path.name for path in folder.iterdir()} == FILES
    assert len(read_tum(folder / "trajectory.tum")) in mapped
    assert json.loads((folder / "metrics.json").read_text())["run"]["interrupted"]
