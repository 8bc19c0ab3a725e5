"""An example of a metric: accelerations that an estimated path would take to drive."""

import numpy as np
from numpy.typing import NDArray

from eval.errors import EvidenceError
from eval.evidence import Evidence
from eval.metrics.metric import Curve, Measurement, Plot, Section


class Acceleration:
    """Accelerations along the estimated path, from its second differences; it needs no reference.

    A car brakes with 10 m/s^2 at most: more than that is a jump of the estimate, or its jitter.
    """

    name = "acceleration"
    title = "Acceleration"
    section = Section.TRAJECTORY
    keys: tuple[str, ...] = ("acceleration_m_per_s2",)
    needs: tuple[str, ...] = ("estimate",)
    unit = "m/s^2"
    less_is_better: bool | None = True
    meaning = "The acceleration that the estimated path rarely exceeds; jumps and jitter raise it."

    def __init__(self, percentile: float = 99.0) -> None:
        """Choose the percentile of the headline."""
        self._percentile = percentile

    def measure(self, evidence: Evidence) -> Measurement:
        """Differentiate the positions twice.

        Raises:
            EvidenceError: there are fewer than three poses at different instants.
        """
        estimate = evidence.estimate
        assert estimate is not None  # since it is among the needs
        stamps, first = np.unique(estimate.timestamps, return_index=True)
        if len(stamps) < 3:
            raise EvidenceError("accelerations take three poses at different instants")
        times, size = _accelerations(stamps, estimate.positions_xyz[first])
        headline = float(np.percentile(size, self._percentile))
        values = {
            "mean": float(size.mean()),
            f"p{self._percentile:g}": headline,
            "max": float(size.max()),
        }
        curve = Curve("acceleration", times - stamps[0], size)
        plot = Plot("Acceleration of the path", "time [s]", "acceleration [m/s^2]", (curve,))
        return Measurement({"acceleration_m_per_s2": values}, headline, {"m_per_s2": size}, (plot,))


def _accelerations(
    stamps: NDArray[np.float64], positions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (N - 2,) instants in seconds and sizes in m/s^2 of N positions' accelerations."""
    velocities = np.diff(positions, axis=0) / np.diff(stamps)[:, None]
    middles = (stamps[1:] + stamps[:-1]) / 2
    accelerations = np.diff(velocities, axis=0) / np.diff(middles)[:, None]
    return stamps[1:-1], np.linalg.norm(accelerations, axis=1)
