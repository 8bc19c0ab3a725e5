"""Routes, motion and the campaigns' configs: no ray is cast here."""

import inspect
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from lifelong_slam.errors import ConfigError
from lifelong_slam.simulation.campaign import Campaign, Segment, make_campaign
from lifelong_slam.simulation.routes import Path
from lifelong_slam.simulation.source import SimulatedSource
from lifelong_slam.simulation.terrain import Terrain
from lifelong_slam.simulation.worlds import make_route

CONF = FilePath(__file__).parents[1] / "conf" / "scenario"

# Table 3.2: distance in m, speed in m/s, and whether there are dynamic objects.
TABLE = {
    "A": (48.2, 4.8, False),
    "B": (51.8, 4.7, True),
    "C": (58.4, 5.8, True),
    "D": (103.4, 10.3, False),
    "E": (260.5, 8.7, True),
    "F": (261.0, 21.8, True),
}


def scenario(name: str, /, **changes: Any) -> Campaign:
    settings = OmegaConf.to_container(OmegaConf.load(CONF / f"{name}.yaml"), resolve=False)
    assert isinstance(settings, dict)
    keys = set(inspect.signature(SimulatedSource).parameters)
    assert set(settings) - {"_target_"} <= keys
    for key in ("_target_", "topic", "cache_dir"):
        settings.pop(key)
    if name == "loop":
        settings["rig"] = ["vls128"]
    return make_campaign(**{**settings, **changes})


def driven(campaign: Campaign) -> tuple[np.ndarray, np.ndarray]:
    """Return times at 100 Hz and poses."""
    _, _, motion = make_route(campaign)
    t = np.arange(0, motion.duration + 1e-9, 0.01)
    return t, motion.poses(t)


def turned(poses: np.ndarray) -> np.ndarray:
    """Return the heading over time in degrees, starting at zero."""
    yaw = np.degrees(np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])))
    return yaw - yaw[0]


@pytest.mark.parametrize("name", TABLE)
def test_distance_and_speed_are_those_of_table_3_2(name: str) -> None:
    distance, speed, dynamic = TABLE[name]
    campaign = scenario(name)
    t, poses = driven(campaign)
    length = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert length == pytest.approx(distance, rel=0.005)
    assert length / t[-1] == pytest.approx(speed, rel=0.005)
    assert bool(campaign.traffic) == dynamic


@pytest.mark.parametrize("name", TABLE)
def test_the_car_is_at_full_speed_from_the_start(name: str) -> None:
    _, speed, _ = TABLE[name]
    _, poses = driven(scenario(name))
    pace = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / 0.01
    assert pace[0] > 0.8 * speed
    assert pace.max() < 1.25 * speed
    assert pace.min() > 0.7 * speed


def test_turns_are_those_of_section_3_4() -> None:
    a, b, c, d, e, f = (turned(driven(scenario(name))[1]) for name in "ABCDEF")
    assert a.max() > 60
    assert a[-1] < a.max() - 55
    assert b[-1] == pytest.approx(-90, abs=3)
    for straight in (c, d, f):
        assert np.abs(straight).max() < 8
    # E: right, then a turn and its counter-curve.
    lowest = np.argmax(e < -90)
    middle = e[lowest:].max()
    assert middle > e[lowest] + 30
    assert e[-1] < middle - 30


def test_moving_road_users_are_those_of_section_3_4() -> None:
    kinds = {n: {(s.kind, s.direction) for s in scenario(n).traffic} for n in "ABCDEF"}
    assert kinds["A"] == kinds["D"] == set()
    assert ("car", "opposite") in kinds["B"]
    assert {("cyclist", "same"), ("car", "opposite")} <= kinds["C"]
    assert {("car", "opposite"), ("truck", "opposite")} <= kinds["F"]
    assert kinds["E"]
    assert {n: scenario(n).crosstalk for n in "ABCDEF" if scenario(n).crosstalk} == {
        "E": {"bosch": pytest.approx(0.01)}
    }


def test_in_scenario_c_the_car_passes_the_cyclists() -> None:
    campaign = scenario("C")
    stream = next(s for s in campaign.traffic if s.kind == "cyclist")
    assert 0 < stream.first < campaign.distance - stream.speed * campaign.duration


def test_a_lap_of_the_loop_is_long_and_closes() -> None:
    campaign = scenario("loop")
    path, _, _ = make_route(campaign)
    assert path.length >= 400
    np.testing.assert_allclose(path.point(np.array([0.0])), path.point([path.length]), atol=1e-9)
    turns = path.heading(np.array([path.length - 1e-6])) - path.heading(np.array([0.0]))
    np.testing.assert_allclose(turns, 2 * np.pi, atol=1e-6)


