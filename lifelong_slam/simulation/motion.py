"""How the car drives its route: speed, lateral wobble, slopes and suspension."""

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline

from lifelong_slam.simulation.routes import Path
from lifelong_slam.simulation.terrain import Terrain, poses

Array = NDArray[np.float64]

KNOT_RATE = 100.0  # Hz; the pose is a cubic spline through knots at this rate
_MARGIN = 0.1  # seconds of motion beyond both ends, so that splines have no ends in use
_LATERAL_COMFORT = 4.0  # m/s^2, above which a driver slows down for a bend
_SPEED_VARIATION = 0.03  # of the speed
_LEAN = 0.004  # rad of roll and pitch for each m/s^2: a family car's body
_HEAVE = 0.004  # metres, standard deviation of the suspension's bounce
_SHAKE = 0.0025  # radians, standard deviation of the suspension's pitch and roll


class VehicleMotion:
    """T_world_base of the car at any instant of the recording, twice differentiable.

    Base is on the ground below the rear axle, x forward. The car is at full speed from the start.

    Args:
        path: the line that the driver follows.
        terrain: what the car drives on.
        distance: metres to drive along the path.
        start: metres along the path where the drive starts.
        speed: average speed, m/s.
        wobble: amplitude of the lateral deviation from the line, metres.
        rng: decides the wobble, the speed's variation and the suspension.
    """

    def __init__(
        self,
        path: Path,
        terrain: Terrain,
        *,
        distance: float,
        speed: float,
        wobble: float,
        rng: np.random.Generator,
        start: float = 0.0,
    ) -> None:
        self.duration = distance / speed
        count = int(np.ceil((self.duration + 2 * _MARGIN) * KNOT_RATE)) + 1
        t: Array = np.linspace(-_MARGIN, self.duration + _MARGIN, count, dtype=np.float64)
        s = _progress(path, start, distance, self.duration, speed, rng)(t)
        xy = path.point(s, wobble * _waves(s, rng, 30.0, 120.0))
        knots = np.concatenate([xy, np.zeros((count, 4))], axis=1)
        self._fill(knots, CubicSpline(t, xy), t, terrain, rng)
        self._spline = CubicSpline(t, knots)
        self._rate = self._spline.derivative()

    def _fill(
        self,
        knots: Array,
        plane: CubicSpline,
        t: Array,
        terrain: Terrain,
        rng: np.random.Generator,
    ) -> None:
        """Add height, yaw, pitch and roll to the knots' columns 2 to 5."""
        velocity, acceleration = plane(t, 1), plane(t, 2)
        yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        left = forward[:, ::-1] * [-1, 1]
        xy = knots[:, :2]
        slope = terrain.gradient(xy)
        along, across = (slope * forward).sum(1), (slope * left).sum(1)
        braking, cornering = (acceleration * forward).sum(1), (acceleration * left).sum(1)
        knots[:, 2] = terrain.height(xy) + _HEAVE * _waves(t, rng, 0.5, 1.3)
        knots[:, 3] = yaw
        knots[:, 4] = -np.arctan(along) - _LEAN * braking + _SHAKE * _waves(t, rng, 0.6, 1.5)
        knots[:, 5] = np.arctan(across) + _LEAN * cornering + _SHAKE * _waves(t, rng, 0.6, 1.5)

    def poses(self, t: Array) -> Array:
        """Return T_world_base, (N, 4, 4), at (N,) seconds since the recording's start."""
        x = self._spline(t)
        return poses(x[:, :3], x[:, 3], x[:, 4], x[:, 5])

    def velocities(self, t: Array) -> tuple[Array, Array]:
        """Return linear (m/s) and angular (rad/s) velocities, (N, 3) each, in the base frame."""
        x, rate = self._spline(t), self._rate(t)
        R = self.poses(t)[:, :3, :3]
        linear = np.einsum("nji,nj->ni", R, rate[:, :3])
        yaw, pitch, roll = rate[:, 3], rate[:, 4], rate[:, 5]
        angular = np.stack(
            [
                roll - yaw * np.sin(x[:, 4]),
                pitch * np.cos(x[:, 5]) + yaw * np.sin(x[:, 5]) * np.cos(x[:, 4]),
                -pitch * np.sin(x[:, 5]) + yaw * np.cos(x[:, 5]) * np.cos(x[:, 4]),
            ],
            axis=1,
        )
        return linear, angular


def _progress(
    path: Path,
    start: float,
    distance: float,
    duration: float,
    speed: float,
    rng: np.random.Generator,
) -> CubicSpline:
    """Return arc length over time: slower in bends, a little uneven, `distance` in `duration`."""
    beyond = 4 * _MARGIN * speed
    s = start + np.arange(-beyond, distance + beyond, 0.25, dtype=np.float64)
    pull = speed**2 * np.abs(path.curvature(s)) / _LATERAL_COMFORT
    factor = (1 + _SPEED_VARIATION * _waves(s, rng, 40.0, 150.0)) / (1 + pull**2) ** 0.25
    t = np.concatenate([[0.0], cumulative_trapezoid(1 / factor, s)])
    first, last = np.interp([start, start + distance], s, t)
    return CubicSpline((t - first) * duration / (last - first), s)


def _waves(x: Array, rng: np.random.Generator, shortest: float, longest: float) -> Array:
    """Return a smooth random function of unit variance with wavelengths in the given span."""
    count = 4
    wavelength = rng.uniform(shortest, longest, count)
    phase = rng.uniform(0, 2 * np.pi, count)
    total: Array = np.sin(2 * np.pi * x[:, None] / wavelength + phase).sum(axis=1)
    return np.asarray(total / np.sqrt(count / 2))
