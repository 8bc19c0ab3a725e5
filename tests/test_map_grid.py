"""Occupancy grids: obstacles, what is known to be free, and the files that map_server reads."""

import numpy as np
import pytest
import yaml
from PIL import Image

from lifelong_slam.errors import MapError
from lifelong_slam.io.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, write_grid
from lifelong_slam.mapping.occupancy import occupancy_grid


def plane(x, y, step=0.1):
    """Points on level ground between two corners."""
    columns = np.meshgrid(np.arange(*x, step), np.arange(*y, step))
    return np.stack([columns[0], columns[1], np.zeros_like(columns[0])], axis=-1).reshape(-1, 3)


def wall(start, end, bottom=0.0, top=3.0, step=0.1):
    """Points on an upright wall between two places."""
    start, end = np.array(start, float), np.array(end, float)
    along = np.arange(0, np.linalg.norm(end - start) + step / 2, step) / np.linalg.norm(end - start)
    along, heights = np.meshgrid(along, np.arange(bottom, top, step))
    xy = start + along.reshape(-1, 1) * (end - start)
    return np.column_stack([xy, heights.ravel()])


def grid_of(*parts, sensors=((0.0, 0.0, 1.8),), slope=(0.0, 0.0), resolution=0.2):
    """Make the grid of points on ground with a slope along x and y."""
    points, sensors = np.vstack(parts), np.array(sensors)
    for places in (points, sensors):
        places[:, 2] += places[:, :2] @ slope
    return occupancy_grid(points.astype(np.float32), sensors, resolution)


def state(grid, x, y):
    column, row = np.floor((np.array([x, y]) - grid.origin) / grid.resolution + 1e-6).astype(int)
    return grid.cells[row, column]


def room():
    """A room of 16 m x 12 m around the origin, walls at odd multiples of 0.05 m."""
    corners = [(-8.05, -6.05), (8.05, -6.05), (8.05, 6.05), (-8.05, 6.05)]
    walls = [wall(corners[i - 1], corners[i]) for i in range(4)]
    return [plane((-8, 8), (-6, 6)), *walls]


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.2, 0.0), (-0.15, 0.15)])
def test_a_room_is_free_within_occupied_walls_on_any_slope(slope):
    grid = grid_of(*room(), slope=slope)
    inside = grid.cells[3:-3, 3:-3]
    assert np.mean(inside == FREE) > 0.99
    assert not np.any(inside == OCCUPIED)
    edge = np.concatenate([grid.cells[0], grid.cells[-1], grid.cells[:, 0], grid.cells[:, -1]])
    assert np.all(edge == OCCUPIED)


def test_what_lies_behind_an_obstacle_is_unknown():
    grid = grid_of(
        plane((-10, 10), (-10, 10)), wall((4.05, -2), (4.05, 2)), wall((7.05, -3), (7.05, 3))
    )
    assert state(grid, 4.05, 0.0) == OCCUPIED
    assert state(grid, 3.5, 0.0) == FREE
    assert state(grid, 5.5, 0.0) == UNKNOWN
    assert state(grid, 7.05, 0.0) == OCCUPIED  # it was measured, if from elsewhere
    assert state(grid, 8.5, 0.0) == UNKNOWN
    assert state(grid, 5.5, 6.0) == FREE


def test_another_place_of_the_sensor_sees_behind_it():
    parts = plane((-10, 10), (-10, 10)), wall((4.05, -2), (4.05, 2))
    assert state(grid_of(*parts), 6.0, 0.0) == UNKNOWN
    both = grid_of(*parts, sensors=((0.0, 0.0, 1.8), (8.0, 0.0, 1.8)))
    assert state(both, 6.0, 0.0) == FREE


def test_where_nothing_was_seen_is_unknown():
    grid = grid_of(plane((-5, 5), (-5, 5)), wall((20.05, 14), (20.05, 15)))
    assert state(grid, 4.0, 4.0) == FREE
    assert state(grid, 10.0, 0.0) == UNKNOWN
    assert state(grid, 12.0, -4.5) == UNKNOWN


def test_kerbs_are_crossed_and_bridges_driven_under():
    kerb = wall((2.05, -4), (2.05, 4), top=0.15)
    bridge = plane((-4, -2), (-5, 5)) + np.array([0, 0, 4.0])
    grid = grid_of(plane((-5, 5), (-5, 5)), kerb, bridge)
    assert not np.any(grid.cells == OCCUPIED)
    assert state(grid, 4.0, 0.0) == state(grid, -4.0, 0.0) == FREE


def test_a_facade_seen_only_above_a_fence_is_not_taken_for_ground():
    facade = wall((9.05, -5), (9.05, 5), bottom=2.5, top=8.0)
    grid = grid_of(plane((-6, 6), (-5, 5)), facade)
    assert state(grid, 5.0, 0.0) == FREE
    assert not np.any(grid.cells == OCCUPIED)


def test_rays_do_not_slip_through_gaps_between_points():
    dotted = np.vstack([wall((3.05, y), (3.06, y)) for y in np.arange(-6.1, 6.2, 0.4)])
    grid = grid_of(plane((-8, 8), (-6, 6)), dotted)
    assert state(grid, 5.0, 0.0) == UNKNOWN
    assert state(grid, 2.5, 0.0) == FREE


def test_a_grid_without_points_or_with_too_many_cells_is_refused():
    with pytest.raises(MapError, match="no static points"):
        occupancy_grid(np.zeros((0, 3), np.float32), np.zeros((1, 3)), 0.2)
    with pytest.raises(MapError, match="coarser"):
        grid_of(np.array([[0.0, 0, 0], [9000.0, 9000.0, 0]]), resolution=0.05)


def test_files_say_what_map_server_makes_the_grid_of(tmp_path):
    cells = np.array([[OCCUPIED, FREE, UNKNOWN], [FREE, FREE, OCCUPIED]], np.int8)
    write_grid(tmp_path / "the place.yaml", OccupancyGrid(cells, 0.25, (-3.5, 12.0)))
    settings = yaml.safe_load((tmp_path / "the place.yaml").read_text())
    assert settings["resolution"] == 0.25
    assert settings["origin"] == [-3.5, 12.0, 0.0]
    image = np.asarray(Image.open(tmp_path / settings["image"]))
    occupancy = (255.0 - image) / 255.0  # map_server's, with negate 0
    assert settings["negate"] == 0
    read = np.full(image.shape, UNKNOWN)
    read[occupancy > settings["occupied_thresh"]] = OCCUPIED
    read[occupancy < settings["free_thresh"]] = FREE
    np.testing.assert_array_equal(read[::-1], cells)  # its first row is the highest
    assert {p.name for p in tmp_path.iterdir()} == {"the place.yaml", "the place.pgm"}
