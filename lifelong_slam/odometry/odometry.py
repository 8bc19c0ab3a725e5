"""The protocol of an odometry front end."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.registration import Cloud
from lifelong_slam.scan import Scan


@dataclass(frozen=True, slots=True)
class OdometryEstimate:
    """Where the sensor was at the end of a sweep, and the sweep freed of motion distortion.

    Attributes:
        stamp: instant of the sweep's last point in nanoseconds; the pose holds here.
        T_odom_sensor: (4, 4).
        covariance: (6, 6) of the registration, rotation (rad) then translation (m), in the sensor's
            frame: how well this pose is known against the recent ones.
        points: (N, 3) deskewed points in range, metres, in the sensor's frame at `stamp`.
        cloud: the same points thinned out, ready for registration.
    """

    stamp: int
    T_odom_sensor: NDArray[np.float64]
    covariance: NDArray[np.float64]
    points: NDArray[np.float64]
    cloud: Cloud


class Odometry(Protocol):
    """Registers scans one after the other."""

    def register(self, scan: Scan) -> OdometryEstimate:
        """Estimate the pose of a cleaned scan that is newer than all before it."""
        ...
