"""Comparisons of run folders whose figures and maps are known."""

import csv
import json
import os
import re
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from comparison_support import (
    aligned,
    errors,
    headlined,
    write_map,
    write_run,
    write_trajectories,
)
from evo.core.trajectory import PosePath3D
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation

from eval.comparison import published
from eval.comparison.maps import compare_maps, run_map_alignment
from eval.comparison.runs import Missing, Run, find_runs, read_run
from eval.comparison.table import Cell, Column, Table
from eval.comparison.tables import make_tables
from eval.comparison.writing import latex, markdown, write_tables
from eval.errors import EvalError, FileError
from eval.evaluation import Verdict, to_sections
from eval.map_alignment import align_by_poses
from eval.metrics.metric import Measurement, Section

DATA = Path(os.environ.get("LIFELONG_SLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
PAPER = DATA / "tables" / "paper_000_tables.json"
TURN = Rotation.from_euler("xyz", [0.3, -0.2, 1.0])


def tables_of(*roots):
    return {table.name: table for table in make_tables(find_runs(roots).finished)}


def column(table, *words):
    """Return a column of a table's text, found by words of its heading."""
    frame = table.text(flat=True)
    (name,) = [c for c in frame.columns if all(word in c.split() for word in words)]
    return frame[name].tolist()


@pytest.fixture
def campaign(tmp_path):
    """Runs of scenarios A and B, B with one sensor only."""
    for i, (scenario, sensor, mae) in enumerate(
        [("A", "bosch", 0.1), ("A", "velodyne", 0.2), ("B", "velodyne", 0.3)]
    ):
        choice = [f"scenario={scenario}", f"sensor={sensor}"]
        folder = write_run(tmp_path / "sweep" / f"{i}_job", choice, errors(mae), i)
        write_map(folder, [[0, 0, 0], [1, 0, 0]] if sensor == "bosch" else [[0, 0, 0.5], [5, 0, 0]])
    return tmp_path / "sweep"


@pytest.mark.skipif(not PAPER.is_file(), reason=f"{PAPER} isn't there")
def test_published_figures_are_those_of_the_paper():
    paper = json.loads(PAPER.read_text())
    for ours, theirs in (("mae_m", "mae_m"), ("max_m", "max_m"), ("mse_m2", "mse_m2")):
        for sensor in published.SENSORS:
            for scenario, value in paper[f"trajectory_{theirs}"][sensor].items():
                assert published.published_trajectory(ours, scenario, sensor) == value
    for ours, theirs in (("hausdorff_m", "hausdorff_m"), ("mean_m", "mean_distance_m")):
        for scenario, value in paper["map_bosch_to_velodyne"][theirs].items():
            assert published.published_map(ours, scenario, "bosch", "velodyne") == value
    assert published.published_map("mean_m", "A", "velodyne", "bosch") is None


def test_table_5_1_has_the_published_figures_beside_ours(campaign):
    table = tables_of(campaign)["table_5_1"]
    assert table.text(flat=True)["Scenario"].tolist() == ["A", "B"]
    assert column(table, "velodyne", "MAE", "published") == ["0.25", "0.61"]
    assert column(table, "velodyne", "MAE", "ours") == ["0.200", "0.300"]
    assert column(table, "bosch", "Max.", "published") == ["0.66", "2.68"]
    assert column(table, "bosch", "Max.", "ours") == ["0.200", ""]
    assert column(tables_of(campaign)["table_5_2"], "bosch", "MSE", "ours") == ["0.0100", ""]


def test_table_5_3_pairs_the_sensors_in_both_directions(campaign):
    table = tables_of(campaign)["table_5_3"]
    there = [0.5, np.hypot(1, 0.5)]
    back = [0.5, 4.0]
    text = table.text(flat=True)
    assert text["Scenario"].tolist() == ["A"]
    assert text["bosch → velodyne Mean [m] ours"].tolist() == [f"{np.mean(there):.3f}"]
    assert text["bosch → velodyne Hausdorff [m] ours"].tolist() == [f"{max(there):.3f}"]
    assert text["velodyne → bosch Mean [m] ours"].tolist() == [f"{np.mean(back):.3f}"]
    assert text["velodyne → bosch Hausdorff [m] ours"].tolist() == [f"{max(back):.3f}"]
    assert text["bosch → velodyne Mean [m] published"].tolist() == ["0.04"]
    assert "velodyne → bosch Mean [m] published" not in text
    assert any("B: no maps of two sensors" in note for note in table.notes)
    assert any("frames of their first scans" in note for note in table.notes)


def test_maps_are_compared_in_the_frame_of_the_reference(tmp_path):
    path = np.array([[0, 0, 0], [10, 0, 0], [10, 8, 1], [0, 9, 0.0]])
    seen = np.random.default_rng(0).uniform(-20, 20, (200, 3))
    runs = []
    for sensor, rotation, shift in (
        ("bosch", TURN, (5.0, -3.0, 1.0)),
        ("velodyne", TURN.inv(), (0.0, 2.0, 0.0)),
    ):
        alignment = aligned("se3", rotation, shift)
        folder = write_run(tmp_path / sensor, [f"sensor={sensor}"], errors(0.1, None, alignment))
        write_trajectories(folder, path, rotation, shift)
        write_map(folder, rotation.inv().apply(seen - np.array(shift)))
        runs.append(read_run(folder))
    pair = compare_maps(*runs)
    assert pair.aligned
    assert pair.there.hausdorff_m < 1e-5
    assert pair.back.hausdorff_m < 1e-5


def test_a_straight_path_does_not_leave_the_roll_of_a_map_to_chance(tmp_path):
    """Positions on a line with a millimetre of noise; all poses say that nothing is turned."""
    rng = np.random.default_rng(1)
    line = np.column_stack([np.linspace(0, 200, 100), np.zeros(100), np.zeros(100)])
    noisy = line + rng.normal(0, 1e-3, line.shape)
    folder = write_run(tmp_path / "run", [], errors(0.1, None, aligned("se3")))
    write_trajectories(folder, noisy)
    (folder / "trajectory.tum").rename(tmp_path / "estimate.tum")
    write_trajectories(folder, line)
    (tmp_path / "estimate.tum").rename(folder / "trajectory.tum")
    found = run_map_alignment(read_run(folder))
    assert Rotation.from_matrix(found.R).magnitude() < np.radians(0.01)


def test_alignment_by_poses_is_exact_where_one_fits():
    path = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0.0]])

    def poses(rotation, positions):
        wxyz = np.tile(np.roll(rotation.as_quat(), 1), (3, 1))
        return PosePath3D(positions, wxyz)

    moved = poses(TURN.inv(), TURN.inv().apply(path - [1, 2, 3]))
    found = align_by_poses(moved, poses(Rotation.identity(), path))
    np.testing.assert_allclose(found.R, TURN.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.t, [1, 2, 3], atol=1e-12)


