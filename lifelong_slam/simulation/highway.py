"""Motorways and ramps: guard rails, noise barriers, gantries, bridges, banks with trees, fields."""

import numpy as np

from lifelong_slam.simulation.buildings import building
from lifelong_slam.simulation.furniture import (
    bridge,
    fence,
    gantry,
    guard_rail,
    lamp_post,
    noise_barrier,
    posts,
    sign,
)
from lifelong_slam.simulation.mesh import Array, Mesh
from lifelong_slam.simulation.roads import Road, rural_profile
from lifelong_slam.simulation.routes import Path
from lifelong_slam.simulation.site import Site
from lifelong_slam.simulation.terrain import Terrain
from lifelong_slam.simulation.vegetation import bush, conifer, tree

_BANK = 1.2  # metres that the land lies above the carriageway
_MEDIAN = 7.4  # lateral of the median's barrier, left of the lane driven in
_FAR_EDGE = 17.5  # lateral of the opposite carriageway's outer edge
_NEAR_EDGE = -4.6  # lateral of the hard shoulder's edge


def highway_site(path: Path, terrain: Terrain, rng: np.random.Generator) -> Site:
    """Build a motorway with two carriageways; the route is its right-hand lane."""
    road = Road(path, rural_profile(_FAR_EDGE, _NEAR_EDGE, bank=_BANK))
    site = Site([road], terrain, margin=90.0, rng=rng, edge_rise=_BANK)
    whole = (path.start, path.end)
    for lateral in (_MEDIAN - 0.3, _MEDIAN + 0.3, _FAR_EDGE + 1.0, _NEAR_EDGE - 1.0):
        _line(site, road, whole, lateral, "rail")
    _barriers(site, road, -_NEAR_EDGE + 4.5, -1.0)
    _barriers(site, road, _FAR_EDGE + 4.5, 1.0)
    for s in np.arange(path.start + 60, path.end - 30, rng.uniform(150, 190)).tolist():
        site.add(gantry(_FAR_EDGE + 2.2, _NEAR_EDGE - 2.2), site.pose(road, s, 0.0))
    crossing = float(rng.uniform(0.45, 0.6)) * path.length
    site.add(bridge(_FAR_EDGE + 2.5, _NEAR_EDGE - 2.5), site.pose(road, crossing, 0.0))
    _delineators(site, road)
    _roadside(site, road)
    _countryside(site)
    return site


def ramp_site(
    path: Path, terrain: Terrain, rng: np.random.Generator
) -> tuple[Site, dict[str, Path]]:
    """Build a ramp that ends beside a motorway; returns the site and its roads by name."""
    ramp = Road(path, rural_profile(2.9, -2.9, shoulder=0.8, bank=_BANK))
    end, heading = path.point(np.array([path.end])), float(path.heading(np.array([path.end]))[0])
    left = np.array([-np.sin(heading), np.cos(heading)])
    forward = np.array([np.cos(heading), np.sin(heading)])
    length = 620.0
    line = Path.straight(end[0] + 26.0 * left - (length - 30) * forward, heading, length)
    motorway = Road(line, rural_profile(_FAR_EDGE, _NEAR_EDGE, shoulder=1.0, bank=_BANK))
    site = Site([ramp, motorway], terrain, margin=70.0, rng=rng, edge_rise=_BANK)
    whole = (path.start, path.end)
    _line(site, ramp, whole, -3.9, "rail")
    _line(site, ramp, (path.length * 0.35, path.end), 3.9, "rail")
    for lateral in (_MEDIAN - 0.3, _MEDIAN + 0.3, _FAR_EDGE + 1.0):
        _line(site, motorway, (line.start, line.end), lateral, "rail")
    _barriers(site, ramp, 8.0, -1.0)
    for s in np.arange(path.start + 10, path.end - 10, 32.0).tolist():
        T = site.pose(ramp, s, -4.6)
        site.add(lamp_post(9.0, 2.2), T)
    for s in np.arange(line.start + 90, line.end - 30, 170.0).tolist():
        site.add(gantry(_FAR_EDGE + 2.2, _NEAR_EDGE - 1.5), site.pose(motorway, s, 0.0))
    for road in (ramp, motorway):
        _delineators(site, road)
        _roadside(site, road)
    _countryside(site)
    return site, {"route": path, "motorway": line}


