"""A place that changes between sessions: its worlds, its recordings and their truth."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from omegaconf import OmegaConf

from lifelong_slam.errors import ConfigError, SourceError
from lifelong_slam.simulation.campaign import Campaign, make_campaign
from lifelong_slam.simulation.mesh import merge
from lifelong_slam.simulation.movables import read_movables
from lifelong_slam.simulation.returns import Label
from lifelong_slam.simulation.seasons import Movable, layers_of_leaves, occupancy
from lifelong_slam.simulation.sensors import make_sensor
from lifelong_slam.simulation.source import SimulatedSource, ensure_recorded
from lifelong_slam.simulation.truth import read_labels
from lifelong_slam.simulation.worlds import World, make_route, make_world

CONF = Path(__file__).parents[1] / "conf" / "scenario"
# Of the recordings that existed before there were sessions, made by version 8 of the simulation.
DIGESTS = {
    "A": "725ca32d1ce4", "B": "20fd6faab1a4", "C": "db1dbc293644", "D": "910dbeb254d4",
    "E": "aed28bc2f526", "F": "f66e7ba41388", "loop": "3b0caeef4b8a",
}  # fmt: skip
KINDS = ("car", "box", "leaves")
COARSE = {"azimuth_steps": {"vls128": 6.0}, "speed": 40.0}


def settings(name: str, **changes: Any) -> dict[str, Any]:
    plain = OmegaConf.to_container(OmegaConf.load(CONF / f"{name}.yaml"), resolve=False)
    assert isinstance(plain, dict)
    for key in ("_target_", "topic", "cache_dir"):
        plain.pop(key)
    rig = {"rig": ["vls128"]} if name in ("loop", "seasons") else {}
    return {**plain, **rig, **changes}


def campaign(session: int, **changes: Any) -> Campaign:
    return make_campaign(**settings("seasons", session=session, **changes))


@pytest.fixture(scope="module")
def worlds() -> dict[int, World]:
    return {session: make_world(campaign(session)) for session in (1, 2, 3)}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[int, SimulatedSource]:
    cache = str(tmp_path_factory.mktemp("campaigns"))
    topic = make_sensor("vls128").topic
    return {
        session: SimulatedSource(
            topic=topic, cache_dir=cache, **settings("seasons", session=session, **COARSE)
        )
        for session in (1, 2)
    }


def by_id(world: World) -> dict[int, Movable]:
    return {movable.id: movable for movable in world.movables}


def fixed(world: World) -> np.ndarray:
    """Return the triangles of all that stays."""
    movable = sum(len(m.mesh) for m in world.movables)
    return world.static.triangles[: len(world.static) - movable]


@pytest.mark.parametrize("name", DIGESTS)
def test_recordings_from_before_there_were_sessions_are_still_found(name: str) -> None:
    assert make_campaign(**settings(name)).digest() == DIGESTS[name]


def test_each_session_has_a_recording_of_its_own() -> None:
    digests = {campaign(session).digest() for session in (1, 2, 3)}
    assert len(digests | {campaign(2, start_shift=0.0).digest()}) == 4


def test_what_stays_is_the_same_in_every_session(worlds: dict[int, World]) -> None:
    for session in (2, 3):
        np.testing.assert_array_equal(fixed(worlds[1]), fixed(worlds[session]))


def test_objects_that_stay_are_where_they_were_and_others_come_and_go(
    worlds: dict[int, World],
) -> None:
    for before, after in ((1, 2), (2, 3)):
        old, new = by_id(worlds[before]), by_id(worlds[after])
        for number in old.keys() & new.keys():
            np.testing.assert_array_equal(old[number].mesh.triangles, new[number].mesh.triangles)
        assert {old[i].kind for i in old.keys() - new.keys()} == set(KINDS)
        assert {new[i].kind for i in new.keys() - old.keys()} >= {"car", "box"}
        assert {new[i].kind for i in new.keys() & old.keys()} >= {"car", "box"}


def test_objects_are_the_last_triangles_of_the_world(worlds: dict[int, World]) -> None:
    world = worlds[2]
    np.testing.assert_array_equal(
        world.static.triangles[len(fixed(world)) :],
        merge(m.mesh for m in world.movables).triangles,
    )
    assert len(by_id(world)) == len(world.movables)


def test_an_occupant_stays_until_it_leaves_and_shares_stay_level() -> None:
    walks = [occupancy(4000, k, np.random.default_rng(1)) for k in range(1, 9)]
    for k, (before, now) in enumerate(pairwise(walks), start=2):
        assert np.all((now == before) | (now == 0) | (now == k))
        kept = np.mean(now[before > 0] == before[before > 0])
        assert kept == pytest.approx(0.6, abs=0.04)
    assert [np.mean(walk > 0) for walk in walks] == pytest.approx([0.6] * 8, abs=0.04)


def test_crowns_thin_out_and_grow_back() -> None:
    crowns = np.array([layers_of_leaves(200, k, np.random.default_rng(2)) for k in range(1, 10)])
    assert set(np.abs(np.diff(crowns, axis=0)).ravel()) == {1}
    assert crowns.min() == 0
    assert crowns.max() == 2
    np.testing.assert_array_equal(crowns[0], crowns[4])


def test_a_thinned_crown_has_fewer_of_the_same_leaves(worlds: dict[int, World]) -> None:
    leaves = {k: [m for m in w.movables if m.kind == "leaves"] for k, w in worlds.items()}
    count = {k: sum(len(m.mesh) for m in part) for k, part in leaves.items()}
    full_trees = {m.id // 2 for m in leaves[1] if m.id % 2}
    lower = sum(len(m.mesh) for m in leaves[1] if m.id // 2 in full_trees and m.id % 2 == 0)
    upper = sum(len(m.mesh) for m in leaves[1] if m.id // 2 in full_trees and m.id % 2)
    assert lower / (lower + upper) == pytest.approx(0.4, abs=0.02)
    assert count[1] > count[2] > count[3]


def test_sessions_start_a_shift_apart_and_are_driven_differently() -> None:
    starts, motions = [], []
    for session in (1, 2):
        path, _, motion = make_route(campaign(session, wobble=0.0))
        expected = path.point(np.array([30.0 * (session - 1)]))[0]
        np.testing.assert_allclose(motion.poses(np.zeros(1))[0, :2, 3], expected, atol=1e-3)
        same = make_route(campaign(session, start_shift=0.0))[2]
        starts.append(same.poses(np.zeros(1))[0, :2, 3])
        motions.append(same.poses(np.linspace(0, 30, 100)))
    assert np.linalg.norm(starts[0] - starts[1]) < 1.0
    assert 0.05 < np.abs(motions[0] - motions[1])[:, :2, 3].max() < 5.0


def test_a_session_drives_its_lap_and_the_overlap() -> None:
    path, _, motion = make_route(campaign(1, wobble=0.0))
    poses = motion.poses(np.arange(0, motion.duration, 0.01))
    driven = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum()
    assert driven == pytest.approx(path.length + 15.0, abs=0.2)


@pytest.mark.slow
def test_sessions_follow_each_other_in_time(sources: dict[int, SimulatedSource]) -> None:
    one, two = (sources[k].reference().stamps for k in (1, 2))
    assert two[0] - one[0] == 91 * 86_400 * 10**9
    assert next(iter(sources[2])).stamp == two[0]


@pytest.mark.slow
def test_the_same_seed_and_session_give_the_same_bytes(
    sources: dict[int, SimulatedSource], tmp_path: Path
) -> None:
    again = ensure_recorded(sources[2].campaign, tmp_path)
    names = sorted(path.name for path in again.iterdir())
    assert names == sorted(path.name for path in sources[2].folder.iterdir())
    assert "movable.npz" in names
    for name in names:
        assert (again / name).read_bytes() == (sources[2].folder / name).read_bytes(), name
    bags = [sources[k].folder / "campaign.bag" for k in (1, 2)]
    assert bags[0].read_bytes() != bags[1].read_bytes()


def scene_of(triangles: np.ndarray) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    corners = np.ascontiguousarray(triangles.reshape(-1, 3), np.float32)
    faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor(corners), o3d.core.Tensor(faces))
    return scene


@pytest.mark.slow
def test_seen_spots_lie_on_their_objects(
    sources: dict[int, SimulatedSource], worlds: dict[int, World]
) -> None:
    for session, source in sources.items():
        truth = read_movables(source.folder / "movable.npz")
        objects = by_id(worlds[session])
        assert truth.ids.tolist() == list(objects)
        assert truth.kinds.tolist() == [m.kind for m in objects.values()]
        assert {objects[i].kind for i in truth.objects.tolist()} == set(KINDS)
        for number in np.unique(truth.objects).tolist():
            points = truth.points[truth.objects == number]
            scene = scene_of(objects[number].mesh.triangles)
            distance = scene.compute_distance(o3d.core.Tensor(points)).numpy()
            assert distance.max() < 2e-3


def beams(source: SimulatedSource) -> tuple[np.ndarray, np.ndarray]:
    """Return rays (N, 6) and measured ranges (N,) of all points that are labelled static."""
    labels, (_, _, motion) = read_labels(source.folder, "vls128"), make_route(source.campaign)
    start, rays, ranges = source.reference().stamps[0], [], []
    for i, scan in enumerate(source):
        static = labels.of_sweep(i) == Label.STATIC
        assert scan.offsets is not None
        T = motion.poses((scan.stamp - start) / 1e9 + scan.offsets[static]) @ source.T_base_sensor
        distance = np.linalg.norm(scan.points[static], axis=1)
        direction = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points[static] / distance[:, None])
        rays.append(np.concatenate([T[:, :3, 3], direction], axis=1))
        ranges.append(distance)
    return np.concatenate(rays).astype(np.float32), np.concatenate(ranges)


def first_hits(movables: list[Movable], rays: np.ndarray) -> np.ndarray:
    scene = scene_of(merge(m.mesh for m in movables).triangles)
    return scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()


@pytest.mark.slow
def test_objects_are_met_while_they_are_there_and_never_afterwards(
    sources: dict[int, SimulatedSource], worlds: dict[int, World]
) -> None:
    old, new = by_id(worlds[1]), by_id(worlds[2])
    removed = [old[i] for i in old.keys() - new.keys()]
    noise = 6 * make_sensor("vls128").sigma
    for session, met in ((1, True), (2, False)):
        rays, ranges = beams(sources[session])
        on_removed = first_hits(removed, rays)
        now = scene_of(worlds[session].static.triangles)
        true = now.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        if met:
            # What the ray casting says is on an object, and no more than that, is listed.
            count = np.sum(np.isclose(true, on_removed, atol=1e-3, rtol=0) & np.isfinite(true))
            truth = read_movables(sources[1].folder / "movable.npz")
            listed = truth.returns[np.isin(truth.objects, [m.id for m in removed])].sum()
            assert count > 1000
            assert listed == pytest.approx(count, rel=0.01)
        else:
            would_be_met = on_removed < true - 2 * noise
            assert would_be_met.sum() > 1000
            assert not np.any(np.abs(ranges - on_removed)[would_be_met] < noise)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("F", {"session": 2}, "only a world of kind 'urban' changes"),
        ("A", {"session": 2, "start_shift": 3.0}, "only a closed route"),
        ("A", {"overlap": 3.0}, "only a closed route"),
        ("loop", {"start_shift": 3.0}, "needs a 'session'"),
        ("seasons", {"session": 0}, "scenario.session"),
    ],
)
def test_a_wrong_setting_is_named(name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_campaign(**settings(name, **changes))


def test_a_campaign_without_sessions_has_no_movables(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="only a campaign with a 'session'"):
        read_movables(tmp_path / "movable.npz")
    (tmp_path / "movable.npz").write_bytes(b"no zip")
    with pytest.raises(SourceError, match="is not a list of movable objects"):
        read_movables(tmp_path / "movable.npz")
    np.savez(tmp_path / "movable.npz", ids=np.array([{}], dtype=object))
    with pytest.raises(SourceError, match="is not a list of movable objects"):
        read_movables(tmp_path / "movable.npz")
