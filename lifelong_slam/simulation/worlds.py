"""From a campaign to its world: the static scene, the car's motion and the traffic."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lifelong_slam.simulation.actors import Actor, make_actors
from lifelong_slam.simulation.campaign import Campaign, Segment, Traffic
from lifelong_slam.simulation.highway import highway_site, ramp_site
from lifelong_slam.simulation.mesh import Mesh, merge
from lifelong_slam.simulation.motion import VehicleMotion
from lifelong_slam.simulation.routes import Path
from lifelong_slam.simulation.seasons import Movable, take_movables
from lifelong_slam.simulation.seeds import generator
from lifelong_slam.simulation.site import Site
from lifelong_slam.simulation.terrain import Terrain
from lifelong_slam.simulation.urban import junction_turns, urban_site

_SLOPES = {"urban": 0.012, "highway": 0.012, "ramp": 0.018}
_BEFORE = {"urban": 60.0, "highway": 120.0, "ramp": 60.0}  # metres of road behind the start
_AFTER = {"urban": 130.0, "highway": 280.0, "ramp": 220.0}  # metres of road beyond the end


@dataclass(frozen=True, slots=True)
class World:
    """All that sensors can see, and how the car moves through it.

    Attributes:
        static: everything that doesn't move while it is looked at.
        actors: everything that does.
        motion: of the car.
        movables: what is not there in every session; their triangles are the last of `static`.
    """

    static: Mesh
    actors: list[Actor]
    motion: VehicleMotion
    movables: list[Movable]


def make_world(campaign: Campaign) -> World:
    """Build the world of a campaign; the same campaign gives the same world."""
    path, terrain, motion = make_route(campaign)
    site, roads = _make_site(campaign, path, terrain)
    rng = campaign.generator("traffic")
    actors = make_actors(_streams(campaign, path, rng), roads, terrain, rng)
    if campaign.session is None:
        return World(site.build(), actors, motion, [])
    movables = take_movables(site, campaign.seed, campaign.session)
    static = merge([site.build(), *(movable.mesh for movable in movables)])
    return World(static, actors, motion, movables)


def make_route(campaign: Campaign) -> tuple[Path, Terrain, VehicleMotion]:
    """Return a campaign's path, the land and how the car drives over it."""
    path = Path(
        campaign.route,
        before=0.0 if campaign.closed else _BEFORE[campaign.kind],
        after=0.0 if campaign.closed else _AFTER[campaign.kind],
        closed=campaign.closed,
    )
    terrain = Terrain(generator(campaign.seed, "terrain"), slope=_SLOPES[campaign.kind])
    motion = VehicleMotion(
        path,
        terrain,
        distance=path.length * campaign.laps + campaign.overlap,
        start=campaign.start,
        speed=campaign.speed,
        wobble=campaign.wobble,
        rng=campaign.generator("motion"),
    )
    return path, terrain, motion


def _streams(campaign: Campaign, path: Path, rng: np.random.Generator) -> list[Traffic]:
    """Return the traffic, which in each session is somewhere else along the route."""
    if campaign.session is None:
        return list(campaign.traffic)
    shift = float(rng.uniform(0, path.length))
    return [s.model_copy(update={"first": s.first + shift}) for s in campaign.traffic]


def _make_site(campaign: Campaign, path: Path, terrain: Terrain) -> tuple[Site, dict[str, Path]]:
    rng = generator(campaign.seed, "site")
    if campaign.kind == "urban":
        turns = list(junction_turns(_turns(campaign.route)))
        return urban_site(path, turns, terrain, rng), {"route": path}
    if campaign.kind == "ramp":
        return ramp_site(path, terrain, rng)
    return highway_site(path, terrain, rng), {"route": path}


def _turns(route: Sequence[Segment]) -> list[tuple[float, float, float]]:
    """Return (start, end, degrees) of each turn along the route."""
    turns, s = [], 0.0
    for segment in route:
        if segment.turn is not None:
            turns.append((s, s + segment.length, segment.turn))
        s += segment.length
    return turns
