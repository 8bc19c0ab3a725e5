"""Moving road users: each keeps its lane of a road at a steady speed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.simulation.campaign import Traffic
from lifelong_slam.simulation.mesh import Mesh
from lifelong_slam.simulation.routes import Path
from lifelong_slam.simulation.terrain import Terrain
from lifelong_slam.simulation.vehicles import make_vehicle

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Actor:
    """A road user.

    Attributes:
        mesh: its shape in its own frame, origin on the ground in its middle, x forward.
        path: the road.
        terrain: what it drives on.
        first: metres along the road at the start of the recording.
        rate: m/s along the road, negative against its direction.
        lateral: metres left of the road's line.
        radius: of a circle about the origin that holds the mesh, seen from above, metres.
    """

    mesh: Mesh
    path: Path
    terrain: Terrain
    first: float
    rate: float
    lateral: float
    radius: float

    def poses(self, t: Array) -> Array:
        """Return T_world_actor, (N, 4, 4), at (N,) seconds since the recording's start."""
        s = self.first + self.rate * t
        heading = self.path.heading(s) + (np.pi if self.rate < 0 else 0.0)
        return self.terrain.place(self.path.point(s, self.lateral), heading)


def make_actors(
    streams: Sequence[Traffic],
    roads: Mapping[str, Path],
    terrain: Terrain,
    rng: np.random.Generator,
) -> list[Actor]:
    """Return the actors of all streams; their spacing, speed and shape vary with `rng`."""
    actors = []
    for stream in streams:
        sign = 1.0 if stream.direction == "same" else -1.0
        first = stream.first
        # One speed a stream: nobody runs into the one ahead.
        speed = stream.speed * rng.uniform(0.95, 1.05)
        for _ in range(stream.count):
            lateral = stream.lateral + rng.uniform(-0.15, 0.15)
            mesh = make_vehicle(stream.kind, rng)
            radius = float(np.hypot(mesh.triangles[..., 0], mesh.triangles[..., 1]).max())
            actors.append(
                Actor(mesh, roads[stream.road], terrain, first, sign * speed, lateral, radius)
            )
            first += stream.gap * rng.uniform(0.75, 1.25)
    return actors
