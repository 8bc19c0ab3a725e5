"""What the tests of the SLAM core share: structured worlds, a ray-cast LiDAR, keyframes of points."""

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from lifelong_slam.geometry import exp, interpolate, invert, rotation_angle, transform
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.odometry.odometry import OdometryEstimate
from lifelong_slam.registration import Cloud
from lifelong_slam.scan import NANOSECONDS, Scan

START = 1_700_000_000 * NANOSECONDS
PERIOD = 0.1  # seconds between scans
SIGMAS = np.array([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01])  # rad and m of a good registration


def planar(x, y, yaw=0.0, z=0.0):
    """Return the (4, 4) pose at a place, turned about the vertical."""
    T = exp(np.array([0, 0, yaw, 0, 0, 0.0]))
    T[:3, 3] = x, y, z
    return T


def error_of(estimated, true):
    """Return the translation (m) and the rotation (rad) between two (4, 4) poses."""
    difference = invert(true) @ estimated
    return float(np.linalg.norm(difference[:3, 3])), float(rotation_angle(difference))


def box(centre, size, yaw=0.0):
    """Return a box that stands at `centre` (x, y of its middle, z of its foot)."""
    mesh = o3d.geometry.TriangleMesh.create_box(*size)
    mesh.translate([-size[0] / 2, -size[1] / 2, 0])
    mesh.transform(planar(centre[0], centre[1], yaw, centre[2]))
    return mesh


def pole(x, y, radius, height):
    mesh = o3d.geometry.TriangleMesh.create_cylinder(radius, height, 12)
    return mesh.translate([x, y, height / 2])


def ground(half_size, z=0.0):
    return box((0, 0, z - 1.0), (2 * half_size, 2 * half_size, 1.0))