def _line(
    site: Site,
    road: Road,
    span: tuple[float, float],
    lateral: float,
    kind: str,
    height: float = 3.0,
) -> None:
    """Put a rail, fence or barrier along the road, left open where it meets another carriageway."""
    step = {"rail": 2.0, "fence": 2.5, "barrier": 1.0}[kind]
    s = np.arange(*span, step)
    xy = road.path.point(s, lateral)
    blocked = np.zeros(len(s), dtype=np.bool_)
    for other in site.roads:
        if other is not road:
            blocked |= other.covers(xy, 0.8)
    for run in np.split(np.arange(len(s)), np.flatnonzero(np.diff(blocked)) + 1):
        if len(run) < 3 or blocked[run[0]]:
            continue
        points = xy[run]
        ground = site.terrain.height(points) + _rise(road, lateral)
        if kind == "rail":
            site.add(guard_rail(points, ground))
        elif kind == "fence":
            site.add(fence(points, ground, 1.6))
        else:
            site.add(noise_barrier(points, ground, height))


def _rise(road: Road, lateral: float) -> float:
    """Return how high the road's cross-section is above the terrain at a lateral."""
    return float(np.interp(-lateral, -road.profile.lateral, road.profile.rise))


def _barriers(site: Site, road: Road, off: float, side: float) -> None:
    """Put noise barriers of some length here and there, fences in between."""
    rng, s = site.rng, road.path.start
    while s < road.path.end - 20:
        length = float(rng.uniform(35, 80))
        span = (s, min(s + length, road.path.end))
        if rng.random() < 0.4:
            _line(site, road, span, side * off, "barrier", float(rng.uniform(2.2, 4.0)))
        else:
            _line(site, road, span, side * (off + 2.0), "fence")
        s += length + rng.uniform(0, 10)


def _delineators(site: Site, road: Road) -> None:
    """Put a post every 25 m on either side, a sign or a call box now and then."""
    rng = site.rng
    for lateral in (road.profile.right - 0.7, road.profile.left + 0.7):
        xy = road.path.point(np.arange(road.path.start + 5, road.path.end, 25.0), lateral)
        site.add(posts(xy, site.terrain.height(xy), 1.05, 0.06, 0.8))
    for s in np.arange(road.path.start + 15, road.path.end, 45.0).tolist():
        T = site.pose(road, s + rng.uniform(-8, 8), road.profile.right - 2.2)
        if site.clear_of_others(road, T, 1.0):
            site.add(sign(rng, float(rng.uniform(1.8, 3.0))), T)


def _roadside(site: Site, road: Road) -> None:
    """Plant bushes and trees on the banks."""
    rng = site.rng
    for side, edge in ((1.0, road.profile.lateral[0]), (-1.0, road.profile.lateral[-1])):
        for s in np.arange(road.path.start, road.path.end, 3.5).tolist():
            T = site.pose(road, s + rng.uniform(-2, 2), edge + side * rng.uniform(1.5, 9.0))
            T[2, 3] += _BANK - 0.1
            if not site.clear_of_others(road, T, 3.5) or not site.take(T, 1.5, 1.5):
                continue
            site.add(_plant(rng), T)


def _plant(rng: np.random.Generator) -> Mesh:
    kind = rng.random()
    if kind < 0.4:
        return bush(rng, float(rng.uniform(1.0, 2.8)))
    if kind < 0.8:
        return tree(rng, float(rng.uniform(5, 12)))
    return conifer(rng, float(rng.uniform(5, 13)))


def _countryside(site: Site) -> None:
    """Scatter copses, farm buildings and pylons over the fields."""
    rng = site.rng
    for _ in range(140):
        centre: Array = site.random_point()
        if rng.random() < 0.12:
            T = site.pose_at(centre, rng.uniform(0, 2 * np.pi))
            T[2, 3] += _BANK - 0.2
            if site.take(T, 22, 14):
                site.add(building(rng, 20, 12, float(rng.uniform(5, 8))), T)
            continue
        for _ in range(int(rng.integers(2, 6))):
            T = site.pose_at(centre + rng.normal(0, 6, 2), 0.0)
            T[2, 3] += _BANK - 0.1
            if site.take(T, 1.5, 1.5):
                site.add(_plant(rng), T)