def test_later_laps_retrace_the_first_within_decimetres() -> None:
    campaign = scenario("loop", laps=3)
    t, poses = driven(campaign)
    xy = poses[:, :2, 3]
    first, second = xy[t < t[-1] / 3], xy[(t > t[-1] / 3) & (t < t[-1] * 2 / 3)]
    nearest = np.array([np.linalg.norm(first - p, axis=1).min() for p in second[::20]])
    assert nearest.max() < 1.0
    assert 0.05 < nearest.mean() < 0.5


def test_motion_is_smooth_and_velocities_are_its_derivative() -> None:
    _, _, motion = make_route(scenario("A"))
    t = np.linspace(0.1, motion.duration - 0.1, 400)
    step = 1e-4
    before, after, poses = (motion.poses(t + d) for d in (-step, step, 0.0))
    linear, angular = motion.velocities(t)
    R = poses[:, :3, :3]
    moved = np.einsum("nji,nj->ni", R, (after - before)[:, :3, 3]) / (2 * step)
    np.testing.assert_allclose(linear, moved, atol=1e-5)
    spin = np.einsum("nji,njk->nik", R, (after - before)[:, :3, :3]) / (2 * step)
    turning = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    np.testing.assert_allclose(angular, turning, atol=1e-5)


def test_the_slope_of_the_land_is_its_height_s_derivative() -> None:
    terrain = Terrain(np.random.default_rng(1), slope=0.02)
    xy = np.random.default_rng(2).uniform(-300, 300, (200, 2))
    step = 1e-4
    numeric = np.stack(
        [(terrain.height(xy + d) - terrain.height(xy - d)) / (2 * step) for d in np.eye(2) * step],
        axis=1,
    )
    np.testing.assert_allclose(terrain.gradient(xy), numeric, atol=1e-6)
    assert terrain.height(np.zeros((1, 2)))[0] == pytest.approx(0)
    assert terrain.gradient(xy).std() == pytest.approx(0.02, rel=0.3)


def test_a_path_turns_as_much_as_its_segments_say() -> None:
    segments = [
        Segment(straight=10),
        Segment(turn=90, radius=12, ramp=4),
        Segment(turn=-30, radius=20, ramp=3),
    ]
    path = Path(segments, before=5, after=7)
    assert path.length == pytest.approx(sum(segment.length for segment in segments))
    assert np.degrees(path.heading(np.array([path.end]))[0]) == pytest.approx(60)
    s = np.linspace(path.start, path.end, 5001)
    lengths = np.linalg.norm(np.diff(path.point(s), axis=0), axis=1)
    assert lengths.sum() == pytest.approx(path.end - path.start, rel=1e-6)
    np.testing.assert_allclose(path.point(np.array([0.0])), 0, atol=1e-9)


def test_projection_undoes_the_lateral_offset() -> None:
    path = Path([Segment(straight=10), Segment(turn=45, radius=30)], before=5, after=20)
    s = np.linspace(0, 40, 50)
    along, lateral, rest = path.project(path.point(s, 3.0))
    np.testing.assert_allclose(lateral, 3.0, atol=0.01)
    np.testing.assert_allclose(along, s, atol=0.5)
    assert np.abs(rest).max() < 0.5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distance": 60.0}, "the route is 48.2"),
        ({"laps": 2}, "closed"),
        ({"rig": ["bosh"]}, "Did you mean 'bosch'"),
        ({"azimuth_steps": {"bosch": -1}}, "must be positive"),
        ({"route": [{"straight": 48.2, "turn": 3}]}, "scenario.route.0"),
        ({"route": [{"strait": 48.2}]}, "strait"),
        ({"route": [{"turn": 5, "radius": 10}]}, "too short"),
        ({"traffic": [{"kind": "tram"}]}, "scenario.traffic.0.kind"),
        ({"crosstalk": {"bosch": 2.0}}, "scenario.crosstalk.bosch"),
        ({"kind": "city"}, "scenario.kind"),
        ({"name": "../A"}, "scenario.name"),
    ],
)
def test_a_wrong_setting_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scenario("A", **changes)


def test_the_digest_follows_the_content() -> None:
    assert scenario("A").digest() == scenario("A").digest()
    assert scenario("A").digest() != scenario("A", seed=1).digest()
    assert scenario("A").digest() != scenario("B").digest()
