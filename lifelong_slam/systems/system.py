"""The protocol of a SLAM system."""

from typing import Protocol

from lifelong_slam.result import SlamResult, StageTimes
from lifelong_slam.scan import Scan


class System(Protocol):
    """Takes cleaned scans one at a time, in the sensor's frame and in order of time."""

    def process(self, scan: Scan) -> StageTimes:
        """Take in one scan and report where the time went."""
        ...

    def finish(self) -> SlamResult:
        """Return what is mapped so far; called once, after the last scan or an interruption."""
        ...