class World:
    """Meshes that rays can be cast at and surfaces sampled from."""

    def __init__(self, meshes):
        self._mesh = o3d.geometry.TriangleMesh()
        for mesh in meshes:
            self._mesh += mesh
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(self._mesh))

    def cast(self, origins, directions):
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        return self._scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)["t_hit"].numpy()

    def distance(self, points):
        """Return the distance of (N, 3) points from the nearest surface."""
        return self._scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def town(seed, half_size=60.0, road=lambda xy: np.full(len(xy), True), spacing=9.0):
    """Return ground with houses, parked cars and poles at random, none where `road` is true."""
    rng = np.random.default_rng(seed)
    steps = np.arange(-half_size, half_size, spacing)
    spots = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    spots = spots + rng.uniform(-0.3, 0.3, spots.shape) * spacing
    meshes = [ground(2 * half_size)]
    for x, y in spots[~road(spots)]:
        kind, yaw = rng.random(), rng.uniform(0, np.pi)
        if kind < 0.4:
            size = (rng.uniform(3, 7), rng.uniform(3, 7), rng.uniform(3, 9))
            meshes.append(box((x, y, 0), size, yaw))
        elif kind < 0.7:
            meshes.append(box((x, y, 0), (4.2, 1.8, 1.5), yaw))
        else:
            meshes.append(pole(x, y, rng.uniform(0.1, 0.3), rng.uniform(3, 8)))
    return World(meshes)


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR: `columns` of `rings` rays, one column after the other in `duration`."""

    rings: int = 24
    columns: int = 240
    width: float = 2 * np.pi
    elevations: tuple = (-0.35, 0.2)
    reach: float = 60.0
    duration: float = PERIOD
    noise: float = 0.02

    def directions(self):
        """Return (columns, rings, 3) unit vectors and the (columns,) fractions of the sweep."""
        fractions = np.arange(self.columns) / max(self.columns - 1, 1)
        azimuth = (np.arange(self.columns) + 0.5) / self.columns * self.width - self.width / 2
        elevation = np.linspace(*self.elevations, self.rings)
        across, up = np.meshgrid(azimuth, elevation, indexing="ij")
        flat = np.cos(up)
        return np.stack([flat * np.cos(across), flat * np.sin(across), np.sin(up)], -1), fractions

    def sweep(self, world, T_begin, T_end, stamp=START, rng=None):
        """Cast a sweep while the sensor moves from (4, 4) `T_begin` to `T_end`."""
        rng = rng or np.random.default_rng(0)
        directions, fractions = self.directions()
        poses = interpolate(T_begin, T_end, fractions)
        rays = np.einsum("cij,crj->cri", poses[:, :3, :3], directions).reshape(-1, 3)
        origins = np.repeat(poses[:, :3, 3], self.rings, axis=0)
        ranges = world.cast(origins, rays)
        hit = ranges < self.reach
        ranges = ranges[hit] + rng.normal(scale=self.noise, size=hit.sum())
        points = directions.reshape(-1, 3)[hit] * ranges[:, None]
        offsets = np.repeat(fractions, self.rings)[hit] * self.duration
        return Scan(stamp, points.astype(np.float64), offsets)


def drive(world, lidar, pose_at, times, seed=0):
    """Return the scans that begin at `times` (s) while the sensor moves along `pose_at`."""
    rng = np.random.default_rng(seed)
    return [
        lidar.sweep(world, pose_at(t), pose_at(t + lidar.duration),
                    START + round(t * NANOSECONDS), rng)
        for t in times
    ]  # fmt: skip


def seconds(stamp):
    """Return the time of a stamp on the clock of `drive`."""
    return (stamp - START) / NANOSECONDS


def surfaces(seed, sample=0, boxes=12, count=6000, extent=15.0, noise=0.0):
    """Return (N, 3) points on the ground and on boxes: layout by `seed`, where on them by `sample`."""
    layout, rng = np.random.default_rng(seed), np.random.default_rng([seed, sample])
    floor = rng.uniform([-extent, -extent, 0], [extent, extent, 0], (count // 3, 3))
    parts = [floor]
    for _ in range(boxes):
        size, yaw = layout.uniform([1, 1, 1], [5, 5, 4]), layout.uniform(0, np.pi)
        centre = layout.uniform(-extent, extent, 2)
        points = rng.uniform(-0.5, 0.5, (count * 2 // 3 // boxes, 3))
        axis = rng.integers(0, 3, len(points))
        points[np.arange(len(points)), axis] = np.where(rng.random(len(points)) < 0.5, -0.5, 0.5)
        parts.append(transform(planar(*centre, yaw), points * size + [0, 0, size[2] / 2]))
    points = np.vstack(parts)
    return points + rng.normal(scale=noise, size=points.shape) if noise else points


def corridor(sample=0, width=4.0, length=60.0, count=4000, noise=0.01):
    """Return points on floor and walls along x, which leave the motion along x free."""
    rng = np.random.default_rng(sample)
    x = rng.uniform(-length / 2, length / 2, count)
    across = rng.uniform(-width / 2, width / 2, count)
    up = rng.uniform(0, 3, count)
    walls = [np.full(count, side * width / 2) for side in (-1, 1)]
    parts = [np.stack([x, across, np.zeros(count)], axis=1)]
    parts += [np.stack([x, wall, up], axis=1) for wall in walls]
    points = np.vstack(parts)
    return points + rng.normal(scale=noise, size=points.shape)


def keyframe(index, T_odom_sensor, points, travelled=None, covariance=None, seconds=None):
    """Return a keyframe at a pose whose features and map points are the (N, 3) `points`."""
    points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    return Keyframe(
        id=index,
        session=0,
        stamp=START + round((index if seconds is None else seconds) * NANOSECONDS),
        T_odom_sensor=T_odom_sensor,
        covariance=np.diag(SIGMAS**2) if covariance is None else covariance,
        travelled=float(index) if travelled is None else travelled,
        features=points,
        points=points,
    )


def estimate(stamp, T_odom_sensor, points=None, covariance=None, voxel_size=0.5):
    """Return what an odometry that sees `points` would say."""
    points = np.zeros((0, 3)) if points is None else points
    covariance = np.diag(SIGMAS**2) if covariance is None else covariance
    cloud = Cloud.prepare(points, voxel_size)
    return OdometryEstimate(stamp, T_odom_sensor, covariance, points, cloud)
