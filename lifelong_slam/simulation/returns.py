"""From the surfaces that beams meet to what a real sensor reports of them."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.simulation.raycast import Hits
from lifelong_slam.simulation.sensors import Sensor

Floats = NDArray[np.float32]

_MISS_RATE = 0.005  # of beams that return nothing whatever they meet
_DARK = 0.1  # reflectivity at which `0.6 * reach` is detected half the time
_SHARPNESS = 2  # of the step from detected to not, over the signal's strength
_INTENSITY_RANGE = 40.0  # metres at which a white wall's intensity has fallen to half
_BURST_WIDTH = (1.0, 8.0)  # of a crosstalk burst, degrees
_BURST_SHARE = 0.35  # of the beams in a burst that it hits


class Label(IntEnum):
    """What a point is in truth."""

    STATIC = 0
    MOVING = 1
    CROSSTALK = 2


@dataclass(frozen=True, slots=True)
class Returns:
    """The points of one sweep in the order they were measured.

    Attributes:
        column: (N,) index of each point's column.
        ring: (N,) index of each point's beam in the column.
        distance: (N,) measured range in metres, noise included.
        intensity: (N,) 0 to 255.
        label: (N,) uint8, see `Label`.
    """

    column: NDArray[np.intp]
    ring: NDArray[np.intp]
    distance: Floats
    intensity: Floats
    label: NDArray[np.uint8]


def measure(
    hits: Hits, sensor: Sensor, rng: np.random.Generator, crosstalk: float = 0.0
) -> Returns:
    """Decide which beams return, and add the range's noise.

    The signal falls with the square of the distance and with the cosine of incidence. A beam whose
    signal is below the sensor's threshold is mostly lost: so the road fades out ahead of the car
    while walls are seen from afar.

    Args:
        hits: what the beams meet, (C, R).
        sensor: its noise and reach.
        rng: of this sweep.
        crosstalk: share of the beams that return another sensor's pulse instead.
    """
    shape = hits.distance.shape
    distance = hits.distance + np.float32(sensor.sigma) * rng.standard_normal(
        shape, dtype=np.float32
    )
    brightness = hits.reflectivity * hits.cosine
    # As hits that are infinitely far have no signal, they drop out here as well.
    threshold = np.float32(_DARK / (0.6 * sensor.reach) ** 2)
    relative = (brightness / (hits.distance**2 * threshold)) ** _SHARPNESS
    chance = np.float32(1 - _MISS_RATE) * relative / (1 + relative)
    returned = rng.random(shape, dtype=np.float32) < chance
    label = hits.moving.view(np.uint8)
    if crosstalk > 0:
        distance, label, struck = _with_crosstalk(
            distance, label, rng, crosstalk, sensor.azimuth_step
        )
        returned |= struck
    nearest, farthest = sensor.kept_range
    returned &= (distance >= nearest) & (distance <= farthest)
    column, ring = np.nonzero(returned)
    kept = distance[returned]
    intensity = 255 * np.minimum(brightness[returned], 1) / (1 + (kept / _INTENSITY_RANGE) ** 2)
    return Returns(column, ring, kept, np.round(intensity), label[returned])


def _with_crosstalk(
    distance: Floats,
    label: NDArray[np.uint8],
    rng: np.random.Generator,
    share: float,
    azimuth_step: float,
) -> tuple[Floats, NDArray[np.uint8], NDArray[np.bool_]]:
    """Overwrite beams with another sensor's pulses, in bursts.

    While the other sensor's beam sweeps over the scene, the false range drifts from column to
    column (Hebel et al. 2018, reference 7 of the paper): false points come as slanted, ragged
    sheets.
    """
    distance, label = distance.copy(), label.copy()
    columns, rings = distance.shape
    struck = np.zeros(distance.shape, dtype=np.bool_)
    wanted = share * struck.size
    while struck.sum() < wanted * rng.uniform(0.7, 1.3):
        width = int(np.ceil(rng.uniform(*_BURST_WIDTH) / azimuth_step))
        height = int(rng.integers(4, max(rings // 2, 5)))
        left, low = int(rng.integers(0, columns)), int(rng.integers(0, rings))
        block = np.s_[left : left + width, low : low + height]
        part = distance[block]
        chosen = rng.random(part.shape) < _BURST_SHARE
        drift = rng.uniform(-3, 3) * azimuth_step * np.arange(part.shape[0])
        false_range = rng.uniform(3, 70) + drift[:, None] + rng.normal(0, 0.3, part.shape)
        part[chosen] = false_range[chosen]
        label[block][chosen] = Label.CROSSTALK
        struck[block] |= chosen
    return distance, label, struck
