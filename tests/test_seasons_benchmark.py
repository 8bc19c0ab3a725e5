"""How maps are held to a place that changes, on a field where upright plates come and go."""

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.io.ply import write_ply
from lifelong_slam.simulation.movables import MovableTruth
from lifelong_slam.trajectory import Trajectory, write_tum

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
change = importlib.import_module("change")
seasons = importlib.import_module("seasons")

FIELD = np.array(
    [[[-50, -50, 0], [50, -50, 0], [50, 50, 0]], [[-50, -50, 0], [50, 50, 0], [-50, 50, 0.0]]]
)


def plate(place: int) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles and points, 0.1 m apart, of the plate in a place, 0.6 m above the field."""
    x, low, high = 3.0 * place, 0.6, 2.6
    corners = np.array([[x, 0, low], [x, 2, low], [x, 2, high], [x, 0, high]])
    y, z = np.meshgrid(np.arange(0.05, 2, 0.1), np.arange(low + 0.05, high, 0.1))
    points = np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])
    return corners[[[0, 1, 2], [0, 2, 3]]], points


def visit(places: dict[int, int], returns: int = 5) -> Any:
    """Return the truth of a session in which object `id` stands in place `places[id]`."""
    plates = {number: plate(place) for number, place in places.items()}
    mesh = np.concatenate([FIELD, *(triangles for triangles, _ in plates.values())])
    points = [points for _, points in plates.values()]
    objects = np.repeat(np.array(list(plates), np.int64), 400)
    truth = MovableTruth(
        ids=np.array(list(plates), np.int64),
        kinds=np.array(["car"] * len(plates), np.str_),
        points=np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32),
        objects=objects,
        returns=np.full(len(objects), returns),
    )
    poses = np.tile(np.eye(4), (2, 1, 1))
    surface = change.Surface(mesh, np.concatenate([ground(), *points]))
    return change.Visit(truth, surface, Trajectory(np.array([0, 1]), poses))


def ground() -> np.ndarray:
    x, y = np.meshgrid(np.arange(-5, 15, 0.1), np.arange(-5, 5, 0.1))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def cloud(*places: int) -> np.ndarray:
    return np.concatenate([ground(), *(plate(place)[1] for place in places)])


def shares(scores: list[Any]) -> dict[int, tuple[str, int, float]]:
    return {s.object: (s.change, s.visits, s.share) for s in scores}


def test_a_map_that_forgets_at_once_and_learns_at_once() -> None:
    meter = change.ChangeMeter()
    meter.measure(visit({1: 0, 2: 1}), cloud(0, 1))
    scores = meter.measure(visit({2: 1, 3: 2}), cloud(1, 2))
    assert shares(scores) == {1: ("gone", 1, 0.0), 2: ("stayed", 2, 1.0), 3: ("new", 1, 1.0)}


def test_a_map_that_never_forgets_and_never_learns() -> None:
    meter = change.ChangeMeter()
    meter.measure(visit({1: 0, 2: 1}), cloud(0, 1))
    meter.measure(visit({2: 1, 3: 2}), cloud(0, 1))
    scores = meter.measure(visit({2: 1, 3: 2}), cloud(0, 1))
    assert shares(scores) == {1: ("gone", 2, 1.0), 2: ("stayed", 3, 1.0), 3: ("new", 2, 0.0)}


def test_shares_are_those_of_the_voxels_that_a_map_has() -> None:
    whole = plate(0)[1]
    half = whole[whole[:, 1] < 1.0]  # up to 0.2 m from it counts as well: 6 columns of 10
    meter = change.ChangeMeter()
    meter.measure(visit({}), ground())
    (new,) = meter.measure(visit({1: 0}), np.concatenate([ground(), half]))
    assert (new.voxels, new.share) == (100, pytest.approx(0.6))
    # What was not in the map when the object left can't leave it.
    (gone,) = meter.measure(visit({}), cloud())
    assert (gone.change, gone.voxels, gone.share) == ("gone", 60, 0.0)


def test_voxels_that_another_surface_explains_do_not_count() -> None:
    meter = change.ChangeMeter()
    meter.measure(visit({1: 0}), cloud(0))
    scores = meter.measure(visit({2: 0}), cloud(0))  # another object in the same place
    assert scores == []


def test_what_the_sensor_hardly_saw_does_not_count() -> None:
    meter = change.ChangeMeter()
    assert meter.measure(visit({1: 0}, returns=1), cloud()) == []
    assert shares(meter.measure(visit({1: 0}, returns=4), cloud())) == {1: ("stayed", 2, 0.0)}


def test_a_stay_that_was_interrupted_counts_from_its_latest_beginning() -> None:
    sessions = [visit(p).movables for p in ({1: 0, 2: 1}, {2: 1}, {1: 0, 2: 1}, {1: 0})]
    stays = change.latest_stays(sessions)
    assert (stays.ids.tolist(), stays.first.tolist(), stays.last.tolist()) == (
        [1, 2],
        [2, 0],
        [3, 2],
    )


def test_the_whole_map_is_held_to_the_true_surface() -> None:
    truth = visit({1: 0})
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 0, 3] = 0.3
    lifted = cloud() + np.array([0, 0, 0.15])
    score = change.score_map(1, truth, lifted, Trajectory(np.array([0, 1]), poses))
    assert score.trajectory_rmse_m == pytest.approx(0.3)
    assert score.accuracy_mean_m == pytest.approx(0.15, abs=0.01)
    assert score.accuracy_10cm < 0.01
    assert score.accuracy_20cm == 1.0
    plate_share = 100 / (100 + 5000)
    assert score.completeness_20cm == pytest.approx(1 - plate_share, abs=0.01)


def test_what_lies_too_far_from_the_route_for_the_map_to_look_at_does_not_count():
    meter = change.ChangeMeter()
    near, far = 0, 11  # 33 m from the route
    meter.measure(visit({1: near, 2: far}), cloud(near, far))
    scores = meter.measure(visit({}), cloud(far))
    assert shares(scores) == {1: ("gone", 1, 0.0)}


def score(kind: str, what: str, visits: int, share: float) -> Any:
    return change.ObjectScore(1, 1, kind, what, visits, 50, share)


def test_visits_needed_are_those_after_which_the_threshold_holds_for_good() -> None:
    scores = [score("car", "gone", n, s) for n, s in enumerate((0.05, 0.4, 0.1, 0.0), start=1)]
    scores += [score("box", "new", n, s) for n, s in enumerate((0.2, 0.85, 0.9), start=1)]
    assert change.visits_needed(scores, "gone", "car", 0.1) == 3
    assert change.visits_needed(scores, "gone", "car", 0.5) == 1
    assert change.visits_needed(scores, "new", "box", 0.8) == 2
    assert change.visits_needed(scores, "new", "box", 0.95) is None
    assert change.visits_needed(scores, "new", "leaves", 0.1) is None


def test_the_report_states_what_is_needed_beside_the_thresholds() -> None:
    scores = [score("car", "gone", 1, 0.4), score("car", "gone", 1, 0.2)]
    scores += [score("car", "gone", 2, 0.0), score("box", "new", 1, 0.5)]
    assert "0.300 (2)" in seasons.change_table(scores, "gone")
    lines = seasons.needed_table(scores, 0.1, 0.8).splitlines()
    assert "at most 0.1 left" in lines[0]
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in lines[2:]]
    assert cells == [
        ["car", "after 2", "none changed"],
        ["box", "none changed", "not after 1"],
        ["leaves", "none changed", "none changed"],
    ]


def test_a_trajectory_is_laid_on_its_truth() -> None:
    stamps = np.arange(20)
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(3).normal(size=(20, 3))
    T = np.array([[0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 1], [0, 0, 0, 1.0]])
    found = seasons.laid_on(Trajectory(stamps, poses), Trajectory(stamps, T @ poses))
    np.testing.assert_allclose(found, T, atol=1e-12)


def test_the_benchmark_starts_no_map_over_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "seasons.map").write_bytes(b"")
    assert seasons.main(["--out", str(tmp_path)]) == 2
    assert "--measure-only" in capsys.readouterr().err


def test_every_session_goes_into_one_map_file_until_a_run_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def failing(command: list[str], **_: Any) -> Any:
        commands.append(command)
        return subprocess.CompletedProcess(command, 2)

    monkeypatch.setattr(seasons.subprocess, "run", failing)
    assert seasons.main(["--out", str(tmp_path), "seed=3"]) == 2
    (command,) = commands
    assert Path(command[1]).is_file()
    assert set(command[2:]) == {
        "scenario=seasons",
        "scenario.session=1",
        "sensor=vls128",
        "seed=3",
        f"map={tmp_path / 'seasons.map'}",
        f"hydra.run.dir={tmp_path / 'session_1'}",
    }
    assert "this run failed" in capsys.readouterr().err


@pytest.mark.slow
def test_maps_of_the_true_surface_follow_every_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The maps are in a frame of their own, as those of runs are."""
    coarse = ["scenario.azimuth_steps.vls128=4.0", "scenario.speed=40"]
    overrides = [*coarse, f"scenario.cache_dir={tmp_path / 'cache'}"]
    T_map_world = invert(exp(np.array([0.01, -0.02, 2.0, 30.0, -20.0, 1.0])))
    for session in (1, 2):
        choice = ["scenario=seasons", f"scenario.session={session}", "sensor=vls128"]
        config = seasons.compose_config([*choice, *overrides]).scenario
        source = seasons.build(config)
        folder = tmp_path / f"session_{session}"
        points = seasons.read_map(source.surface_path)[::3].astype(np.float64)
        write_ply(folder / "map.ply", transform(T_map_world, points).astype(np.float32))
        truth = source.reference()
        write_tum(folder / "trajectory.tum", Trajectory(truth.stamps, T_map_world @ truth.poses))
    arguments = ["--out", str(tmp_path), "--sessions", "2", "--measure-only", *overrides]
    assert seasons.main(arguments) == 0
    assert (tmp_path / "seasons.md").read_text() == capsys.readouterr().out
    found = json.loads((tmp_path / "seasons.json").read_text())
    assert {(o["change"], o["kind"]) for o in found["objects"]} >= {
        ("gone", "car"), ("gone", "box"), ("gone", "leaves"), ("new", "car"), ("new", "box"),
    }  # fmt: skip
    assert {o["share"] for o in found["objects"] if o["change"] == "gone"} == {0.0}
    assert min(o["share"] for o in found["objects"] if o["change"] == "new") > 0.95
    assert found["visits_needed"]["gone"] == {"car": 1, "box": 1, "leaves": 1}
    assert max(m["accuracy_mean_m"] for m in found["maps"]) < 1e-3
    assert min(m["completeness_20cm"] for m in found["maps"]) > 0.98
