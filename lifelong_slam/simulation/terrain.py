"""Gentle undulation: the height of the land as a sum of long waves."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Terrain:
    """A smooth height field, whose slope is known exactly.

    Args:
        rng: where the waves come from.
        slope: standard deviation of the slope along any direction, metres a metre.
        shortest: shortest wavelength in metres.
        longest: longest wavelength in metres.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        *,
        slope: float,
        shortest: float = 60.0,
        longest: float = 240.0,
        waves: int = 8,
    ) -> None:
        wavelength = np.exp(rng.uniform(np.log(shortest), np.log(longest), waves))
        angle = rng.uniform(0, 2 * np.pi, waves)
        number = 2 * np.pi / wavelength
        self._k = number[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self._phase = rng.uniform(0, 2 * np.pi, waves)
        # A wave a sin(kx) along a random direction has a mean square slope of (a k)^2 / 4.
        self._amplitude = slope * 2 / number / np.sqrt(waves)
        self._datum = 0.0
        self._datum = float(self.height(np.zeros((1, 2)))[0])

    def height(self, xy: Array) -> Array:
        """Return the (N,) heights in metres at (N, 2) points; zero at the origin."""
        height: Array = np.sin(xy @ self._k.T + self._phase) @ self._amplitude - self._datum
        return height

    def gradient(self, xy: Array) -> Array:
        """Return the (N, 2) slopes d height / d x, y at (N, 2) points."""
        gradient: Array = (np.cos(xy @ self._k.T + self._phase) * self._amplitude) @ self._k
        return gradient

    def place(self, xy: Array, heading: Array) -> Array:
        """Return (N, 4, 4) poses of vehicles that stand on the land at (N, 2), facing `heading`."""
        gradient = self.gradient(xy)
        c, s = np.cos(heading), np.sin(heading)
        pitch = -np.arctan(gradient[:, 0] * c + gradient[:, 1] * s)
        roll = np.arctan(-gradient[:, 0] * s + gradient[:, 1] * c)
        position = np.concatenate([xy, self.height(xy)[:, None]], axis=1)
        return poses(position, heading, pitch, roll)


def poses(position: Array, yaw: Array, pitch: Array, roll: Array) -> Array:
    """Return (N, 4, 4) poses of (N, 3) positions and (N,) angles: R = Rz(yaw) Ry(pitch) Rx(roll).

    Written out because it is called for every column of every sweep.
    """
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    T = np.zeros((len(position), 4, 4))
    T[:, 0, 0], T[:, 0, 1], T[:, 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    T[:, 1, 0], T[:, 1, 1], T[:, 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    T[:, 2, 0], T[:, 2, 1], T[:, 2, 2] = -sp, cp * sr, cp * cr
    T[:, :3, 3] = position
    T[:, 3, 3] = 1.0
    return T