def test_other_alignments_hold_for_the_map_as_they_are(tmp_path):
    folder = write_run(tmp_path / "run", [], errors(1, 2, aligned("sim3", TURN, (1, 2, 3), 2.0)))
    found = run_map_alignment(read_run(folder))
    np.testing.assert_allclose(found.move(np.eye(3)), 2 * TURN.apply(np.eye(3)) + [1, 2, 3])


def test_seeds_give_mean_and_confidence_interval(tmp_path):
    for seed, mae in enumerate([0.1, 0.2, 0.3]):
        write_run(tmp_path / str(seed), ["scenario=A", f"scenario.seed={seed}"], errors(mae))
    table = tables_of(tmp_path)["table_5_1"]
    # Student's t with 2 degrees of freedom: 4.302653; standard error 0.1 / sqrt(3).
    half = 4.302653 * 0.1 / np.sqrt(3)
    assert column(table, "bosch", "MAE", "ours") == [f"0.200 ± {half:.3f}"]
    numbers = table.numbers()
    assert numbers["bosch MAE [m] ours, half width of CI 95 %"].tolist() == pytest.approx([half])
    assert numbers["bosch MAE [m] ours, runs"].tolist() == [3]
    assert any("Student's t" in note for note in table.notes)


def test_maps_are_paired_seed_by_seed(tmp_path):
    for seed in (0, 1):
        for sensor, x in (("bosch", 0.0), ("velodyne", 1.0 + seed)):
            choice = ["scenario=A", f"sensor={sensor}", f"scenario.seed={seed}"]
            folder = write_run(tmp_path / f"{sensor}{seed}", choice, errors(0.1))
            write_map(folder, [[x, 0, 0]])
    text = tables_of(tmp_path)["table_5_3"].text(flat=True)
    (cell,) = text["bosch → velodyne Mean [m] ours"]
    assert cell.startswith("1.500 ±")


