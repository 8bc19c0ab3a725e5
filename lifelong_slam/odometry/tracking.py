"""When odometry could not register scans, told as it happens and remembered for the verdict on the run."""

import logging
from dataclasses import dataclass

import numpy as np

from lifelong_slam.odometry.odometry import OdometryEstimate, Tracking
from lifelong_slam.scan import NANOSECONDS, Scan

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Outage:
    """Successive scans that could not be registered.

    Attributes:
        begin: stamp of the first of them, nanoseconds.
        end: stamp of the first scan that was registered again, or of the last of the run.
        scans: how many.
        parted: the scan that ended it began a map of its own, which nothing measured connects with what
            was before.
    """

    begin: int
    end: int
    scans: int
    parted: bool

    @property
    def seconds(self) -> float:
        """How long."""
        return (self.end - self.begin) / NANOSECONDS


class TrackingLog:
    """What each scan's pose rests on."""

    def __init__(self) -> None:
        self.scans = 0
        self.points = 0
        self.points_in_range = 0
        self._outages: list[Outage] = []
        self._begin = 0
        self._predicted = 0  # scans in a row
        self._newest = 0

    @property
    def outages(self) -> list[Outage]:
        """All of them up to now, one that goes on among them."""
        if not self._predicted:
            return list(self._outages)
        return [*self._outages, Outage(self._begin, self._newest, self._predicted, parted=False)]

    def update(self, scan: Scan, estimate: OdometryEstimate) -> None:
        """Take in a scan; log where tracking is interrupted, and where it goes on."""
        self.scans += 1
        self.points += len(scan.points)
        self.points_in_range += len(estimate.points)
        self._newest = estimate.stamp
        if estimate.tracking is Tracking.PREDICTED:
            if not self._predicted:
                self._begin = estimate.stamp
                logger.warning(
                    "%s can't be registered: its motion is extrapolated", _where(estimate)
                )
            self._predicted += 1
            return
        parted = estimate.tracking is Tracking.STARTED and self.scans > 1
        if self._predicted or parted:
            self._end_outage(estimate, parted)

    def _end_outage(self, estimate: OdometryEstimate, parted: bool) -> None:
        begin = self._begin if self._predicted else estimate.stamp
        outage = Outage(begin, estimate.stamp, self._predicted, parted)
        self._outages.append(outage)
        self._predicted = 0
        if parted:
            logger.warning(
                "lost: %s fits nothing that was seen before; a map of its own begins here",
                _where(estimate),
            )
        else:
            logger.warning("registered again after %.1f s (%d scans)", outage.seconds, outage.scans)


def _where(estimate: OdometryEstimate) -> str:
    x, y, z = np.round(estimate.T_odom_sensor[:3, 3], 1)
    return f"the scan at {estimate.stamp / NANOSECONDS:.3f} s, near ({x}, {y}, {z}) m by odometry,"
