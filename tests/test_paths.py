"""Names of files and folders on command lines are taken as a shell gives them, whatever is in them."""

import logging
import sys

import numpy as np
import pytest
from comparison_support import errors, write_map, write_run, write_trajectories
from eval_support import disturbed, winding
from g2o_support import laps
from map_support import new_map
from run_support import write_folder
from test_evaluation import write_ply, write_tum
from test_grid_metrics import write as write_grid

import compare
import evaluate
import map as map_script
import prune
import run
from lifelong_slam.io.g2o import write_g2o
from lifelong_slam.overrides import compose_checked, quote_paths

FOLDERS = (
    "Straße für Ünal",
    "with  spaces",
    "[brackets]",
    "a=b",
    "a, b",
    "~x",
    "all [of=it], ~('ä')",
)
NAMES = (
    *FOLDERS, "{braces}", "(1)", "a,b", "x~", "a:b", "a#b", "it's", 'say "a"', "100%", "a\\b", "$x", "1e3",
    "2011", "true", "choice(a,b)", "日本", "-m", "a&b;c", "[/bold]",
)  # fmt: skip


@pytest.fixture(params=FOLDERS)
def folder(request, tmp_path):
    path = tmp_path / request.param
    path.mkdir()
    return path


def test_evaluate(folder, tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    reference = winding(40)
    write_tum(folder / "a.tum", disturbed(reference, size=0.1))
    write_tum(folder / "b.tum", reference)
    assert evaluate.main([f"estimate={folder}/a.tum", f"reference={folder}/b.tum"]) == 0
    monkeypatch.chdir(folder.parent)
    assert evaluate.main([f"estimate={folder.name}/a.tum", f"reference={folder.name}/b.tum"]) == 0
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("folder", FOLDERS[-1:], indirect=True)
def test_evaluate_takes_all_its_files(folder, capfd):
    cloud = np.random.default_rng(0).uniform(0, 50, (200, 3))
    write_ply(folder / "a.ply", cloud)
    write_tum(folder / "a.tum", winding(40))
    (folder / "a.relations").write_text("0.1 1.1 1 0 0 0 0 0.1\n" * 3)
    grid = write_grid(folder, np.arange(9, dtype=np.uint8).reshape(3, 3))
    arguments = [f"{key}={folder}/a.ply" for key in ("map", "reference_map")]
    arguments += [f"{key}={folder}/a.tum" for key in ("estimate", "reference")]
    arguments += [f"{key}={grid}" for key in ("grid", "reference_grid")]
    arguments += [f"relations={folder}/a.relations", f"out={folder}/out"]
    assert evaluate.main(arguments) == 0, capfd.readouterr().err
    assert (folder / "out" / "metrics.json").is_file()


def test_prune(folder, capfd):
    write_g2o(folder / "in.g2o", laps(1)[0])
    files = {"graph": "in.g2o", "out": "out.g2o", "json": "a.json", "truth": "in.g2o"}
    arguments = [f"{key}={folder / name}" for key, name in files.items()]
    assert prune.main(["pruning=decimate", *arguments]) == 0, capfd.readouterr().err
    assert {path.name for path in folder.iterdir()} == {*files.values()}


def test_map(folder, capfd):
    new_map(folder / "place.map")
    assert map_script.main(["check", f"{folder}/place.map"]) == 0
    assert map_script.main(["info", f"{folder}/place.map"]) == 0
    assert map_script.main(["export", f"{folder}/place.map", "--out", f"{folder}/a.g2o"]) == 0
    assert capfd.readouterr().err == ""


def test_compare(folder, capfd):
    made = write_run(folder / "run", ["scenario=A"], errors(0.1))
    write_map(made, [[0, 0, 0], [1, 0, 0]])
    write_trajectories(made, np.array([[0, 0, 0], [10, 0, 0], [10, 8, 1], [0, 9, 0.0]]))
    assert compare.main([f"runs={folder}", f"out={folder / 'out'}"]) == 0
    assert (folder / "out" / "report.html").is_file()
    listed = f"runs=[{folder / 'run'}]"
    if "," not in folder.name:
        assert compare.main([listed, f"out={folder / 'listed'}"]) == 0, capfd.readouterr().err


@pytest.mark.parametrize("name", NAMES)
def test_settings_are_the_paths_as_they_were_given(name):
    conf = run.CONF
    keys = ("scenario.path", "scenario.times", "scenario.poses", "map")
    arguments = ["scenario=folder", *(f"{key}={name}" for key in keys)]
    config = compose_checked(conf, arguments)
    assert (config.scenario.path, config.scenario.times, config.map) == (name, name, name)
    assert config.scenario.poses == name


@pytest.mark.parametrize(
    "argument",
    [
        "map=null",
        "map=",
        "map='a, b'",
        'map="a, b"',
        "map=${hydra:runtime.output_dir}/x.map",
        "seed=1,2",
    ],
)
def test_what_means_something_to_hydra_still_does(argument):
    assert quote_paths([argument]) == [argument]


def test_commas_part_the_values_of_a_sweep_unless_they_are_in_a_file_s_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert quote_paths(["-m", "map=a,b"]) == ["-m", "map=a,b"]
    assert quote_paths(["map=a,b"]) == ["map='a,b'"]
    (tmp_path / "a,b").touch()
    assert quote_paths(["-m", "map=a,b"]) == ["-m", "map='a,b'"]


@pytest.mark.parametrize(
    "folder",
    [*(pytest.param(name, marks=pytest.mark.slow) for name in FOLDERS[:-1]), FOLDERS[-1]],
    indirect=True,
)
def test_run(folder, monkeypatch, capfd):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    scans = write_folder(folder / "scans", 4)
    (folder / "times, 1.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    arguments = ["system=kiss_icp", "sensor=solid_state", "scenario=folder"]
    arguments += [f"scenario.path={scans}", "scenario.times=times, 1.txt"]
    arguments += [f"hydra.run.dir={folder}/run, [1]"]
    monkeypatch.setattr(sys, "argv", ["run.py", *arguments])
    logger = logging.getLogger()
    level, handlers = logger.level, logger.handlers[:]
    status = run.main()
    logger.setLevel(level)
    logger.handlers[:] = handlers
    assert status == 0, capfd.readouterr().err
    assert (folder / "run, [1]" / "metrics.json").is_file()
    assert evaluate.main([f"run={folder}/run, [1]"]) == 0
