"""Casting one sweep: every column from the pose that the car has at that column's instant."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from lifelong_slam.geometry import invert
from lifelong_slam.simulation.actors import Actor
from lifelong_slam.simulation.mesh import Mesh
from lifelong_slam.simulation.motion import VehicleMotion
from lifelong_slam.simulation.sensors import Sensor

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Hits:
    """The first surface that each beam meets, (C, R) each.

    Attributes:
        distance: metres along the beam, infinite where there is nothing.
        cosine: of the angle of incidence, 0 to 1.
        reflectivity: of the surface.
        moving: whether it belongs to a moving road user.
        triangle: its number in the static mesh; of no meaning where moving, or where there is nothing.
    """

    distance: Floats
    cosine: Floats
    reflectivity: Floats
    moving: NDArray[np.bool_]
    triangle: NDArray[np.uint32]


class Caster:
    """A mesh made ready for rays."""

    def __init__(self, mesh: Mesh) -> None:
        corners = mesh.triangles.astype(np.float32)
        # Beams that miss have the triangle number 2^32 - 1; clipped, they read the last entry.
        self._reflectivity = np.append(mesh.reflectivity, 0.0).astype(np.float32)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(corners.reshape(-1, 3)),
            o3d.core.Tensor.from_numpy(np.arange(3 * len(mesh), dtype=np.uint32).reshape(-1, 3)),
        )

    def cast(self, rays: Floats) -> tuple[Floats, Floats, Floats, NDArray[np.uint32]]:
        """Cast (N, 6) rays, origin and unit direction.

        Returns:
            Distance, cosine, reflectivity and number of the triangle, (N,) each; see `Hits`.
        """
        answer = self.cast_only(rays)
        triangle = answer["primitive_ids"].numpy()
        normal = answer["primitive_normals"].numpy()
        cosine = np.abs(np.einsum("ni,ni->n", normal, rays[:, 3:]))
        last = np.uint32(len(self._reflectivity) - 1)
        reflectivity = self._reflectivity[np.minimum(triangle, last)]
        return answer["t_hit"].numpy(), cosine, reflectivity, triangle

    def cast_only(self, rays: Floats) -> dict[str, Any]:
        """Return Open3D's own answer for (N, 6) rays; nothing is looked up."""
        return dict(self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays)))


class SweepCaster:
    """Casts whole sweeps of one sensor through the static world and the traffic."""

    def __init__(
        self, sensor: Sensor, motion: VehicleMotion, static: Caster, actors: Sequence[Actor]
    ) -> None:
        self.sensor, self._motion = sensor, motion
        self._static = static
        self._actors = [(actor, Caster(actor.mesh)) for actor in actors]
        self._azimuths, self._offsets = sensor.azimuths, sensor.offsets
        self.offsets = self._offsets.astype(np.float32)
        self.directions = sensor.directions.astype(np.float32)

    def rays(self, start: float) -> tuple[Floats, NDArray[np.float64]]:
        """Return a sweep's (C, R, 6) rays in the world and T_world_sensor, (C, 4, 4)."""
        T = self._motion.poses(start + self._offsets) @ self.sensor.T_base_sensor
        return _rays_from(T, self.directions), T

    def cast(self, start: float) -> Hits:
        """Cast the sweep that starts `start` seconds into the recording."""
        rays, T_world_sensor = self.rays(start)
        shape = rays.shape[:2]
        found = self._static.cast(rays.reshape(-1, 6))
        distance, cosine, reflectivity = (values.reshape(shape) for values in found[:3])
        moving = np.zeros(shape, dtype=np.bool_)
        hits = Hits(distance, cosine, reflectivity, moving, found[3].reshape(shape))
        for actor, shape_caster in self._actors:
            self._cast_actor(actor, shape_caster, start, T_world_sensor, hits)
        return hits

    def _cast_actor(
        self,
        actor: Actor,
        caster: Caster,
        start: float,
        T_world_sensor: NDArray[np.float64],
        hits: Hits,
    ) -> None:
        """Let an actor's nearer surfaces replace what the beams of some columns met.

        The beams are expressed in the actor's own frame at each column's instant. So its mesh is
        prepared once, and its motion during the sweep is exact.
        """
        if not self._near(actor, start, T_world_sensor[0, :2, 3]):
            return
        T_world_actor = actor.poses(start + self._offsets)
        columns = self._facing(actor, T_world_actor, T_world_sensor)
        if not len(columns):
            return
        T_actor_sensor = invert(T_world_actor[columns]) @ T_world_sensor[columns]
        rays = _rays_from(T_actor_sensor, self.directions[columns])
        found = caster.cast(rays.reshape(-1, 6))[:3]
        distance, cosine, reflectivity = (values.reshape(rays.shape[:2]) for values in found)
        nearer = distance < hits.distance[columns]
        for whole, part in (
            (hits.distance, distance),
            (hits.cosine, cosine),
            (hits.reflectivity, reflectivity),
        ):
            whole[columns] = np.where(nearer, part, whole[columns])
        hits.moving[columns] |= nearer

    def _near(self, actor: Actor, start: float, position: NDArray[np.float64]) -> bool:
        offset = actor.poses(np.array([start]))[0, :2, 3] - position
        return bool(np.hypot(*offset) < self.sensor.kept_range[1] + actor.radius)

    def _facing(
        self,
        actor: Actor,
        T_world_actor: NDArray[np.float64],
        T_world_sensor: NDArray[np.float64],
    ) -> NDArray[np.intp]:
        """Return the columns whose azimuth is within the actor's bounding circle."""
        offset = T_world_actor[:, :3, 3] - T_world_sensor[:, :3, 3]
        local = np.einsum("cji,cj->ci", T_world_sensor[:, :3, :3], offset)
        ratio = actor.radius / np.maximum(np.hypot(local[:, 0], local[:, 1]), 1e-6)
        half_width = np.where(ratio < 1, np.arcsin(np.minimum(ratio, 1)), np.pi)
        bearing = np.arctan2(local[:, 1], local[:, 0]) - self._azimuths
        apart = np.abs((bearing + np.pi) % (2 * np.pi) - np.pi)
        return np.flatnonzero(apart <= half_width)


def _rays_from(T: NDArray[np.float64], directions: Floats) -> Floats:
    """Return (C, R, 6) rays from the origins of (C, 4, 4) poses along (C, R, 3) directions."""
    rays = np.empty((*directions.shape[:2], 6), dtype=np.float32)
    rays[..., :3] = T[:, None, :3, 3]
    R_transposed = T[:, :3, :3].swapaxes(1, 2).astype(np.float32)
    np.matmul(directions, R_transposed, out=rays[..., 3:])
    return rays
