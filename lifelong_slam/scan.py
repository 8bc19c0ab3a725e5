"""The unit of input: one sweep of a LiDAR."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NANOSECONDS = 1_000_000_000
MOST_STAMP = 2**63 - 1  # nanoseconds that an int64 holds


@dataclass(frozen=True, slots=True)
class Scan:
    """One LiDAR sweep, in the sensor's frame.

    Attributes:
        stamp: time of the message header, integer nanoseconds.
        points: (N, 3) float64, metres, sensor frame (x forward, y left, z up).
        offsets: (N,) float64, seconds from `stamp` at which each point was measured (may be
            negative where the header holds the sweep's end), or None where the driver gives no
            point times; without them a sweep can't be deskewed.
    """

    stamp: int
    points: NDArray[np.float64]
    offsets: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        """Check shapes.

        Raises:
            ValueError: points are not (N, 3), or offsets are not (N,).
        """
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ValueError(f"points must have shape (N, 3), not {self.points.shape}")
        if self.offsets is not None and self.offsets.shape != (len(self.points),):
            raise ValueError(
                f"offsets must have shape ({len(self.points)},), not {self.offsets.shape}"
            )

    @property
    def end_stamp(self) -> int:
        """Instant of the last point in nanoseconds."""
        if self.offsets is None or len(self.offsets) == 0:
            return self.stamp
        return self.stamp + round(float(self.offsets.max()) * NANOSECONDS)

    @property
    def middle_stamp(self) -> int:
        """Instant half-way between the first and the last point in nanoseconds."""
        return self.end_stamp - round(self.duration * NANOSECONDS / 2)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last point, 0 without point times."""
        if self.offsets is None or len(self.offsets) == 0:
            return 0.0
        return float(self.offsets.max() - self.offsets.min())
