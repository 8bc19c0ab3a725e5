"""The LiDARs whose clouds come on one topic, told apart by their frame_id."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import TopicError
from lifelong_slam.geometry import transform
from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.sources.headers import Arrival
from lifelong_slam.sources.pointcloud2 import Cloud
from lifelong_slam.sources.stamps import Stamps
from lifelong_slam.sources.static_frames import StaticFrames

_LONGEST_TURN = NANOSECONDS // 4


class Lidars:
    """Where the LiDARs of a topic sit, and the times of their messages.

    Attributes:
        main: frame of the one with the most messages, which the others' clouds are brought into.
        sweeps: clouds given a time in the latest pass, by frame.
    """

    def __init__(self, first: Sequence[Arrival], frames: StaticFrames, where: str) -> None:
        """Learn from the first messages of the topic; `where` names it in the log.

        Raises:
            TopicError: there are several LiDARs, and `frames` doesn't say how they sit to each other.
            SourceError: nothing tells when the clouds of one were measured.
        """
        self._frames = frames
        self._where = where
        counts = Counter(arrival.header.frame for arrival in first)
        names = [name for name in counts if name] or [""]  # some drivers begin with empty headers
        self.main = max(names, key=counts.__getitem__)
        self._check_linked(names)
        self._stamps = {
            name: Stamps([a for a in first if a.header.frame == name], where) for name in names
        }
        self.sweeps: Counter[str] = Counter()

    def rewind(self) -> None:
        """Begin again with the first message of the topic."""
        self.sweeps.clear()
        for stamps in self._stamps.values():
            stamps.rewind()

    def time(self, message: Arrival) -> int:
        """Return the time of the next message in integer nanoseconds."""
        lidar = message.header.frame
        self.sweeps[lidar] += 1
        if lidar not in self._stamps:
            self._stamps[lidar] = Stamps([], self._where)
        return self._stamps[lidar].time(message)

    def to_main(self, cloud: Cloud, lidar: str) -> Cloud:
        """Return a LiDAR's cloud in the frame of the main one.

        Raises:
            ValueError: it isn't known where that LiDAR sits.
        """
        if lidar == self.main:
            return cloud
        T_main_lidar = self._frames.T_between(self.main, lidar)
        if T_main_lidar is None:
            raise ValueError(f"/tf_static doesn't lead from its frame '{lidar}' to '{self.main}'")
        return _moved(cloud, T_main_lidar)

    @property
    def turn(self) -> float:
        """Nanoseconds from sweep to sweep of the slowest LiDAR that turns; 0 where there is one only."""
        intervals = [stamps.interval for stamps in self._stamps.values() if stamps.interval > 0]
        if len(self._stamps) < 2 or not intervals:
            return 0.0
        return max((i for i in intervals if i <= _LONGEST_TURN), default=min(intervals))

    def _check_linked(self, names: Sequence[str]) -> None:
        lost = [n for n in names if self._frames.T_between(self.main, n) is None]
        if lost:
            listed = ", ".join(f"'{name}'" for name in lost)
            raise TopicError(
                f"{self._where} has the clouds of several LiDARs, and /tf_static doesn't lead from"
                f" '{self.main}' to {listed}: choose one, for instance scenario.frame={self.main}"
            )


def _moved(cloud: Cloud, T: NDArray[np.float64]) -> Cloud:
    """Return a cloud in another frame, without what is no return: there it isn't at the origin."""
    returns = np.isfinite(cloud.points).all(axis=1) & cloud.points.any(axis=1)
    times = {name: values[returns] for name, values in cloud.times.items()}
    return Cloud(transform(T, cloud.points[returns]), times)
