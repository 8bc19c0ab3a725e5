"""Coordinates that aren't in metres are noticed by their ranges, and converted when asked."""

import numpy as np
import pytest
from run_support import scans
from sources_support import CLOUD, START, cloud_message, write_bag

from lifelong_slam.errors import SourceError
from lifelong_slam.runner import run
from lifelong_slam.scan import Scan
from lifelong_slam.sources.bag import BagSource
from lifelong_slam.sources.folder import FolderSource
from lifelong_slam.sources.units import check_units
from lifelong_slam.systems.kiss_icp import KissIcpSystem


def recording(scale=1.0, count=12):
    """Scans of a room of 60 m, its median range being some 25 m, in another unit."""
    return [Scan(s.stamp, scale * s.points) for s in scans(count, visible=500)]


@pytest.mark.parametrize(
    ("scale", "suggestion"),
    [
        (1e3, r"2\d{4} m, 0 % .*: 2\d m if they are in millimetres \(scenario.scale=0.001\)"),
        (1e2, r"2\d m if they are in centimetres \(scenario.scale=0.01\)"),
    ],
)
def test_other_units_are_an_error_that_suggests_them(scale, suggestion):
    with pytest.raises(SourceError, match=suggestion):
        next(check_units(recording(scale), max_range=100.0))


def test_points_in_the_frame_of_a_map_are_no_scans():
    far = [Scan(s.stamp, s.points + np.array([451_234, 5_411_234, 120])) for s in recording()]
    with pytest.raises(SourceError, match=r"5430\d{3} m.*sensor's own frame.*UTM"):
        next(check_units(far, max_range=100.0))


def test_missing_returns_do_not_hide_other_units():
    blind = [Scan(s.stamp, np.vstack([s.points, np.zeros((5000, 3))])) for s in recording(1e3)]
    with pytest.raises(SourceError, match="millimetres"):
        next(check_units(blind, max_range=100.0))


@pytest.mark.parametrize(
    ("scale", "max_range"),
    [(0.012, 100.0), (0.012, 5.0), (1.0, 100.0), (3.0, 100.0), (20.0, 1000.0)],
    ids=["0.3 m", "0.3 m, near only", "25 m", "75 m", "500 m from the air"],
)
def test_good_ranges_pass_without_a_word(scale, max_range, caplog):
    given = recording(scale)
    assert list(check_units(given, max_range)) == given
    assert caplog.text == ""


def test_a_small_room_in_centimetres_is_noticed_though_the_floor_is_in_range():
    floor = [Scan(s.stamp, np.vstack([40.0 * s.points, 2.0 * s.points[:25]])) for s in recording()]
    assert 0 < np.mean(np.linalg.norm(floor[0].points, axis=1) < 100) < 0.1
    with pytest.raises(SourceError, match="if they are in centimetres"):
        next(check_units(floor, max_range=100.0))


def test_most_points_beyond_the_range_are_a_warning(caplog):
    given = recording()
    assert list(check_units(given, max_range=15.0)) == given
    assert len(caplog.records) == 1
    assert "if they are in metres, raise sensor.max_range" in caplog.text


def test_a_recording_of_nothing_is_for_others_to_judge():
    nothing = [Scan(START + i, np.zeros((4, 3))) for i in range(3)]
    assert list(check_units(nothing, 100.0)) == nothing
    assert list(check_units([], 100.0)) == []


def test_scans_are_passed_on_as_they_come_once_one_has_points_in_range():
    far, near = recording(1e3), recording()
    given = iter([*far[:4], *near, *far])
    checked = check_units(given, 100.0)
    assert next(checked) is far[0]
    assert next(given) is near[1]  # so that the first scan waits for no more than it must


def test_a_run_ends_before_its_first_scan():
    system = KissIcpSystem(min_range=1.0, max_range=100.0, voxel_size=1.0, threads=1)
    with pytest.raises(SourceError, match="millimetres"):
        run(recording(1e3), system, max_range=100.0)


@pytest.mark.parametrize("scale", [0.001, 0.3048])
def test_sources_convert_by_the_scale_given(tmp_path, scale):
    points = np.random.default_rng(0).normal(scale=9, size=(50, 3)).astype(np.float32)
    message = cloud_message(dict(zip("xyz", points.T.copy(), strict=True)))
    bag = write_bag(tmp_path, "db3", [("/lidar", CLOUD, START, message)])
    (tmp_path / "scans").mkdir()
    np.column_stack([points, np.ones(50, np.float32)]).tofile(tmp_path / "scans" / "0.bin")
    for source in (
        BagSource(str(bag), scale=scale),
        FolderSource(str(tmp_path / "scans"), scale=scale),
    ):
        (scan,) = list(source)
        np.testing.assert_allclose(scan.points, scale * points.astype(np.float64))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.inf, np.nan])
def test_a_scale_that_makes_no_sense(tmp_path, scale):
    np.ones((5, 4), np.float32).tofile(tmp_path / "0.bin")
    with pytest.raises(SourceError, match="scale must be positive"):
        FolderSource(str(tmp_path), scale=scale)
