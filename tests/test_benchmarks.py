"""The benchmarks' tables and counts, and a run of each on a handful of small scans."""

import csv
import importlib
import importlib.util
import json
import sys
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from g2o_support import laps as laps_in_file
from run_support import START, ListSource, arc, write_folder

from lifelong_slam.errors import ConfigError
from lifelong_slam.geometry import exp
from lifelong_slam.graph.marginalisation import StarMesh
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.io.g2o import write_g2o
from lifelong_slam.result import Edge, GraphSnapshot, SlamResult
from lifelong_slam.trajectory import Trajectory

FOLDER = str(Path(__file__).parents[1] / "benchmarks")
sys.path.insert(0, FOLDER)
throughput = importlib.import_module("throughput")
laps = importlib.import_module("laps")
campaigns = importlib.import_module("campaigns")
tables = importlib.import_module("campaign_tables")
factor_recovery = importlib.import_module("factor_recovery")

needs_kiss_slam = pytest.mark.skipif(
    importlib.util.find_spec("kiss_slam") is None,
    reason="the optional package kiss-slam isn't installed",
)


def timing(process=2.0, finish=0.0, scans=100, loops=0):
    stages = {"odometry": 1.0, "loop": 0.25, "optimise": 0.25, "prune": 0.0}
    return throughput.Timing(scans, process, finish, 2 * (process + finish), stages, loops)


def cells_of(text):
    """Return the cells of a Markdown table's body."""
    return [[c.strip() for c in line.strip("|").split("|")] for line in text.splitlines()[2:]]


def test_markdown_columns_line_up():
    text = throughput.markdown(("a", "number"), [("row", "1"), ("x", "22")])
    assert text.splitlines() == [
        "| a   | number |",
        "| --- | -----: |",
        "| row |      1 |",
        "| x   |     22 |",
    ]


def test_systems_take_turns_forwards_and_backwards():
    assert throughput.turns(0) == throughput.turns(2) == throughput.SYSTEMS
    assert throughput.turns(1) == throughput.SYSTEMS[::-1]


def test_ratios_are_taken_within_a_repeat_and_include_finish():
    timings = {
        "lifelong": [timing(2.0, 2.0), timing(1.0, 1.0), timing(3.0, 3.0)],
        "kiss_icp": [timing(2.0), timing(2.0), timing(3.0)],
        "kiss_slam": [timing(4.0), timing(4.0), timing(4.0)],
    }
    first, second, third = cells_of(throughput.ratios_table(timings))
    assert first == ["lifelong / kiss_icp", "0.50", "0.50 .. 1.00", "1.00"]
    assert second[1] == "1.00"
    assert third == ["kiss_slam / kiss_icp", "0.50", "0.50 .. 0.75", "0.50"]
    rates = cells_of(throughput.rates_table(timings))
    assert rates[0] == ["lifelong", "25.0", "50.0", "2.00", "2.00", "0"]


def test_stages_add_up_to_the_wall_time():
    rows = cells_of(throughput.stages_table([timing(2.0, 0.5), timing(2.0, 0.5)]))
    milliseconds = {name: float(value) for name, value, _ in rows}
    assert milliseconds["between the stages"] == 5.0
    assert milliseconds["finish"] == 5.0
    assert milliseconds.pop("all") == sum(milliseconds.values()) == 25.0


def test_composes_what_the_run_script_would_and_spares_peers_their_maps():
    ours = throughput.compose_config(["scenario=loop", *throughput.system_overrides("lifelong")])
    assert ours.system.static_map.voxel_size > 0
    peer = throughput.compose_config(["sensor=vls128", *throughput.system_overrides("kiss_icp")])
    assert peer.system.map_voxel_size is None
    assert peer.system.threads == 0
    assert peer.system.max_range == ours.sensor.max_range
    with pytest.raises(ConfigError, match="there is no such sensor"):
        throughput.compose_config(["sensor=vls129"])