def test_settings_that_differ_make_rows_and_the_best_is_marked(tmp_path):
    for i, (pruning, mae, rate) in enumerate([("none", 0.1, 5.0), ("geometry", 0.2, 9.0)]):
        choice = ["scenario=loop", f"pruning={pruning}"]
        trajectory = headlined(errors(mae), position_error=("Position error", mae, "m", True))
        resources = headlined(
            {},
            speed=("Speed", rate, "scans/s", False),
            memory=("Peak memory", 500.0, "MB", True),
        )
        write_run(tmp_path / str(i), choice, trajectory, resources=resources)
    table = tables_of(tmp_path)["headlines"]
    assert table.index == ("pruning",)
    best = dict(zip(table.text(flat=True).columns, table.best().T.tolist(), strict=True))
    assert best["Position error [m]"] == [True, False]
    assert best["Speed [scans/s]"] == [False, True]
    assert best["Peak memory [MB]"] == [False, False]
    assert best["Max. error [m]"] == [True, False]
    assert tables_of(tmp_path)["table_5_1"].text(flat=True)["Settings"].tolist() == [
        "pruning=none",
        "pruning=geometry",
    ]


class Wobble:
    """A metric of somebody else."""

    name, title, unit, less_is_better = "wobble", "Wobble", "rad", False
    section, keys, needs, meaning = Section.MAP, ("wobble",), (), "How it wobbles."


def test_a_third_party_metric_appears_with_its_best_value_marked(tmp_path):
    for i, wobble in enumerate([0.25, 1234.5, None]):
        found = None if wobble is None else Measurement({"wobble": wobble}, wobble)
        sections = to_sections([Verdict(Wobble(), found, None if found else "it stands still")])
        write_run(tmp_path / str(i), ["scenario=A", f"pruning={i}"], **sections)
    table = tables_of(tmp_path)["headlines"]
    assert column(table, "Wobble", "[rad]") == ["0.25", "1,234", ""]
    assert table.best()[:, -1].tolist() == [False, True, False]
    assert "**1,234**" in markdown([table], [])


def test_headlines_of_all_runs_come_in_their_order_and_extras_last(tmp_path):
    some = {"b": ("B", None, "", None), "a": ("A", 2.0, "m", True), "d": ("D", None, "s", True)}
    others = {"b": ("B", 3.0, "", None), "c": ("C", 4.0, "%", True)}
    write_run(tmp_path / "0", ["pruning=none"], headlined(errors(0.1), **some))
    write_run(
        tmp_path / "1", ["pruning=geometry"], headlined(errors(0.2), **others), graph={"edges": 7}
    )
    table = tables_of(tmp_path)["headlines"]
    headings = ["pruning", "B", "A [m]", "C [%]", "Max. error [m]", "Edges"]
    assert table.text(flat=True).columns.tolist() == headings
    assert column(table, "B") == ["", "3"]


def test_a_headline_in_another_unit_is_another_column(tmp_path):
    for i, unit in enumerate(["m", "cm"]):
        sections = {"map": headlined({}, a=("A", 1.0, unit, True))}
        write_run(tmp_path / str(i), [f"pruning={i}"], **sections)
    table = tables_of(tmp_path)["headlines"]
    assert column(table, "A", "[m]") == ["1", ""]
    assert column(table, "A", "[cm]") == ["", "1"]


@pytest.mark.parametrize(
    ("cell", "digits", "text"),
    [
        (Cell(0.0123456), None, "0.01235"),
        (Cell(12345.6), None, "12,346"),
        (Cell(0.0123456, 0.0009876, 3), None, "0.01235 ± 0.00099"),
        (Cell(12345.6, 98.76, 3), None, "12,346 ± 99"),
        (Cell(12345.6, 98.76, 3), 1, "12,345.6 ± 98.8"),
        (Cell(), None, ""),
    ],
)
def test_figures_have_four_significant_digits_or_as_many_as_are_asked_for(cell, digits, text):
    assert cell.text(digits) == text


def test_a_default_that_was_not_written_down_equals_the_same_choice_written_down(tmp_path):
    write_run(tmp_path / "a", ["scenario=A"], errors(0.1))
    write_run(tmp_path / "b", ["scenario=A", "system=kiss_icp"], errors(0.2))
    write_run(tmp_path / "c", ["scenario=B", "system=lifelong", "scenario.laps=1"], errors(0.3))
    table = tables_of(tmp_path)["headlines"]
    assert table.index == ("scenario", "system")
    assert list(table.rows) == [("A", "lifelong"), ("A", "kiss_icp"), ("B", "lifelong")]


