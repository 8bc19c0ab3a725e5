"""Bare KISS-ICP odometry as published: the yardstick for what a back end adds.

Vizzo et al., *KISS-ICP: In Defense of Point-to-Point ICP*, RA-L 2023. Its registration yields no
covariance, so the graph, a chain of the estimated motions, carries the identity: a placeholder.
"""

import time

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.kiss_icp import KissICP
from numpy.typing import NDArray

from lifelong_slam.errors import ConfigError
from lifelong_slam.geometry import invert
from lifelong_slam.result import Edge, GraphSnapshot, SlamResult, StageTimes
from lifelong_slam.scan import Scan
from lifelong_slam.systems.point_map import PointMap
from lifelong_slam.trajectory import Trajectory

Array = NDArray[np.float64]


class KissIcpSystem:
    """KISS-ICP with its default settings, apart from what depends on the sensor."""

    def __init__(
        self,
        min_range: float,
        max_range: float,
        voxel_size: float,
        deskew: bool = True,
        map_voxel_size: float | None = 0.2,
        threads: int = 0,
    ) -> None:
        """Set up the odometry.

        Args:
            min_range: nearer points are left out, metres.
            max_range: farther points are left out, metres.
            voxel_size: of KISS-ICP's local map, metres.
            deskew: undo the motion during a sweep where points have times.
            map_voxel_size: of the map that the run leaves behind, metres; None leaves no map.
            threads: for registration; 0 takes all cores, 1 makes runs repeatable to the last bit.
                The package keeps to the number that it is first given in a process.

        Raises:
            ConfigError: a range or size makes no sense.
        """
        check_settings(min_range, max_range, voxel_size, map_voxel_size)
        self._odometry = KissICP(
            KISSConfig(
                data=DataConfig(min_range=min_range, max_range=max_range, deskew=deskew),
                mapping=MappingConfig(voxel_size=voxel_size),
                registration=RegistrationConfig(max_num_threads=threads),
            )
        )
        self._map = None if map_voxel_size is None else PointMap(map_voxel_size)
        self._stamps: list[int] = []
        self._poses: list[Array] = []

    def process(self, scan: Scan) -> StageTimes:
        """Register one scan to the local map."""
        start = time.perf_counter()
        deskewed, _ = self._odometry.register_frame(scan.points, point_times(scan))
        elapsed = time.perf_counter() - start
        self._stamps.append(scan.end_stamp)
        self._poses.append(self._odometry.last_pose)
        if self._map is not None:
            self._map.add(deskewed, self._poses[-1])
        return StageTimes(
            odometry_ms=1e3 * elapsed, vertices=len(self._poses), edges=len(self._poses) - 1
        )

    def watch(self) -> tuple[Array, None]:
        """Return the latest T_map_sensor; the graph is but the path."""
        return self._poses[-1], None

    def finish(self) -> SlamResult:
        """Return the odometry's poses and the points they put together."""
        poses = np.array(self._poses).reshape(-1, 4, 4)
        return SlamResult(
            trajectory=Trajectory(np.array(self._stamps, dtype=np.int64), poses),
            map_points=np.empty((0, 3), np.float32) if self._map is None else self._map.points(),
            graph=_chain(poses),
        )


def check_settings(
    min_range: float, max_range: float, voxel_size: float, map_voxel_size: float | None
) -> None:
    """Refuse settings that KISS-ICP would take without a word.

    Raises:
        ConfigError: the ranges leave no room, or a voxel has no size.
    """
    if not 0 <= min_range < max_range:
        raise ConfigError(
            f"ranges must be 0 <= min_range < max_range, not {min_range} and {max_range}"
        )
    if voxel_size <= 0 or (map_voxel_size is not None and map_voxel_size <= 0):
        raise ConfigError(f"voxel sizes must be positive, not {voxel_size} and {map_voxel_size}")


def point_times(scan: Scan) -> Array:
    """Return the times that KISS-ICP deskews by: none where all are equal, which it can't scale."""
    if scan.offsets is None or not scan.duration > 0:
        return np.empty(0)
    return scan.offsets


def _chain(poses: Array) -> GraphSnapshot:
    steps = invert(poses[:-1]) @ poses[1:]
    edges = [Edge(i, i + 1, step, np.eye(6), "odometry") for i, step in enumerate(steps)]
    return GraphSnapshot(poses=dict(enumerate(poses)), edges=edges)
