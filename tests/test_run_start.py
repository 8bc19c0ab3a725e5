"""A run folder is one run's: never a config of one and results of another, whoever is killed when."""

import json
import multiprocessing
import os
import random
import re
import signal
from itertools import count

import numpy as np
import pytest
from test_run_folder import some_record

from eval.comparison.runs import Missing, Run, find_runs, read_run
from eval.files import write_json
from lifelong_slam.errors import ConfigError
from lifelong_slam.files import atomic_path
from lifelong_slam.run_folder import link_reference_map, write_run
from lifelong_slam.run_start import claimed, set_results_aside, write_config

FILES = {"trajectory.tum", "trajectory.bag", "map.ply", "map.bag", "pose_graph.g2o"} | {
    "timeline.csv",
    "metrics.json",
}


def leave(folder, number):
    """Leave what a run would, each file in a version that tells the run."""
    set_results_aside(folder)
    write_config(folder, {"config.yaml": f"run_id: '{number}'\n", "hydra.yaml": "hydra: {}\n"})
    write_run(folder, some_record(count=number + 10, points=number), None, np.eye(4))
    write_json(folder / "metrics.json", {"run": {"id": str(number)}})


def runs_in(folder):
    """Return the numbers of the runs that a folder has anything of."""
    found = set()
    for path in folder.iterdir():
        if path.name == ".hydra" and (path / "config.yaml").exists():
            found.add(int(re.search(r"\d+", (path / "config.yaml").read_text())[0]))
        elif path.name.startswith("."):
            continue  # half-written
        elif path.name == "metrics.json":
            found.add(int(json.loads(path.read_text())["run"]["id"]))
        elif path.suffix in (".tum", ".csv"):
            rows = len(path.read_text().splitlines())
            found.add(rows - 10 - (path.suffix == ".csv"))
        elif path.suffix == ".ply":
            found.add(int(re.search(rb"vertex (\d+)", path.read_bytes())[1]))
    return found


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_a_folder_used_again_has_the_new_run_and_keeps_the_one_before(tmp_path, caplog):
    for number in (1, 2, 3):
        leave(tmp_path, number)
    assert names(tmp_path) == FILES | {".hydra", ".previous"}
    assert names(tmp_path / ".previous") == FILES | {".hydra"}
    assert runs_in(tmp_path) == {3}
    assert runs_in(tmp_path / ".previous") == {2}
    assert f"{tmp_path} had results of an earlier run: they are in .previous now" in caplog.text


def test_what_is_not_of_a_run_stays(tmp_path):
    leave(tmp_path, 1)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / ".map-of-me.ply").write_text("mine")
    set_results_aside(tmp_path)
    assert names(tmp_path) == {"notes.txt", ".map-of-me.ply", ".previous"}


def test_the_config_of_a_run_without_results_goes(tmp_path):
    write_config(tmp_path, {"config.yaml": "run_id: '1'\n"})
    set_results_aside(tmp_path)
    assert names(tmp_path) == set()


def test_there_is_nothing_to_say_of_a_new_folder(tmp_path, caplog):
    set_results_aside(tmp_path)
    assert (names(tmp_path), caplog.text) == (set(), "")


def write_half(path):
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("name", ["trajectory.tum", "map.ply", "metrics.json"])
def test_what_was_half_written_goes(tmp_path, name):
    child = multiprocessing.get_context("fork").Process(target=write_half, args=(tmp_path / name,))
    child.start()
    child.join()
    assert len(names(tmp_path)) == 1
    set_results_aside(tmp_path)
    assert names(tmp_path) == set()


def test_a_link_to_the_true_surface_leads_there_from_where_it_is_set_aside(tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "surface.ply").write_text("true")
    folder = tmp_path / "outputs" / "run"
    folder.mkdir(parents=True)
    link_reference_map(folder, tmp_path / "cache" / "surface.ply")
    set_results_aside(folder)
    assert names(folder) == {".previous"}
    assert (folder / ".previous" / "reference_map.ply").is_symlink()
    assert (folder / ".previous" / "reference_map.ply").read_text() == "true"


def test_what_was_being_set_aside_when_a_run_was_killed_is_kept(tmp_path):
    leave(tmp_path, 1)
    (tmp_path / ".previous-new").mkdir()
    (tmp_path / "map.ply").rename(tmp_path / ".previous-new" / "map.ply")
    leave(tmp_path, 2)
    assert names(tmp_path / ".previous") == FILES | {".hydra"}
    assert runs_in(tmp_path / ".previous") == {1}


def claim(folder, answer):
    try:
        with claimed(folder):
            answer.put(None)
    except ConfigError as error:
        answer.put(str(error))


def ask_another_process(folder):
    fork = multiprocessing.get_context("fork")
    answer = fork.SimpleQueue()
    child = fork.Process(target=claim, args=(folder, answer))
    child.start()
    child.join()
    return answer.get()


def test_only_one_run_at_a_time_is_at_work_in_a_folder(tmp_path):
    with claimed(tmp_path):
        assert f"another run is at work in {tmp_path}" in ask_another_process(tmp_path)
    assert ask_another_process(tmp_path) is None
    assert names(tmp_path) == set()


def run_until_killed(folder, numbers, report):
    for number in numbers:
        with claimed(folder):
            report.send(number)
            leave(folder, number)


@pytest.mark.parametrize("kills", [8, pytest.param(60, marks=pytest.mark.slow)])
def test_a_killed_run_leaves_no_mixture(tmp_path, kills):
    chance = random.Random(kills)
    fork = multiprocessing.get_context("fork")
    first, whole = 1, 0
    for _ in range(kills):
        ours, theirs = fork.Pipe(duplex=False)
        child = fork.Process(target=run_until_killed, args=(tmp_path, count(first), theirs))
        child.start()
        ours.recv()
        child.join(chance.uniform(0.0, 0.3))
        child.kill()
        child.join()
        while ours.poll():
            first = ours.recv()
        first += 1
        assert len(runs_in(tmp_path)) <= 1
        found = read_run(tmp_path)
        assert isinstance(found, Run) or "no metrics.json" in found.reason
        whole += isinstance(found, Run)
    leave(tmp_path, first)
    assert names(tmp_path) - {".previous"} == FILES | {".hydra"}
    assert isinstance(read_run(tmp_path), Run)


def test_a_comparison_takes_no_run_whose_config_is_another_ones(tmp_path):
    leave(tmp_path, 1)
    write_config(tmp_path, {"config.yaml": "run_id: '2'\n"})
    found = read_run(tmp_path)
    assert isinstance(found, Missing)
    assert found.reason == "config and metrics.json are of different runs"


def test_a_comparison_leaves_out_what_was_set_aside(tmp_path):
    for number in (1, 2):
        leave(tmp_path, number)
    runs = find_runs([tmp_path])
    assert [run.folder for run in runs.finished] == [tmp_path]
    assert runs.missing == ()
    (only,) = find_runs([tmp_path / ".previous"]).finished
    assert only.metrics["run"]["id"] == "1"