def test_runs_on_different_scenarios_do_not_compete(tmp_path):
    write_run(tmp_path / "a", ["scenario=A"], errors(0.1))
    write_run(tmp_path / "b", ["scenario=B"], errors(0.2))
    assert not tables_of(tmp_path)["headlines"].best().any()


def test_failed_killed_stopped_and_repeated_runs_are_named(tmp_path):
    sweep = tmp_path / "sweep"
    write_run(sweep / "0_A", ["scenario=A"], errors(0.1), 0)
    killed = write_run(sweep / "1_B", ["scenario=B"], errors(0.1), 1)
    (killed / "metrics.json").unlink()
    stopped = write_run(sweep / "2_C", ["scenario=C"], errors(0.1), 2)
    (stopped / "metrics.json").write_text('{"run": {"interrupted": true}}')
    broken = write_run(sweep / "3_D", ["scenario=D"], errors(0.1), 3)
    (broken / "metrics.json").write_text("{")
    multirun = {
        "hydra": {"overrides": {"task": ["scenario=A,B,C,D,E"]}, "sweeper": {"params": None}}
    }
    OmegaConf.save(OmegaConf.create(multirun), sweep / "multirun.yaml")
    again = write_run(tmp_path / "later", ["scenario=A"], errors(0.2))
    os.utime(sweep / "0_A" / "metrics.json", (1, 1))
    runs = find_runs([tmp_path])
    assert [run.folder for run in runs.finished] == [again]
    reasons = {
        Path(missing.name.partition(",")[0]).name: missing.reason for missing in runs.missing
    }
    assert "no metrics.json" in reasons["1_B"]
    assert "stopped early" in reasons["2_C"]
    assert "can't be read" in reasons["3_D"]
    assert "left no folder" in reasons["sweep"]
    assert "newer run" in reasons["0_A"]
    assert any("job 4: scenario=E" in missing.name for missing in runs.missing)
    text = markdown(make_tables(runs.finished), runs.missing)
    assert "Not in the tables: 5" in text


def test_a_run_counts_once_however_it_is_named(tmp_path):
    write_run(tmp_path / "sweep" / "0_A", ["scenario=A"], errors(0.1))
    runs = find_runs([tmp_path, tmp_path / "sweep", tmp_path / "sweep" / "0_A"])
    assert len(runs.finished) == 1
    assert runs.missing == ()


def test_jobs_come_in_the_order_of_their_numbers(tmp_path):
    for number in (10, 2, 1):
        write_run(tmp_path / f"{number}_x", [f"seed={number}"], errors(0.1), number)
    assert [r.folder.name for r in find_runs([tmp_path]).finished] == ["1_x", "2_x", "10_x"]


def test_no_folder_and_no_runs_are_errors_that_say_so(tmp_path):
    with pytest.raises(FileError, match="no such folder of runs"):
        find_runs([tmp_path / "nowhere"])
    with pytest.raises(FileError, match="no finished run"):
        find_runs([tmp_path])


def test_folders_without_any_config_stand_for_themselves(tmp_path):
    for name, mae in (("mine", 0.1), ("theirs", 0.2)):
        (tmp_path / name).mkdir()
        metrics = {"trajectory": errors(mae)}
        (tmp_path / name / "metrics.json").write_text(json.dumps(metrics))
    table = tables_of(tmp_path)["table_5_1"]
    assert table.text(flat=True)["Scenario"].tolist() == ["mine", "theirs"]
    headlines = tables_of(tmp_path)["headlines"]
    assert list(headlines.rows) == [("mine",), ("theirs",)]
    assert column(headlines, "Max.") == ["0.2", "0.4"]
    assert headlines.best()[:, 1].tolist() == [True, False]


def test_a_map_that_cannot_be_read_is_a_note(tmp_path):
    for sensor in ("bosch", "velodyne", "vls128"):
        folder = write_run(tmp_path / sensor, ["scenario=A", f"sensor={sensor}"], errors(0.1))
        if sensor != "vls128":
            write_map(folder, [[0, 0, 0]])
    table = tables_of(tmp_path)["table_5_3"]
    assert any("maps not compared" in note for note in table.notes)
    assert table.text(flat=True)["bosch → velodyne Mean [m] ours"].tolist() == ["0.000"]


