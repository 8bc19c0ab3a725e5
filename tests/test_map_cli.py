"""scripts/map.py as a user meets it: what is in a map, what it writes, and one line for what is wrong."""

import json
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import yaml
from map_support import T_BASE_SENSOR, covariance, new_map
from PIL import Image

import map as map_script
from lifelong_slam.geometry import exp, invert, transform
from lifelong_slam.io.g2o import read_g2o
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.mapping.saved_map import MapUpdate, Scans
from lifelong_slam.mapping.static_map import StaticMap
from lifelong_slam.mapping.store import MapStore
from lifelong_slam.result import Edge
from lifelong_slam.sources.cloud_files import read_cloud
from lifelong_slam.trajectory import read_tum

ROOT = Path(__file__).parent.parent
START = 1_700_000_000_000_000_000
STEP = 2.0  # metres between keyframes
SCANS = 4  # for each of them, at 10 Hz
LENGTH, WIDTH, HEIGHT = 20.0, 6.0, 2.5  # metres of the corridor, which begins 5 m behind the start


def corridor():
    """Points on floor and walls, in the frame of the base at the start, on the floor."""
    along = np.arange(-5.0, LENGTH - 5.0, 0.1)
    x, y = np.meshgrid(along, np.arange(-WIDTH / 2, WIDTH / 2, 0.1))
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    x, z = np.meshgrid(along, np.arange(0.0, HEIGHT, 0.1))
    left = np.column_stack([x.ravel(), np.full(x.size, WIDTH / 2), z.ravel()])
    return np.vstack([floor, left, left * [1, -1, 1]])


def of_sensor(T_map_base):
    """The pose as the store has it: of the sensor, in a map that begins with the sensor's frame."""
    return invert(T_BASE_SENSOR) @ T_map_base @ T_BASE_SENSOR


def straight(distance):
    return of_sensor(exp(np.array([0.0, 0.0, 0.0, distance, 0.0, 0.0])))


def seen_from(pose):
    return transform(invert(T_BASE_SENSOR @ pose), corridor()).astype(np.float32)


def drive_along(store, session, first, count):
    """Add a drive down the corridor; what the first half of its keyframes saw is settled."""
    static_map = StaticMap(0.2)
    poses = {first + i: straight(i * STEP) for i in range(count)}
    for i, (vertex, pose) in enumerate(poses.items()):
        rng = np.random.default_rng(vertex)
        cloud = seen_from(pose)
        distance = np.linalg.norm(cloud, axis=1)
        stamps = START + (session * 10_000 + i * SCANS + np.arange(SCANS)) * 100_000_000
        step = np.stack([straight(STEP * k / SCANS) for k in range(SCANS)])
        keyframe = Keyframe(
            id=vertex,
            session=session,
            stamp=int(stamps[0]),
            T_odom_sensor=pose,
            covariance=covariance(rng),
            travelled=i * STEP,
            features=cloud[::50],
            points=cloud[distance < 8.0],
        )
        odometry = Edge(vertex - 1, vertex, straight(STEP), covariance(rng), "odometry")
        store.write(
            MapUpdate(
                keyframes=[keyframe],
                poses={vertex: pose},
                edges={vertex: odometry} if i else {},
                scans=[Scans(session, vertex, stamps, step)],
            )
        )
        if i < count // 2:
            owners = {v: poses[v] for v in range(first, vertex + 1)}
            static_map.settle([keyframe], [pose], owners)
            arrays = {v: static_map.submaps[v].arrays() for v in static_map.take_changed()}
            store.write(MapUpdate(settled=[vertex], submaps=arrays))


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A map of two sessions, the second of which is not located."""
    path = tmp_path_factory.mktemp("map") / "corridor.map"
    with MapStore.create(path, "hdl64", T_BASE_SENSOR, 0.2) as store:
        drive_along(store, store.begin_session("first", "seed: 1\n"), 0, 6)
        store.end_session(0)
        drive_along(store, store.begin_session("second", "seed: 1\n"), 6, 3)
    return path


@pytest.fixture
def cli(capsys, monkeypatch):
    """Run scripts/map.py's main; return its status, stdout and stderr."""
    monkeypatch.setenv("COLUMNS", "120")

    def call(*arguments):
        try:
            status = map_script.main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return call


def test_info_tells_what_is_in_the_map(cli, saved):
    status, out, err = cli("info", saved, "--json")
    assert (status, err) == (0, "")
    facts = json.loads(out)
    first, second = facts["sessions"]
    assert (first["source"], first["finished"], first["located"]) == ("first", True, True)
    assert (second["source"], second["finished"], second["located"]) == ("second", False, False)
    assert (first["scans"], second["scans"], facts["scans"]) == (24, 12, 36)
    assert (first["vertices"], second["vertices"], facts["vertices"]) == (6, 3, 9)
    assert first["path_length_m"] == pytest.approx(5 * STEP + STEP * 3 / 4)
    assert first["duration_s"] == pytest.approx(2.3)
    assert facts["edges"] == {"odometry": 7, "loop": 0, "composed": 0, "rejected": 0}
    assert facts["size_bytes"] == saved.stat().st_size
    low, high = np.array(facts["extent_m"])
    np.testing.assert_allclose(low[1:], [-WIDTH / 2, 0.0], atol=0.1)
    np.testing.assert_allclose(high[1:], [WIDTH / 2, HEIGHT], atol=0.15)


