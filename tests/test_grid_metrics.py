"""Occupancy grids from map_server's files, and the map error of paper 001."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import cdist

from eval.errors import EvidenceError, FileError
from eval.evidence import Evidence
from eval.grid import Grid, read_grid
from eval.metrics.grid import GridError
from eval.testing import check_metric
from lifelong_slam.io.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, write_grid

SETTINGS = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": [0.0, 0.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write(folder, grey, kind="P5", header="\n# CREATOR: map_saver.cpp 0.050 m/pix\n", **settings):
    grey = np.asarray(grey, dtype=np.uint8)
    height, width = grey.shape
    body = grey.tobytes() if kind == "P5" else " ".join(map(str, grey.ravel())).encode() + b"\n"
    (folder / "map.pgm").write_bytes(f"{kind}{header}{width} {height}\n255\n".encode() + body)
    (folder / "map.yaml").write_text(yaml.safe_dump(SETTINGS | settings))
    return folder / "map.yaml"


def grid(occupied, resolution=0.05, origin=(0.0, 0.0, 0.0)):
    occupied = np.asarray(occupied, dtype=bool)
    return Grid(occupied, np.ones_like(occupied), resolution, np.array(origin, dtype=float))


def measure(estimated, true):
    return GridError().measure(Evidence(grid=estimated, reference_grid=true))


# Files


@pytest.mark.parametrize("kind", ["P5", "P2"])
@pytest.mark.parametrize("header", ["\n", "\n# 1 2 3\n", " \t", "\n#\n# a\n"])
def test_images_are_read_from_the_bottom(tmp_path, kind, header):
    read = read_grid(write(tmp_path, [[0, 254, 205], [254, 254, 205]], kind, header))
    np.testing.assert_array_equal(read.occupied, [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(read.known, [[1, 1, 0], [1, 1, 0]])
    assert read.resolution == 0.05


@pytest.mark.parametrize(
    ("settings", "occupied", "known"),
    [
        ({}, [1, 1, 0, 0, 0], [1, 1, 0, 0, 1]),
        ({"mode": "trinary"}, [1, 1, 0, 0, 0], [1, 1, 0, 0, 1]),
        ({"mode": "scale"}, [1, 1, 0, 0, 0], [1, 1, 1, 1, 1]),
        ({"negate": 1}, [0, 0, 0, 1, 1], [1, 0, 0, 1, 1]),
        ({"mode": "raw"}, [0, 1, 0, 0, 0], [1, 1, 0, 0, 0]),
        ({"occupied_thresh": 0.4, "free_thresh": 0.3}, [1, 1, 1, 0, 0], [1, 1, 1, 1, 1]),
    ],
)
def test_grey_becomes_occupancy_as_in_map_server(tmp_path, settings, occupied, known):
    # Occupancies 1, 0.69, 0.5, 0.2 and 0.004; negated the other way.
    read = read_grid(write(tmp_path, [[0, 80, 127, 204, 254]], **settings))
    np.testing.assert_array_equal(read.occupied[0], occupied)
    np.testing.assert_array_equal(read.known[0], known)


def test_our_own_grids_come_back(tmp_path):
    cells = np.random.default_rng(0).choice([OCCUPIED, FREE, UNKNOWN], size=(7, 11)).astype(np.int8)
    write_grid(tmp_path / "block.yaml", OccupancyGrid(cells, 0.2, (-3.4, 12.6)))
    read = read_grid(tmp_path / "block.yaml")
    np.testing.assert_array_equal(read.occupied, cells == OCCUPIED)
    np.testing.assert_array_equal(read.known, cells != UNKNOWN)
    np.testing.assert_array_equal(read.origin, [-3.4, 12.6, 0.0])
    assert read.resolution == 0.2


def test_the_image_may_be_at_an_absolute_path(tmp_path):
    elsewhere = tmp_path / "maps"
    elsewhere.mkdir()
    write(elsewhere, [[0]])
    path = write(tmp_path, [[254]], image=str(elsewhere / "map.pgm"))
    assert read_grid(path).occupied.all()


def test_occupied_points_are_the_centres_of_cells():
    found = grid([[0, 0, 0], [0, 0, 1]], 0.5, (10.0, 20.0, 0.0)).occupied_points()
    np.testing.assert_allclose(found, [[11.25, 20.75]])


def test_yaw_turns_the_grid_about_its_corner():
    found = grid([[0, 0, 0], [0, 0, 1]], 0.5, (10.0, 20.0, np.pi / 2)).occupied_points()
    np.testing.assert_allclose(found, [[10 - 0.75, 20 + 1.25]])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"resolution": 0.0}, "resolution must be above 0"),
        ({"resolution": "fine"}, "resolution: "),
        ({"origin": [0.0, 0.0]}, r"origin\.2: "),
        ({"origin": [float("nan"), 0.0, 0.0]}, "origin finite"),
        ({"mode": "colour"}, "mode: "),
        ({"image": "other.pgm"}, "no such grid image"),
    ],
)
def test_settings_without_sense_are_refused(tmp_path, settings, message):
    with pytest.raises(FileError, match=message):
        read_grid(write(tmp_path, [[0]], **settings))


@pytest.mark.parametrize(
    "text", ["", "- 1\n- 2\n", "image: map.pgm\n", "a: [1", "\x00", "!!python/name:os.system"]
)
def test_files_that_describe_no_grid_are_refused(tmp_path, text):
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(FileError, match=r"map\.yaml") as caught:
        read_grid(tmp_path / "map.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PGM image"),
        (b"\x89PNG\r\n\x1a\n", "not a PGM image"),
        (b"P6\n1 1\n255\nabc", "not a PGM image"),
        (b"P5\n1 1\n65535\nab", "grey values from 0 to 255"),
        (b"P5\n3 2\n255\nabcde", "3 x 2 grey values"),
        (b"P2\n3 2\n255\n1 2 3 4 5", "3 x 2 grey values"),
        (b"P2\n1 1\n255\nx", "1 x 1 grey values"),
        (b"P2\n1 1\n255\n256", "1 x 1 grey values"),
        (b"P5\n99999999 99999999\n255\nabc", "grey values"),
    ],
)
def test_images_that_are_no_whole_pgm_are_refused(tmp_path, content, message):
    path = write(tmp_path, [[0]])
    (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(FileError, match=message):
        read_grid(path)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileError, match="no such grid file"):
        read_grid(tmp_path / "map.yaml")


# The metric


def test_the_metric_keeps_the_contract():
    check_metric(GridError())


def test_a_shifted_wall_is_its_shift_away():
    wall = np.zeros((20, 30))
    wall[10] = 1
    found = measure(grid(np.roll(wall, 3, axis=0)), grid(wall))
    assert found.values == {
        "knn_mean_cm": pytest.approx(15.0),
        "knn_std_cm": pytest.approx(0.0, abs=1e-9),
        "knn_max_cm": pytest.approx(15.0),
        "knn_points": 30,
    }
    assert found.headline == found.values["knn_mean_cm"]


def test_only_what_is_true_is_looked_for():
    wall = np.zeros((20, 30))
    wall[10] = 1
    more = wall.copy()
    more[3] = 1
    assert measure(grid(more), grid(wall)).headline == 0.0
    assert measure(grid(wall), grid(more)).headline == pytest.approx(7 * 5.0 / 2)


def test_grids_of_other_resolution_and_origin_meet_in_the_map():
    # The same wall at x = 1.025 m, from cells of 5 cm and of 2.5 cm shifted by half a cell.
    true = grid(np.eye(1, 40, 20), 0.05, (0.0, 0.0, 0.0))
    estimated = grid(np.eye(1, 10, 4), 0.025, (0.9125, 0.0125, 0.0))
    assert measure(estimated, true).headline == pytest.approx(0.0, abs=1e-9)


masks = arrays(bool, (5, 6)).filter(np.any)


@given(masks, masks, st.floats(0.01, 2.0), st.floats(-3.0, 3.0))
def test_the_error_is_that_of_equation_1_whatever_the_frame(estimated, true, resolution, yaw):
    frame = (3.0, -2.0, yaw)
    found = measure(grid(estimated, resolution, frame), grid(true, resolution, frame)).headline
    cells = [np.argwhere(mask) * resolution for mask in (true, estimated)]
    assert found == pytest.approx(100 * cdist(*cells).min(axis=1).mean(), abs=1e-9)


def test_grids_without_obstacles_are_refused():
    wall, nothing = grid(np.ones((3, 3))), grid(np.zeros((3, 3)))
    with pytest.raises(EvidenceError, match="the grid has no occupied cells"):
        measure(nothing, wall)
    with pytest.raises(EvidenceError, match="the reference grid has no occupied cells"):
        measure(wall, nothing)


def test_grids_kilometres_apart_may_be_of_different_frames():
    (warning,) = measure(grid(np.ones((3, 3)), origin=(2000, 0, 0)), grid(np.ones((3, 3)))).warnings
    assert "2000 m" in warning
    assert measure(grid(np.ones((3, 3))), grid(np.ones((3, 3)))).warnings == ()