def test_command_line_names_no_folder_of_this_machine(tmp_path):
    text = throughput.facts("x.py", ["--out", str(tmp_path / "here"), "--scenarios", ""])
    assert "`python benchmarks/x.py --out here --scenarios ''`" in text
    assert str(tmp_path) not in text


@pytest.mark.slow
@needs_kiss_slam
def test_throughput_of_a_few_scans(tmp_path, capsys):
    path = write_folder(tmp_path / "scans", 8)
    options = ["--scenario=folder", "--sensor=solid_state", "--repeats=2", f"scenario.path={path}"]
    assert throughput.main([*options, "--scans=6"]) == 0
    out = capsys.readouterr().out
    assert "6 scans of" in out
    assert "| lifelong / kiss_slam |" in out
    assert str(tmp_path) not in out


def test_throughput_says_in_one_line_what_is_wrong(capsys):
    assert throughput.main(["--scenario=folder", "scenario.pat=x"]) == 2
    assert "scenario.pat" in capsys.readouterr().err


def test_a_slower_machine_is_told_from_a_slower_system():
    early = [laps.Lap(n, 50.0, 10.0, 500.0, 400.0, 60.0) for n in range(1, 6)]
    last = laps.Lap(6, 60.0, 12.0, 550.0, 420.0, 61.0)
    rows = cells_of(laps.growth([*early, last]))
    assert [row[1:] for row in rows] == [
        ["3", "1.200"],
        ["3", "1.000"],
        ["5", "1.100"],
        ["5", "1.050"],
    ]
    assert cells_of(laps.table([last])) == [["6", "60.0", "12.0", "5.000", "550", "420", "61"]]


@pytest.mark.slow
def test_two_laps_of_coarse_sweeps(tmp_path, capsys):
    options = ["--laps=2", "--azimuth-step=8", f"scenario.cache_dir={tmp_path}"]
    assert laps.main(options) == 0
    out = capsys.readouterr().out
    assert len(cells_of(out.split("### lifelong\n\n")[1].split("\n\n")[0])) == 2
    assert "| time by the yardstick |" in out


def outcome(scenario, sensor, system, mae, seed=0):
    cell = campaigns.Cell(scenario, sensor, system, seed)
    if mae is None:
        return campaigns.Outcome(cell, error="no luck")
    return campaigns.Outcome(cell, 100, 50.0, mae, 1.1 * mae, 2 * mae)


def test_table_has_the_published_figures_beside_ours():
    outcomes = [
        outcome("A", "velodyne", "lifelong", 0.0123),
        outcome("A", "velodyne", "kiss_icp", None),
        outcome("E", "velodyne", "lifelong", 2.0),
    ]
    header, *_ = (text := tables.published_table(tables.Table(outcomes), "mae_m")).split("\n")
    assert "velodyne: published" in header
    assert cells_of(text) == [["A", "0.25", "0.012", "failed"], ["E", "1.22", "2.000", ""]]


def test_only_the_campaigns_own_sensors_have_published_figures():
    assert tables.published("max_m", "E", "bosch") == [5.70]
    assert tables.published("mae_m", "E", "vls128") == []


def test_spread_over_seeds_leaves_out_failures_and_says_so():
    values = (0.1, 0.2, None, 0.6)
    outcomes = [outcome("B", "bosch", "lifelong", mae, seed) for seed, mae in enumerate(values)]
    text = tables.spread_table(tables.Table(outcomes), "mae_m")
    assert cells_of(text) == [["B", "bosch", "0.300 (0.100 .. 0.600) 1 failed"]]


def test_summary_counts_cells_and_failures_as_the_worst():
    outcomes = [
        outcome("A", "bosch", "lifelong", 0.09),
        outcome("A", "bosch", "kiss_slam", None),
        outcome("B", "bosch", "lifelong", 1.0),
        outcome("B", "bosch", "kiss_slam", 0.9),
        outcome("C", "bosch", "lifelong", None),
        outcome("C", "bosch", "kiss_slam", None),
    ]
    lines = tables.summary(tables.Table(outcomes)).splitlines()
    assert [line.rpartition(": ")[2] for line in lines] == [
        "2 of 3 cells",
        "1 of 3 cells",
        "1 of 3 cells",
    ]