def test_info_is_a_table_for_people(cli, saved):
    status, out, _ = cli("info", saved)
    assert status == 0
    lines = {line.split("  ")[0]: line for line in out.splitlines()}
    assert "7 odometry, 0 loop, 0 composed, 0 rejected" in lines["Edges"]
    assert "9 vertices" in lines["Pose graph"]
    assert "not finished, not located" in out


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_points_are_those_of_the_corridor_in_the_frame_of_the_base(cli, saved, tmp_path, suffix):
    status, out, err = cli("export", saved, "--out", tmp_path / f"map.{suffix}")
    assert status == 0
    assert out == f"Written: {tmp_path / f'map.{suffix}'}\n"
    assert "not located in the map are left out: [1]" in err
    points = read_cloud(tmp_path / f"map.{suffix}").points
    on_floor = np.abs(points[:, 2]) < 0.06
    on_wall = np.abs(np.abs(points[:, 1]) - WIDTH / 2) < 0.06
    assert np.mean(on_floor | on_wall) > 0.95  # means of voxels at edges lie off both
    assert points[:, 0].max() > 5 * STEP + 4  # seen from the last keyframe, which is not settled
    assert len(points) > 0.5 * (17 / 0.2) * (WIDTH + 2 * HEIGHT) / 0.2


def test_one_session_can_be_written_alone(cli, saved, tmp_path):
    status, _, err = cli("export", saved, "--out", tmp_path / "map.ply", "--session", 1)
    assert (status, err) == (0, "")
    assert read_cloud(tmp_path / "map.ply").points[:, 0].max() < 2 * STEP + 9.5
    cli("export", saved, "--out", tmp_path / "one.tum", "--session", 1)
    assert len(read_tum(tmp_path / "one.tum")) == 12


def test_trajectory_and_graph_are_of_the_base(cli, saved, tmp_path):
    assert cli("export", saved, "--out", tmp_path / "path.tum")[0] == 0
    trajectory = read_tum(tmp_path / "path.tum")
    assert trajectory.stamps[0] == START
    expected = np.column_stack([np.arange(24) * STEP / SCANS, np.zeros((24, 2))])
    np.testing.assert_allclose(trajectory.positions, expected, atol=1e-9)
    assert cli("export", saved, "--out", tmp_path / "graph.g2o")[0] == 0
    graph = read_g2o(tmp_path / "graph.g2o")
    assert sorted(graph.poses) == list(range(6))
    np.testing.assert_allclose(graph.poses[3][:3, 3], [3 * STEP, 0, 0], atol=1e-9)
    assert [edge.kind for edge in graph.edges] == ["odometry"] * 5


def test_the_grid_shows_the_corridor(cli, saved, tmp_path):
    assert cli("export", saved, "--out", tmp_path / "grid.yaml", "--resolution", 0.25)[0] == 0
    settings = yaml.safe_load((tmp_path / "grid.yaml").read_text())
    image = np.asarray(Image.open(tmp_path / settings["image"]))[::-1]
    assert settings["resolution"] == 0.25

    def grey(x, y):
        column, row = np.floor((np.array([x, y]) - settings["origin"][:2]) / 0.25).astype(int)
        return image[row, column]

    for x in (-1.0, 4.0, 9.0):
        assert grey(x, 0.0) == 254
        assert min(grey(x, WIDTH / 2 - 0.1), grey(x, WIDTH / 2 + 0.1)) == 0
        assert min(grey(x, -WIDTH / 2 - 0.1), grey(x, -WIDTH / 2 + 0.1)) == 0


def test_check_says_that_a_map_is_sound(cli, saved):
    assert cli("check", saved) == (0, "No problems found.\n", "")


def test_check_lists_problems(cli, tmp_path):
    new_map(tmp_path / "place.map")
    with closing(sqlite3.connect(tmp_path / "place.map")) as db, db:
        db.execute("UPDATE edges SET covariance = x'00'")
    status, out, err = cli("check", tmp_path / "place.map")
    assert (status, err) == (1, "")
    assert out.splitlines() == [
        f"edges {i}, covariance: the checksum is wrong" for i in range(1, 5)
    ]


@pytest.mark.parametrize("command", ["info", "check"])
@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "no such map"), (b"", "not a map"), (b"ply\n" * 99, "place.map")],
)
def test_what_is_no_map_is_one_line(cli, tmp_path, command, content, message):
    path = tmp_path / "place.map"
    if content is not None:
        path.write_bytes(content)
    status, out, err = cli(command, path)
    assert (status, out) == (2, "")
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "map.xyz"], "must end with .ply, .pcd, .g2o, .tum, .yaml"),
        (["--out", "map.ply", "--session", "7"], "no session 7"),
        (["--out", "map.yaml", "--resolution", "0"], "between 0.01 and 10 m, not 0"),
        (["--out", "map.yaml", "--resolution", "fine"], "cell_size value: 'fine'"),
        ([], "--out"),
    ],
)
def test_what_cannot_be_written_is_refused(cli, saved, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    status, _, err = cli("export", saved, *arguments)
    assert status == 2
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_it_runs_as_a_script():
    command = [sys.executable, str(ROOT / "scripts" / "map.py"), "export", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    for word in (".ply", ".pcd", ".g2o", ".tum", ".yaml", "--session", "--resolution"):
        assert word in done.stdout
