"""Streets of a town: houses, pavements with lamps and trees, parked cars, side streets."""

from collections.abc import Iterator

import numpy as np

from lifelong_slam.simulation.buildings import building
from lifelong_slam.simulation.furniture import (
    bollards,
    cabinet,
    fence,
    lamp_post,
    shelter,
    sign,
    wall,
)
from lifelong_slam.simulation.mesh import Array, planar
from lifelong_slam.simulation.roads import Road, urban_profile
from lifelong_slam.simulation.routes import Path
from lifelong_slam.simulation.site import Site, footprint
from lifelong_slam.simulation.terrain import Terrain
from lifelong_slam.simulation.vegetation import bush, conifer, hedge, tree
from lifelong_slam.simulation.vehicles import parked_vehicle

_STUB = 90.0  # metres of a side street
_STUB_CLEARANCE = 30.0  # metres that a side street keeps from other roads, away from its junction
_PARKED = 0.55  # share of parking places that are taken
_PLACE = 6.2  # metres a parking place
_JUNCTION = 9.0  # metres off another carriageway within which nobody parks or plants
KERB = 0.12  # metres that pavements lie above the carriageway


def urban_site(
    path: Path, turns: list[tuple[float, float]], terrain: Terrain, rng: np.random.Generator
) -> Site:
    """Build a town about a route; `turns` are the (start, end) of those that are junctions."""
    roads = [Road(path, urban_profile())]
    for start, end in turns:
        ahead = _stub(path, start, 1.0, roads[0])
        behind = _stub(path, end, -1.0, roads[0])
        roads += [Road(stub, urban_profile()) for stub in (ahead, behind)]
    site = Site(roads, terrain, margin=45.0, rng=rng, edge_rise=KERB - 0.05)
    for road in roads:
        _furnish(site, road)
        for side in (1.0, -1.0):
            _park(site, road, side)
            _build_row(site, road, side)
    for road in roads[1:]:
        _close_street(site, road)
    _plant_behind(site)
    return site


def _stub(path: Path, s: float, sign_: float, main: Road) -> Path:
    """Return the side street that leaves the route straight on at `s` (+1), or backwards (-1)."""
    start = path.point(np.array([s]))[0]
    heading = float(path.heading(np.array([s]))[0])
    direction = sign_ * np.array([np.cos(heading), np.sin(heading)])
    reach = np.arange(25.0, _STUB)
    _, lateral, rest = path.project(start + reach[:, None] * direction)
    near = np.hypot(lateral, rest) < _STUB_CLEARANCE
    # Within the first metres it is near its own junction; that is not a conflict.
    leaves = np.flatnonzero(~near)
    again = np.flatnonzero(near & (reach > reach[leaves[0]])) if len(leaves) else np.array([0])
    length = float(reach[again[0]]) if len(again) else _STUB
    if sign_ > 0:
        return Path.straight(start, heading, length)
    return Path.straight(start + length * direction, heading, length)


def _furnish(site: Site, road: Road) -> None:
    """Line both pavements: lamps at steady gaps, and something else in most places between."""
    rng = site.rng
    for side, edge in ((1.0, road.profile.left), (-1.0, road.profile.right)):
        for i, s in enumerate(np.arange(road.path.start + 3, road.path.end - 3, 7.0).tolist()):
            lateral = edge + side * rng.uniform(0.5, 0.8)
            T = site.pose(road, s + rng.uniform(-1, 1), lateral, 0.0 if side < 0 else np.pi)
            if not site.clear_of_others(road, T, 1.5):
                continue
            T[2, 3] += KERB
            if i % 4 == (0 if side > 0 else 2):
                site.add(lamp_post(), T)
            elif site.clear_of_others(road, T, _JUNCTION):
                _something(site, T)


def _something(site: Site, T: Array) -> None:
    rng = site.rng
    choice = rng.random()
    if choice < 0.38:
        site.add(tree(rng, float(rng.uniform(5, 9))), T, "tree")
    elif choice < 0.52:
        site.add(sign(rng), T)
    elif choice < 0.62:
        site.add(bollards(int(rng.integers(2, 5))), T)
    elif choice < 0.74:
        site.add(cabinet(rng), T)
    elif choice < 0.79:
        site.add(shelter(), T @ planar(0, -0.6))