def test_an_empty_map_is_an_error(tmp_path):
    runs = []
    for name, points in (("a", []), ("b", [[0, 0, 0]])):
        folder = write_run(tmp_path / name, [], errors(0.1))
        write_map(folder, points)
        runs.append(read_run(folder))
    with pytest.raises(EvalError, match="without points"):
        compare_maps(*runs)


def awkward():
    """Return a table whose words mean something to LaTeX and Markdown."""
    columns = (
        Column(("bosch → velodyne", "A_b & 50 % [m²]", "ours"), 1, True),
        Column(("bosch → velodyne", "A_b & 50 % [m²]", "published"), 2),
    )
    rows = {("x|y_#1",): [Cell(1.0, 0.5, 3), Cell(2.0)], ("{$}",): [Cell(2.0), Cell()]}
    return Table("t", "A title", ("A note.",), ("key",), columns, rows, contest=0)


def test_latex_is_balanced_and_escaped():
    text = latex([awkward()])
    assert re.findall(r"\\(begin|end){(\w+)}", text) == [
        ("begin", "table"),
        ("begin", "tabular"),
        ("end", "tabular"),
        ("end", "table"),
    ]
    plain = re.sub(r"\\[{}\\$]", "", text)
    assert plain.count("{") == plain.count("}")
    assert "A\\_b \\& 50 \\% [m$^2$]" in text
    assert "$\\rightarrow$" in text
    assert "\\textbf{1.0 $\\pm$ 0.5}" in text
    assert "\\toprule" in text
    assert text.isascii()
    body = [
        line for line in text.splitlines() if line.endswith("\\\\") and "multicolumn" not in line
    ]
    cells = [len(re.findall(r"(?<!\\)&", line)) for line in body]
    assert set(cells) == {2}


def test_markdown_has_as_many_cells_in_every_line():
    lines = [line for line in markdown([awkward()], []).splitlines() if line.startswith("|")]
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) == 1
    assert "**1.0 ± 0.5**" in lines[2]
    assert "x\\|y_#1" in lines[2]


def test_csv_has_numbers(tmp_path, campaign):
    tables = make_tables(find_runs([campaign]).finished)
    write_tables(tmp_path / "out", tables, [])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "comparison.md",
        "comparison.tex",
        "headlines.csv",
        "table_5_1.csv",
        "table_5_2.csv",
        "table_5_3.csv",
    }
    rows = list(csv.DictReader(StringIO((tmp_path / "out" / "table_5_1.csv").read_text())))
    assert float(rows[0]["velodyne MAE [m] ours"]) == 0.2
    assert rows[1]["bosch MAE [m] ours"] == ""


HOSTILE = ["=1+1", "+1+1", "-1+cmd|' /C calc'!A0", "@SUM(A1)", "\t=1", "\r\n=1"]


@pytest.mark.parametrize("text", HOSTILE)
def test_no_cell_of_a_csv_is_a_formula(tmp_path, text):
    columns = (Column((text, "[m]")), Column(("difference [m]",)))
    table = Table("t", "T", (), (text, "run"), columns, {(text, "-0.3"): [Cell(-0.3), Cell(2.0)]})
    write_tables(tmp_path, [table], [])
    with (tmp_path / "t.csv").open(newline="") as file:
        heading, row = list(csv.reader(file))
    assert heading == [f"'{text.strip()}", "run", f"'{text.strip()} [m]", "difference [m]"]
    assert row == [f"'{text.strip()}", "-0.3", "-0.3", "2.0"]


@pytest.mark.parametrize("text", ["<img src=x onerror=alert(1)>", "<b>a</b> & b", "a\n<script>"])
def test_markdown_has_no_html_of_others(text):
    table = Table(text, text, (text,), (text,), (Column((text,)),), {(text,): [Cell(1.0)]})
    written = markdown([table], [Missing(text, text)])
    assert "<" not in written
    rows = [line for line in written.splitlines() if line.startswith("|")]
    assert len(rows) == 3
    assert written.count("&lt;") == 7 * text.count("<")


def test_a_setting_may_refer_to_what_is_not_there(tmp_path):
    folder = write_run(tmp_path / "run", ["scenario=A", "scenario.topic=/points"], errors(0.1))
    config = folder / ".hydra" / "config.yaml"
    config.write_text("scenario:\n  topic: ${hydra:nowhere}\n")
    run = read_run(folder)
    assert isinstance(run, Run)
    assert run.setting("scenario.topic") == "/points"
