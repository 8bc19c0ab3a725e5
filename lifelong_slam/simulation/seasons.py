"""One place in several sessions: which parked cars, boxes and leaves are there in each.

Roads, houses and all else are those of the seed. What changes follows from seed and session alone:

- cars: each parking place keeps its car with `_STAYS`, and a place without one gets one as often as
  keeps `_TAKEN` of them taken;
- boxes, pallets and bins on pavements: likewise;
- leaves: a tree's crown is full, thinned, bare and thinned again in turn, some trees' a session ahead.

An object has one id for as long as it stays; leaves that come back are the same ones. A session
doesn't depend on how many more there are.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.simulation.furniture import parcel
from lifelong_slam.simulation.mesh import Array, Mesh, planar
from lifelong_slam.simulation.seeds import generator
from lifelong_slam.simulation.site import Part, Site
from lifelong_slam.simulation.urban import KERB
from lifelong_slam.simulation.vegetation import foliage
from lifelong_slam.simulation.vehicles import parked_vehicle

Kind = Literal["car", "box", "leaves"]

_TAKEN = 0.6  # share of places that are taken in each session
_STAYS = 0.6  # share of cars and boxes that are still there in the next session
_BOX_GAP = 9.0  # metres of pavement for each place where boxes may stand
_OFF_KERB = (1.6, 2.1)  # metres behind the kerb, where the furniture leaves room to walk
_CLEAR = 1.5  # metres that boxes keep from other carriageways
_THINNED = 0.4  # share of the leaves in a thinned crown
_CROWNS = (2, 1, 0, 1)  # layers of leaves by session, over and over
_AHEAD = 0.3  # share of trees that are a session ahead
_FIRST_ID = {"car": 0, "box": 100_000, "leaves": 200_000}  # more than there are places
_IDS_A_SESSION = 1_000_000


@dataclass(frozen=True, slots=True)
class Movable:
    """An object that is not there in every session.

    Attributes:
        id: the same in each session of its stay.
        kind: what it is.
        mesh: in the world's frame.
    """

    id: int
    kind: Kind
    mesh: Mesh


def take_movables(site: Site, seed: int, session: int) -> list[Movable]:
    """Strip a site of what changes, and return what is there in a session (from 1)."""
    cars = [part for part in site.parts if part.kind == "car"]
    trees = [part for part in site.parts if part.kind == "tree"]
    site.parts = [_wood(part) for part in site.parts if part.kind != "car"]
    parking = [part.T_world_part for part in cars]
    return [
        *_occupants("car", parking, seed, session),
        *_occupants("box", _box_places(site, generator(seed, "box places")), seed, session),
        *_leaves(trees, seed, session),
    ]


def occupancy(places: int, session: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the session in which each place's occupant of a session came (P,), 0 for none."""
    # A place that is left is taken again as often as keeps the share of taken ones.
    comes = _TAKEN * (1 - _STAYS) / (1 - _TAKEN * _STAYS)
    came = (rng.random(places) < _TAKEN).astype(np.int64)
    for now in range(2, session + 1):
        stays = (came > 0) & (rng.random(places) < _STAYS)
        taken = rng.random(places) < comes
        came = np.where(stays, came, np.where(taken, now, 0))
    return came


def layers_of_leaves(trees: int, session: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return how many layers of leaves each tree has in a session (N,): 2 full, 1 thinned, 0 bare."""
    ahead = (rng.random(trees) < _AHEAD).astype(np.int64)
    return np.asarray(_CROWNS)[(session - 1 + ahead) % len(_CROWNS)]


def _occupants(
    kind: Literal["car", "box"], places: list[Array], seed: int, session: int
) -> list[Movable]:
    came = occupancy(len(places), session, generator(seed, f"{kind} stays"))
    objects = []
    for place in np.flatnonzero(came).tolist():
        number = int(came[place]) * _IDS_A_SESSION + _FIRST_ID[kind] + place
        rng = generator(seed, kind, number)
        mesh = parked_vehicle(rng) if kind == "car" else parcel(rng)
        x, y, turn = rng.normal(0, [0.3, 0.05, 0.02])
        objects.append(Movable(number, kind, mesh.moved(places[place] @ planar(x, y, 0, turn))))
    return objects


def _box_places(site: Site, rng: np.random.Generator) -> list[Array]:
    """Return poses (4, 4) along the rear of all pavements, x along the road."""
    places = []
    for road in site.roads:
        for side, edge in ((1.0, road.profile.left), (-1.0, road.profile.right)):
            for s in np.arange(road.path.start + 5, road.path.end - 5, _BOX_GAP).tolist():
                lateral = edge + side * rng.uniform(*_OFF_KERB)
                T = site.pose(road, s + rng.uniform(-2, 2), lateral, rng.normal(0, 0.1))
                T[2, 3] += KERB
                if site.clear_of_others(road, T, _CLEAR):
                    places.append(T)
    return places


def _leaves(trees: list[Part], seed: int, session: int) -> list[Movable]:
    """Return each tree's layers of leaves; the upper one is what thinning takes away."""
    layers = layers_of_leaves(len(trees), session, generator(seed, "seasons of trees"))
    objects = []
    for number, (part, count) in enumerate(zip(trees, layers.tolist(), strict=True)):
        leaves = part.mesh.subset(foliage(part.mesh))
        lower = generator(seed, "layers of leaves", number).random(len(leaves)) < _THINNED
        for layer, chosen in enumerate((lower, ~lower)[:count]):
            name = _FIRST_ID["leaves"] + 2 * number + layer
            objects.append(Movable(name, "leaves", leaves.subset(chosen)))
    return objects


def _wood(part: Part) -> Part:
    if part.kind != "tree":
        return part
    return Part(part.mesh.subset(~foliage(part.mesh)), part.T_world_part)