def _park(site: Site, road: Road, side: float) -> None:
    """Leave cars at the kerb, none quite straight."""
    rng = site.rng
    edge = road.profile.left if side > 0 else road.profile.right
    for s in np.arange(road.path.start + 4, road.path.end - 4, _PLACE).tolist():
        if rng.random() > _PARKED:
            continue
        turn = rng.normal(0, 0.02) + (np.pi if side > 0 else 0.0)
        T = site.pose(road, s + rng.normal(0, 0.3), edge - side * rng.uniform(1.02, 1.15), turn)
        if not site.clear_of_others(road, T, _JUNCTION):
            continue
        site.add(parked_vehicle(rng), T, "car")


def _build_row(site: Site, road: Road, side: float) -> None:
    """Fill a side of the street with buildings, front gardens and the gaps between."""
    rng = site.rng
    front = (road.profile.lateral[0] if side > 0 else -road.profile.lateral[-1]) + 0.4
    s = road.path.start + rng.uniform(0, 4)
    while s < road.path.end - 8:
        length, depth = rng.uniform(8, 17), rng.uniform(8, 12)
        garden = 0.0 if rng.random() < 0.45 else rng.uniform(2.0, 4.5)
        lateral = side * (front + garden + depth / 2)
        # The front faces -y, hence the half turn on the right-hand side.
        T = site.pose(road, s + length / 2, lateral, 0.0 if side > 0 else np.pi)
        if not site.take(T, length + 0.8, depth + 0.8):
            s += 3.0
            continue
        site.add(building(rng, length, depth, float(rng.choice([4.2, 6.6, 7.0, 9.8, 12.6]))), T)
        if garden:
            _front_garden(site, T, length, depth / 2 + garden)
        s += length + (0.0 if rng.random() < 0.3 else rng.uniform(1.5, 7.0))


def _front_garden(site: Site, T: Array, length: float, off: float) -> None:
    """Close a garden towards the street with a hedge, a fence or a wall."""
    rng = site.rng
    boundary = T @ planar(0, -off + 0.4)
    if not site.take(boundary, length, 0.6):
        return
    kind = rng.random()
    if kind < 0.4:
        site.add(hedge(rng, length - 1.5, float(rng.uniform(0.8, 1.7))), boundary)
        return
    x = np.arange(-length / 2 + 1.2, length / 2, 0.5)
    xy = np.column_stack([x, np.zeros_like(x)]) @ boundary[:2, :2].T + boundary[:2, 3]
    ground = site.terrain.height(xy)
    height = float(rng.uniform(0.8, 1.4))
    site.add(fence(xy, ground, height) if kind < 0.75 else wall(xy, ground, height))
    if rng.random() < 0.6:
        x_bush = rng.uniform(-length / 3, length / 3)
        site.add(bush(rng, float(rng.uniform(0.8, 1.6))), boundary @ planar(x_bush, 1.2))


def _close_street(site: Site, road: Road) -> None:
    """Put a building across a side street's far end."""
    rng = site.rng
    main = site.roads[0].path
    ends = road.path.point(np.array([road.path.start, road.path.end]))
    _, lateral, rest = main.project(ends)
    far_is_end = bool(np.hypot(lateral, rest)[1] > np.hypot(lateral, rest)[0])
    s, turn = (road.path.end + 7, -np.pi / 2) if far_is_end else (road.path.start - 7, np.pi / 2)
    for shift in (0.0, 3.0, 6.0):
        at = s + (shift if far_is_end else -shift)
        T = site.pose(road, at, 1.65, turn)
        if site.take(T, 16.0, 10.0):
            site.add(building(rng, 15.5, 9.5, 9.8), T)
            return


def _plant_behind(site: Site) -> None:
    """Scatter trees and sheds over what is left of the ground."""
    rng = site.rng
    for _ in range(400):
        T = site.pose_at(site.random_point(), rng.uniform(0, 2 * np.pi))
        size = rng.random()
        if size < 0.2:
            if site.take(T, 5.0, 4.0):
                site.add(building(rng, 4.5, 3.5, 2.8), T)
        elif site.free(footprint(T, 2.0, 2.0)):
            site.claim(footprint(T, 2.0, 2.0))
            height = float(rng.uniform(5, 12))
            if size > 0.8:
                site.add(conifer(rng, height), T)
            else:
                site.add(tree(rng, height), T, "tree")


def junction_turns(lengths: list[tuple[float, float, float]]) -> Iterator[tuple[float, float]]:
    """Yield (start, end) of the turns sharp enough for a crossroads.

    Args:
        lengths: (start, end, degrees) of each turn along the route.
    """
    for start, end, degrees in lengths:
        if abs(degrees) >= 60:
            yield start, end
