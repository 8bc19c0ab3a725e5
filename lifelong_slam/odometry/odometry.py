"""The protocol of an odometry front end."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.registration import Cloud
from lifelong_slam.scan import Scan


class Tracking(Enum):
    """What the pose of a scan rests on."""

    STARTED = "started"  # the scan begins a map of its own: nothing measured leads here
    REGISTERED = "registered"  # it was registered to what was seen before
    PREDICTED = "predicted"  # it couldn't be: the motion before it is extrapolated


@dataclass(frozen=True, slots=True)
class OdometryEstimate:
    """Where the sensor was at the middle of a sweep, and the sweep freed of motion distortion.

    Attributes:
        stamp: instant half-way between the sweep's first and last point, nanoseconds; the pose holds here.
        T_odom_sensor: (4, 4).
        covariance: (6, 6) of the registration, rotation (rad) then translation (m), in the sensor's
            frame: how well this pose is known against the recent ones.
        points: (N, 3) deskewed points in range, metres, in the sensor's frame at `stamp`.
        cloud: the same points thinned out, ready for registration.
        tracking: what the pose rests on.
    """

    stamp: int
    T_odom_sensor: NDArray[np.float64]
    covariance: NDArray[np.float64]
    points: NDArray[np.float64]
    cloud: Cloud
    tracking: Tracking = Tracking.REGISTERED


class Odometry(Protocol):
    """Registers scans one after the other."""

    @property
    def counts(self) -> Mapping[str, int]:
        """What has happened so far, by name."""
        ...

    def register(self, scan: Scan) -> OdometryEstimate:
        """Estimate the pose of a cleaned scan that is newer than all before it."""
        ...