def test_report_keeps_loop_apart_and_survives_a_first_cell():
    loop = campaigns.Outcome(campaigns.Cell("loop", "vls128", "lifelong", 0, 3), 9, 1266.0, 1, 2, 3)
    text = campaigns.report([outcome("A", "bosch", "lifelong", 0.1), loop], [], limit=9)
    assert "Errors in metres on 3 laps of loop" in text
    assert "Only the first 9 scans" in text
    assert "over world seeds" not in text
    assert campaigns.report([loop], []).count("## ") == 1
    two = [outcome("A", "bosch", "lifelong", 0.1, seed) for seed in (0, 1)]
    assert "over world seeds 0, 1" in campaigns.report(two, [])


class CalibratedSource(ListSource):
    """A source whose sensor looks sideways, with a reference at the scans' stamps."""

    T_base_sensor = exp(np.array([0.0, 0.0, 1.5, 1.0, 0.5, 2.0]))

    def __init__(self, reference):
        super().__init__([])
        self._reference = reference

    def reference(self):
        return self._reference


def test_judges_the_base_after_alignment():
    poses, stamps = arc(50), START + np.arange(50) * 100_000_000
    wave = np.tile(np.eye(4), (50, 1, 1))
    wave[:, 2, 3] = np.resize([0.1, -0.1], 50)
    source = CalibratedSource(Trajectory(stamps, poses))
    X = source.T_base_sensor
    moved = exp(np.array([0.2, 0.1, 1.0, 5.0, 6.0, 7.0]))
    sensor = Trajectory(stamps, np.linalg.inv(X) @ moved @ wave @ poses @ X)
    loop = Edge(0, 3, np.eye(4), np.eye(6), "loop")
    result = SlamResult(sensor, np.empty((0, 3), np.float32), GraphSnapshot({}, [loop]))
    found = campaigns.judge(campaigns.Cell("A", "bosch", "lifelong", 0), result, source)
    assert found.mae_m == pytest.approx(0.1, abs=1e-3)
    assert found.rmse_m == pytest.approx(0.1, abs=1e-3)
    assert (found.scans, found.loops) == (50, 1)
    assert found.length_m == pytest.approx(49 * 0.2, rel=1e-3)
    with pytest.raises(ConfigError, match="has no reference"):
        campaigns.judge(found.cell, result, CalibratedSource(None))


def test_cell_is_called_as_the_run_script_is():
    cell = campaigns.Cell("loop", "vls128", "kiss_icp", 2, 3)
    config = throughput.compose_config(cell.overrides())
    assert (config.scenario.seed, config.scenario.laps) == (2, 3)
    assert config.scenario.rig == ["vls128"]


def test_campaigns_refuses_what_is_misspelt_before_anything_runs(tmp_path, capsys):
    assert campaigns.main(["--out", str(tmp_path), "--systems", "lifelong,kiss_ipc"]) == 2
    assert "Did you mean 'kiss_icp'" in capsys.readouterr().err
    assert campaigns.main(["--out", str(tmp_path), "--scenarios", ""]) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_campaigns_of_a_few_scans(tmp_path, capsys):
    cache = [f"scenario.cache_dir={tmp_path / 'cache'}"]
    coarse = ["scenario.rig=[bosch]", "+scenario.azimuth_steps={bosch: 1.0}", "scenario.speed=16"]
    choice = ["--scenarios=A", "--sensors=bosch", "--systems=kiss_icp", "--scans=10"]
    out = tmp_path / "out"
    assert campaigns.main(["--out", str(out), *choice, *cache, *coarse]) == 0
    assert (out / "campaigns.md").read_text() == capsys.readouterr().out
    with (out / "campaigns.csv").open() as file:
        (row,) = csv.DictReader(file)
    (same,) = json.loads((out / "campaigns.json").read_text())["cells"]
    assert row["mae_m"] == str(same["mae_m"])
    assert int(row["scans"]) == 10


# Factor recovery.


