"""The iMAR reference: the true pose plus the error of a survey-grade INS with GNSS."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from lifelong_slam.geometry import exp
from lifelong_slam.simulation.motion import VehicleMotion

Array = NDArray[np.float64]

RATE = 100  # Hz

# Rotation about x, y, z (rad), then translation (m): standard deviations that such a system
# specifies with corrections, reached by an error that wanders over `_CORRELATION` seconds.
_SIGMAS = np.array([8e-5, 8e-5, 2e-4, 0.01, 0.01, 0.015])
_CORRELATION = 60.0
_TWIST_SIGMAS = np.array([0.01, 0.01, 0.01, 2e-4, 2e-4, 2e-4])


class Ins:
    """Measures T_world_base with a slowly wandering error."""

    def __init__(self, motion: VehicleMotion, rng: np.random.Generator) -> None:
        self._motion = motion
        count = int(np.ceil(motion.duration)) + 3
        self._error = CubicSpline(np.arange(count) - 1.0, _wander(count, rng))
        # In the message's order: position, rotation, linear and angular velocity.
        self.deviations = np.concatenate([_SIGMAS[3:], _SIGMAS[:3], _TWIST_SIGMAS])

    def measure(self, t: Array) -> tuple[Array, Array]:
        """Return T_world_base (N, 4, 4) and twists (N, 6), linear first, at (N,) seconds."""
        T = self._motion.poses(t)
        error = self._error(t)
        measured = T @ exp(np.concatenate([error[:, :3], np.zeros((len(t), 3))], axis=1))
        measured[:, :3, 3] += error[:, 3:]
        return measured, np.concatenate(self._motion.velocities(t), axis=1)


def _wander(count: int, rng: np.random.Generator) -> Array:
    """Return (count, 6) errors a second apart: a first-order Gauss-Markov process."""
    keep = np.exp(-1 / _CORRELATION)
    errors = np.empty((count, 6))
    errors[0] = rng.normal(0, _SIGMAS)
    for i in range(1, count):
        errors[i] = keep * errors[i - 1] + rng.normal(0, _SIGMAS * np.sqrt(1 - keep**2))
    return errors
