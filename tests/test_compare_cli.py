"""scripts/compare.py as a user meets it: tables, a report, or one line that says what is wrong."""

import re

import numpy as np
import pytest
from comparison_support import aligned, errors, write_map, write_run, write_trajectories

import compare
import evaluate
from eval.trajectory_files import read_tum

PATH = [[0, 0, 0], [10, 0, 0], [10, 8, 1], [0, 9, 0.0]]


@pytest.fixture
def sweep(tmp_path):
    """Two sensors on scenario A, and a job that was killed."""
    for number, sensor in enumerate(("bosch", "velodyne")):
        choice = ["scenario=A", f"sensor={sensor}"]
        metrics = errors(0.1, None, aligned("se3"))
        folder = write_run(tmp_path / "sweep" / f"{number}_{sensor}", choice, metrics, number)
        write_map(folder, PATH)
        write_trajectories(folder, np.array(PATH))
    (tmp_path / "sweep" / "2_killed" / ".hydra").mkdir(parents=True)
    (tmp_path / "sweep" / "2_killed" / ".hydra" / "hydra.yaml").write_text("hydra: {}\n")
    return tmp_path / "sweep"


def test_writes_tables_and_report_and_prints_the_tables(sweep, capsys):
    assert compare.main([f"runs={sweep}"]) == 0
    out = capsys.readouterr().out
    folder = sweep / "comparison"
    assert {path.suffix for path in folder.iterdir()} == {".md", ".tex", ".csv", ".html"}
    assert out.startswith((folder / "comparison.md").read_text())
    assert f"Written to: {folder}" in out
    assert "Table 5.3" in out
    assert "2_killed: it has no metrics.json" in out


def test_the_report_has_tables_paths_and_what_is_missing(sweep, tmp_path):
    assert compare.main([f"runs=[{sweep}]", f"out={tmp_path / 'out'}"]) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    for words in ("Table 5.1", "Table 5.3", "Trajectories: scenario A", "Not in the tables"):
        assert words in page
    assert "2_killed" in page
    assert not re.search(r"""(src|href)=["']https?:""", page)


def test_comparing_again_does_not_take_in_its_own_results(sweep, capsys):
    assert compare.main([f"runs={sweep}"]) == 0
    first = capsys.readouterr().out
    assert compare.main([f"runs={sweep}"]) == 0
    assert capsys.readouterr().out == first


def test_a_run_without_reference_is_drawn_where_it_is(tmp_path):
    folder = write_run(tmp_path / "run", ["scenario=bag"], {}, graph={"vertices": 3})
    write_trajectories(folder, np.array(PATH))
    (folder / "reference.tum").unlink()
    assert len(read_tum(folder / "trajectory.tum").timestamps) == len(PATH)
    assert compare.main([f"runs={tmp_path}"]) == 0
    assert "Trajectories: scenario bag" in (tmp_path / "comparison" / "report.html").read_text()


def test_folders_of_evaluate_are_compared_by_their_names(sweep, capsys):
    for folder in sorted(sweep.glob("[01]_*")):
        estimate, reference = (folder / f"{name}.tum" for name in ("trajectory", "reference"))
        out = sweep / "judged" / folder.name.partition("_")[2]
        files = [
            f"{key}={path}" for key, path in (("estimate", estimate), ("reference", reference))
        ]
        assert evaluate.main([*files, f"out={out}"]) == 0
    capsys.readouterr()
    assert compare.main([f"runs={sweep / 'judged'}"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^\| bosch .*\n\| velodyne ", out.partition("All runs")[2], re.MULTILINE)
    assert "Position error [m]" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no runs are named: give runs=DIR"),
        (["runs="], "no runs are named"),
        (["run=x"], "Did you mean 'runs'"),
        (["runs=nowhere"], "no such folder of runs: nowhere"),
        (["runs=."], "no finished run below"),
        (["runs=[a"], "no such folder of runs: [a"),
        (["runs"], "'runs' is not key=value"),
        (["runs={a: 1}"], "runs: "),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert compare.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_help_says_what_there_is(capsys):
    assert compare.main(["--help"]) == 0
    out = capsys.readouterr().out
    for words in ("runs=DIR", "out=DIR", "report.html", "Exit status"):
        assert words in out