def star_of(size, seed=0):
    """Return a vertex among others, with measurements of unlike covariances to all of them."""
    rng = np.random.default_rng(seed)
    graph = PoseGraph()
    graph.add_vertex(0, np.eye(4))
    hub = exp(rng.normal(size=6))
    for i in range(size):
        A = rng.normal(size=(6, 6)) * 0.1
        covariance = (A @ A.T + 0.01 * np.eye(6)) * 0.01
        motion = hub if i == 0 else exp(rng.normal(size=6))
        ends = (0, 100) if i == 0 else (100, i)
        graph.add_odometry(Edge(*ends, motion, covariance, "odometry"))
    return factor_recovery.Star(graph, 100, set(range(size)))


@pytest.mark.parametrize("size", [2, 3, 5])
def test_the_best_edges_between_the_same_pairs_lose_no_more_than_the_mesh(size):
    mesh, recovered, tree = factor_recovery.compare(star_of(size))
    assert -1e-9 < recovered.divergence <= mesh.divergence + 1e-9
    assert recovered.divergence <= tree.divergence + 1e-9
    if size == 2:  # one edge is all there is to say
        assert max(one.divergence for one in (mesh, recovered, tree)) < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_no_other_edges_between_the_pairs_are_better_than_those_recovered(seed):
    """Karush, Kuhn and Tucker: the slope vanishes where there is information, and rises elsewhere."""
    star = star_of(5, seed)
    edges = star.left_by(StarMesh())
    best, exact = star.recovered(edges), np.linalg.inv(star.exact)
    assert np.trace(best @ exact) == pytest.approx(len(exact), rel=1e-4)
    for edge in edges:
        J = star._jacobian(edge)
        wanted = J @ exact @ J.T
        slope = wanted - J @ np.linalg.solve(best, J.T)
        assert np.linalg.eigvalsh(slope)[0] > -1e-3 * np.linalg.eigvalsh(wanted)[-1]


def test_the_time_of_factor_recovery_includes_the_mesh_that_it_begins_with(monkeypatch):
    clock = count(10.0)  # a second goes by from one look to the next
    monkeypatch.setattr(factor_recovery, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    assert [one.ms for one in factor_recovery.compare(star_of(3))] == [1000, 2000, 1000]


def test_factor_recovery_prints_a_row_for_each_method(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["factor_recovery.py", "--hours", "0.1", "--every", "20"])
    factor_recovery.main()
    rows = cells_of(capsys.readouterr().out.split("unknown")[-1].split("|", 1)[1])
    methods = [row[2] for row in rows if len(row) == 8]
    assert methods
    assert set(methods) == {"mesh", "recovered", "tree"}


def test_robustness_tells_true_closures_from_wrong_ones(tmp_path, capsys):
    robustness = importlib.import_module("robustness")
    graph, truth = laps_in_file(planar=True, seed=1)
    write_g2o(tmp_path / "laps.g2o", graph)
    write_g2o(tmp_path / "laps_groundtruth.txt", GraphSnapshot(truth, [], planar=True))
    out = tmp_path / "out"
    ends = ["--data", str(tmp_path), "--graph", "laps", "--out", str(out)]
    assert robustness.main([*ends, "--windows", "0-40,0-60", "--shares", "20", "--seeds", "1"]) == 0
    rows = json.loads((out / "robustness.json").read_text())["windows"]
    assert [row["wrong"] for row in rows] == [5, 10]
    for row in rows:
        assert row["accepted"]["ours"] == row["left_out"]["ours"] == 0
        assert row["ape"]["ours"] == pytest.approx(row["bar"])
        assert row["ape"]["least squares"] > 2 * row["bar"]
        assert row["objective"]["ours"] <= row["objective"]["GNC"] + 1e-2
    assert "| 20" in capsys.readouterr().out
    assert (out / "robustness.png").stat().st_size > 10_000
    pair = f"{tmp_path / 'laps.g2o'}:{tmp_path / 'laps_groundtruth.txt'}"
    assert robustness.main(["--files", pair]) == 0
    assert "| laps" in capsys.readouterr().out
