"""The pruning ablation: back end on a simulated run, command line, files."""

import csv
import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from ablate_pruning import main
from ablation_jobs import Job
from eval.ablation import COLUMNS
from eval.files import write_json
from lifelong_slam.geometry import exp, invert, log
from lifelong_slam.graph.ablation import BackEnd, drive
from lifelong_slam.graph.marginalisation import StarMesh
from lifelong_slam.graph.pruning import NoPruning, Pruner
from lifelong_slam.graph.removal import recover
from lifelong_slam.graph.selection import Decimate
from lifelong_slam.simulation.building_run import BuildingRun

HOURS = 0.2
METHODS = ("none", "geometry")


@pytest.fixture(scope="module")
def run():
    return BuildingRun(HOURS, seed=0)


def last(samples):
    """Return the last of them."""
    *_, sample = samples
    return sample


@pytest.fixture(scope="module")
def halved(run):
    """Return a back end that removed every second keyframe of the run."""
    back_end = BackEnd(Pruner(Decimate(2), StarMesh()), capacity=len(run))
    for step in run:
        back_end.add(step, run.loops(step, back_end.survivors))
        if back_end.window == 30:
            back_end.optimise()
            back_end.settle(10)
    return back_end


def test_recovering_all_at_once_gives_what_one_by_one_gives(halved):
    rng = np.random.default_rng(0)
    poses = {i: T @ exp(0.1 * rng.normal(size=6)) for i, T in halved.graph.poses().items()}
    removals = halved.removals
    one_by_one = dict(poses)
    for removal in reversed(removals):
        pairs = zip(removal.neighbours.tolist(), removal.T_neighbour_vertex, strict=True)
        means = [one_by_one[i] @ T for i, T in pairs]
        shifts = [log(invert(means[0]) @ mean) for mean in means]
        step = sum(G @ shift for G, shift in zip(removal.gains, shifts, strict=True))
        one_by_one[removal.vertex] = means[0] @ exp(step)
    at_once = recover(poses, removals)
    assert len(removals) > 100
    assert len({len(removal.neighbours) for removal in removals}) > 1
    assert at_once.keys() == one_by_one.keys()
    assert np.allclose([at_once[i] for i in one_by_one], list(one_by_one.values()), atol=1e-12)


def test_survivors_are_the_vertices_of_the_graph(run, halved):
    assert halved.survivors.tolist() == sorted(halved.graph.vertices)
    assert len(halved.graph) < 0.7 * len(run)


def test_every_keyframe_ever_taken_has_a_position_near_the_truth(run):
    sample = last(drive(run, Pruner(Decimate(2), StarMesh()), window=20))
    assert sample.positions.shape == (len(run), 3)
    start = run.truth[0]
    truth = (run.truth[:, :3, 3] - start[:3, 3]) @ start[:3, :3]  # the map begins at the first one
    assert np.linalg.norm(sample.positions - truth, axis=1).max() < 0.5


def test_an_exhausted_budget_ends_the_measurement_and_not_the_run(run):
    measured = list(drive(run, NoPruning(), sample_every=120))
    cut = list(drive(run, NoPruning(), sample_every=120, budget=0.0))
    assert [s.vertices for s in cut] == [s.vertices for s in measured]
    assert [s.edges for s in cut] == [s.edges for s in measured]
    assert np.isfinite([s.back_end_seconds for s in measured]).all()
    assert np.isnan([s.back_end_seconds for s in cut]).all()
    # The optimum doesn't depend on how often it was looked for.
    assert np.allclose(cut[-1].positions, measured[-1].positions, atol=0.01)


def test_samples_come_when_asked_and_at_the_end(run):
    seconds = [sample.seconds for sample in drive(run, NoPruning(), sample_every=200)]
    assert len(seconds) == 4
    assert np.allclose(seconds[:3], [200, 400, 600], atol=5)
    assert seconds[-1] == run.travelled[-1]


def test_the_size_of_a_graph_does_not_depend_on_how_many_wait_to_be_settled(run):
    half = Pruner(Decimate(2), StarMesh())
    samples = list(drive(run, half, window=20, settle_every=10, sample_every=7))
    kept = [sample.vertices - 20 for sample in samples[10:]]
    assert set(np.diff(kept)) == {0, 5}


def test_a_run_without_a_curve_that_is_wanted_now_is_not_done(tmp_path):
    job = Job("none", {}, 0.0, 0, HOURS, 40, None, 10, 15.0)
    assert not job.is_done(tmp_path)
    curves = {column: [1.0] for column in COLUMNS}
    write_json(job.file(tmp_path), {"job": asdict(job), "curves": curves})
    assert job.is_done(tmp_path)
    assert not replace(job, seed=1).is_done(tmp_path)
    del curves["cells"]
    write_json(job.file(tmp_path), {"job": asdict(job), "curves": curves})
    assert not job.is_done(tmp_path)


@pytest.mark.slow
def test_two_methods_leave_their_files_and_a_second_command_repeats_nothing(tmp_path, capsys):
    command = [f"hours={HOURS}", "seeds=1", "methods=none,geometry", "sample_minutes=3"]
    command += ["window=30", f"out={tmp_path}"]
    assert main(command) == 0
    assert "geometry" in capsys.readouterr().out
    with (tmp_path / "ablation.csv").open() as file:
        table = list(csv.DictReader(file))
    vertices = {m: [int(float(r["vertices"])) for r in table if r["method"] == m] for m in METHODS}
    assert vertices["none"] == sorted(set(vertices["none"]))
    assert vertices["geometry"][-1] < 0.7 * vertices["none"][-1]
    summary = json.loads((tmp_path / "ablation.json").read_text())["summary"]
    assert [entry["method"] for entry in summary] == list(METHODS)
    assert summary[1]["compared"]["map_error_m"]["mean"] < 0.1
    for name in ("overview", "vertices", "edges", "back_end_s", "memory_mb", "ape_m"):
        assert (tmp_path / f"wrong0_{name}.png").is_file()
        assert (tmp_path / f"wrong0_{name}.svg").is_file()

    stamps = {file: file.stat().st_mtime_ns for file in (tmp_path / "runs").iterdir()}
    assert main(command) == 0
    assert stamps == {file: file.stat().st_mtime_ns for file in (tmp_path / "runs").iterdir()}
    assert main([*command, "settle_every=5", "methods=none"]) == 0  # other settings: run anew
    changed = {f.name for f, stamp in stamps.items() if f.stat().st_mtime_ns != stamp}
    assert changed == {"none_wrong0_seed0.json", "none_wrong0_seed0.npy"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["methods=geometri"], "Did you mean 'geometry'"),
        (["hour=2"], "hour"),
        (["seeds=many"], "seeds"),
        (["wrong=some"], "some"),
        (["geometry.nonsense=2"], "nonsense"),
        (["geometric.spacing=2"], "one of the methods"),
    ],
)
def test_bad_settings_are_refused_in_one_line(tmp_path, capsys, arguments, said):
    assert main(["hours=0.1", "seeds=1", f"out={tmp_path}", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error:")
    assert said in error
    assert len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())
