"""Shapes of road users; each stands on z = 0 with its middle at the origin and looks along +x."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from lifelong_slam.simulation.mesh import Mesh, merge
from lifelong_slam.simulation.shapes import box, cylinder, disc, extrusion

_PAINT, _GLASS, _TYRE, _PLATE, _CLOTH = 0.45, 0.05, 0.06, 1.5, 0.4


def make_vehicle(kind: str, rng: np.random.Generator) -> Mesh:
    """Return a `car`, `van`, `truck` or `cyclist`; cars and vans vary in size and colour."""
    return _SHAPES[kind](rng)


def parked_vehicle(rng: np.random.Generator) -> Mesh:
    """Return what stands at a kerb: a car or, less often, a van."""
    return make_vehicle("van" if rng.random() < 0.15 else "car", rng)


def _some_car(rng: np.random.Generator) -> Mesh:
    return car(float(rng.uniform(0.88, 1.08)), float(rng.uniform(0.1, 0.8)))


def car(scale: float = 1.0, paint: float = _PAINT) -> Mesh:
    """Return a saloon car, 4.5 m long at scale 1."""
    sills = [
        (-2.2, 0.25),
        (2.15, 0.22),
        (2.25, 0.55),
        (2.1, 0.72),
        (1.0, 0.92),
        (-2.15, 0.98),
        (-2.25, 0.6),
    ]
    cabin = [(1.05, 0.9), (0.35, 1.40), (-1.05, 1.45), (-1.9, 0.97)]
    parts = [
        extrusion(sills, 0.89, paint, taper=[1, 0.9, 0.85, 0.88, 0.97, 0.95, 0.9]),
        extrusion(cabin, 0.80, _GLASS * 2, taper=[1.0, 0.82, 0.82, 1.0]),
        box((-1.0, -0.62, 1.42), (0.3, 0.62, 1.47), paint),
        box((2.2, -0.26, 0.4), (2.27, 0.26, 0.52), _PLATE),
        box((-2.27, -0.26, 0.55), (-2.2, 0.26, 0.67), _PLATE),
        *(box((0.75, y - 0.1, 0.9), (0.9, y + 0.1, 1.03), paint) for y in (-0.95, 0.95)),
        *_wheels((-1.35, 1.4), 0.80, 0.32),
    ]
    return merge(parts).moved(np.diag([scale, scale, scale, 1.0]))


def van(paint: float = 0.6) -> Mesh:
    """Return a delivery van, 5.4 m long."""
    side = [
        (-2.7, 0.3),
        (2.6, 0.3),
        (2.7, 0.8),
        (2.2, 1.15),
        (1.55, 2.1),
        (1.3, 2.3),
        (-2.65, 2.35),
    ]
    taper = [1, 0.9, 0.9, 0.95, 0.88, 0.86, 0.92]
    screen = [(2.22, 1.18), (1.62, 2.06), (1.58, 2.04), (2.18, 1.16)]
    return merge(
        [
            extrusion(side, 0.98, paint, taper=taper),
            extrusion(screen, 0.84, _GLASS),
            box((-2.74, -0.26, 0.6), (-2.69, 0.26, 0.72), _PLATE),
            *(box((1.7, y - 0.14, 1.15), (1.85, y + 0.14, 1.5), _TYRE) for y in (-1.08, 1.08)),
            *_wheels((-1.75, 1.75), 0.88, 0.35),
        ]
    )


def truck() -> Mesh:
    """Return an articulated lorry, 16 m long and 4 m high."""
    cab = [(5.7, 0.45), (7.95, 0.45), (8.0, 1.5), (7.8, 2.9), (7.3, 3.7), (5.8, 3.8)]
    return merge(
        [
            extrusion(cab, 1.22, 0.5),
            box((7.9, -1.0, 1.9), (7.99, 1.0, 2.7), _GLASS),
            box((-8.0, -1.26, 1.15), (5.3, 1.26, 3.95), 0.55),
            box((-7.8, -0.5, 0.8), (6.0, 0.5, 1.15), 0.2),
            *(box((-2.6, y - 0.03, 0.4), (2.4, y + 0.03, 1.0), 0.3) for y in (-1.18, 1.18)),
            box((-8.05, -1.2, 0.45), (-7.95, 1.2, 0.6), _PLATE),
            *_wheels((-6.4, -5.1, -3.8, 4.2, 6.8), 1.1, 0.5),
        ]
    )


def cyclist() -> Mesh:
    """Return a person riding a bicycle."""
    frame = [
        ((-0.5, 0, 0.34), (0.0, 0, 0.3)),
        ((0.0, 0, 0.3), (-0.18, 0, 0.85)),
        ((-0.16, 0, 0.78), (0.4, 0, 0.8)),
        ((0.0, 0, 0.3), (0.4, 0, 0.75)),
        ((0.38, 0, 0.95), (0.55, 0, 0.34)),
    ]
    limbs = [
        ((-0.15, 0.1, 0.9), (0.18, 0.11, 0.62), 0.08),
        ((0.18, 0.11, 0.62), (0.02, 0.11, 0.2), 0.06),
        ((-0.15, -0.1, 0.9), (0.2, -0.11, 0.8), 0.08),
        ((0.2, -0.11, 0.8), (0.05, -0.11, 0.42), 0.06),
        ((0.17, 0.2, 1.35), (0.42, 0.24, 1.0), 0.045),
        ((0.17, -0.2, 1.35), (0.42, -0.24, 1.0), 0.045),
    ]
    return merge(
        [
            *(disc((x, 0, 0.34), 0.34, _TYRE * 2) for x in (-0.5, 0.55)),
            *(cylinder(a, b, 0.02, 0.3, sides=5) for a, b in frame),
            *(cylinder(a, b, r, _CLOTH, sides=6) for a, b, r in limbs),
            cylinder((-0.17, 0, 0.88), (0.17, 0, 1.42), 0.17, _CLOTH, top_radius=0.2),
            _ball((0.27, 0, 1.6), 0.12, 0.3),
            box((-0.45, -0.25, 1.0), (-0.1, 0.25, 1.0), _CLOTH),
        ]
    )


def _wheels(axles: ArrayLike, half_track: float, radius: float) -> list[Mesh]:
    parts = []
    for x in np.atleast_1d(axles):
        for side in (-1, 1):
            outer = side * (half_track + 0.08)
            centre, rim = (x, side * (half_track - 0.15), radius), (x, outer, radius)
            parts += [cylinder(centre, rim, radius, _TYRE, sides=12), disc(rim, radius, 0.2)]
    return parts


def _ball(centre: ArrayLike, radius: float, reflectivity: float) -> Mesh:
    c = np.asarray(centre)
    rings = [(-1.0, 0.05), (-0.6, 0.8), (0, 1.0), (0.6, 0.8), (1.0, 0.05)]
    up = np.array([0, 0, radius])
    return merge(
        cylinder(c + z0 * up, c + z1 * up, radius * r0, reflectivity, top_radius=radius * r1)
        for (z0, r0), (z1, r1) in pairwise(rings)
    )


_SHAPES: dict[str, Callable[[np.random.Generator], Mesh]] = {
    "car": _some_car,
    "van": lambda rng: van(float(rng.uniform(0.3, 0.8))),
    "truck": lambda rng: truck(),
    "cyclist": lambda rng: cyclist(),
}
