"""The whole pipeline.

scan -> odometry -> keyframe -> pose graph <-> loop closures -> trajectory and map
"""

import time

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import adjoint, exp, invert, log
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.loop_closure.closer import LoopCloser, relative_covariance
from lifelong_slam.mapping.keyframe import Keyframe, KeyframeSelector
from lifelong_slam.mapping.static_map import StaticMap, thin
from lifelong_slam.odometry.odometry import Odometry, OdometryEstimate
from lifelong_slam.result import Edge, GraphSnapshot, SlamResult, StageTimes
from lifelong_slam.scan import Scan
from lifelong_slam.trajectory import Trajectory

Array = NDArray[np.float64]


class LifelongSlam:
    """Odometry, loop closures and a pose graph over keyframes; poses are of the sensor.

    Scans between keyframes hang on the graph by their odometry, so that the trajectory has a pose
    for every scan.
    """

    def __init__(
        self,
        odometry: Odometry,
        loop_closer: LoopCloser,
        static_map: StaticMap,
        keyframe_distance: float = 2.0,
        keyframe_rotation: float = 0.35,
    ) -> None:
        """Put the stages together.

        Args:
            odometry: front end.
            loop_closer: proposes and verifies loop closures.
            static_map: makes the map of the keyframes' points.
            keyframe_distance: metres between keyframes.
            keyframe_rotation: radians between keyframes.
        """
        self._odometry = odometry
        self._selector = KeyframeSelector(keyframe_distance, keyframe_rotation)
        self._loop_closer = loop_closer
        self._static_map = static_map
        self._graph = PoseGraph()
        self._keyframes: list[Keyframe] = []
        self._stamps: list[int] = []
        self._odometry_poses: list[Array] = []
        self._anchors: list[int] = []  # index of the newest keyframe at each scan
        self._travelled = 0.0
        self._watched = 0  # keyframes that a viewer has seen
        # Covariance of the newest keyframe since the last closure.
        self._drift: Array = np.zeros((6, 6))

    def process(self, scan: Scan) -> StageTimes:
        """Take in one scan: odometry always, the graph if the scan becomes a keyframe."""
        start = time.perf_counter()
        estimate = self._odometry.register(scan)
        self._record(estimate)
        odometry_end = time.perf_counter()
        loop_ms = optimise_ms = 0.0
        if self._selector.takes(estimate):
            loop_ms, optimise_ms = self._add_keyframe(estimate)
        self._anchors.append(len(self._keyframes) - 1)
        return StageTimes(
            odometry_ms=1e3 * (odometry_end - start),
            loop_ms=loop_ms,
            optimise_ms=optimise_ms,
            vertices=len(self._graph),
            edges=self._graph.edge_count,
        )

    def finish(self) -> SlamResult:
        """Optimise once more, every loop closure with a vote, and put trajectory and map together."""
        self._graph.optimise(reconsider=True)
        poses = [self._graph.pose(keyframe.id) for keyframe in self._keyframes]
        return SlamResult(
            trajectory=Trajectory(np.array(self._stamps, dtype=np.int64), self._every_scan(poses)),
            map_points=self._static_map.build(self._keyframes, poses),
            graph=self._graph.snapshot(),
            counts={
                **self._loop_closer.counts,
                "loop closures outvoted": len(self._graph.rejected),
            },
        )

    def watch(self) -> tuple[Array, GraphSnapshot | None]:
        """Return the newest (4, 4) T_map_sensor, and the graph where a keyframe has been added."""
        keyframe = self._keyframes[-1]
        motion = invert(keyframe.T_odom_sensor) @ self._odometry_poses[-1]
        news = len(self._keyframes) > self._watched
        self._watched = len(self._keyframes)
        return self._graph.pose(keyframe.id) @ motion, self._graph.snapshot() if news else None

    def _record(self, estimate: OdometryEstimate) -> None:
        if self._odometry_poses:
            step = estimate.T_odom_sensor[:3, 3] - self._odometry_poses[-1][:3, 3]
            self._travelled += float(np.linalg.norm(step))
        self._stamps.append(estimate.stamp)
        self._odometry_poses.append(estimate.T_odom_sensor)

    def _add_keyframe(self, estimate: OdometryEstimate) -> tuple[float, float]:
        """Add a vertex with its odometry, look for loops, optimise if one disagrees."""
        start = time.perf_counter()
        keyframe = Keyframe(
            id=len(self._keyframes),
            stamp=estimate.stamp,
            T_odom_sensor=estimate.T_odom_sensor,
            covariance=estimate.covariance,
            travelled=self._travelled,
            features=estimate.cloud.positions.astype(np.float32),
            points=thin(estimate.points, self._static_map.voxel_size),
        )
        self._extend_graph(keyframe)
        sigma = float(np.sqrt(np.linalg.eigvalsh(self._drift[3:, 3:])[-1]))
        closures = self._loop_closer.close(keyframe, estimate.cloud, self._graph.pose, sigma)
        closed = time.perf_counter()
        news = False
        for edge in closures:
            news |= not self._graph.agrees(edge)
            self._graph.add_edge(edge)
            self._drift = edge.covariance
        if news:
            self._graph.optimise()
        return 1e3 * (closed - start), 1e3 * (time.perf_counter() - closed)

    def _extend_graph(self, keyframe: Keyframe) -> None:
        if not self._keyframes:
            self._graph.add_vertex(keyframe.id, np.eye(4))
        else:
            last = self._keyframes[-1]
            motion = invert(last.T_odom_sensor) @ keyframe.T_odom_sensor
            covariance = relative_covariance(last, keyframe, motion)
            self._graph.add_odometry(Edge(last.id, keyframe.id, motion, covariance, "odometry"))
            A = adjoint(invert(motion))
            self._drift = A @ self._drift @ A.T + covariance
        self._keyframes.append(keyframe)

    def _every_scan(self, poses: list[Array]) -> Array:
        """Carry every scan's odometry along with the keyframes around it.

        The correction that the graph makes to odometry is known at the keyframes before and after a
        scan; in between it moves from one to the other in proportion to the time.
        """
        before = np.array(self._anchors)
        after = np.minimum(before + 1, len(self._keyframes) - 1)
        stamps = np.array([keyframe.stamp for keyframe in self._keyframes])
        odometry = np.array([keyframe.T_odom_sensor for keyframe in self._keyframes])
        T = np.array(poses)
        correction = invert(T[before] @ invert(odometry[before]) @ odometry[after]) @ T[after]
        span = np.maximum(stamps[after] - stamps[before], 1)
        fraction = (np.array(self._stamps) - stamps[before]) / span
        lever = invert(odometry[after]) @ np.array(self._odometry_poses)
        blend = exp(fraction[:, None] * log(correction))
        every: Array = T[before] @ invert(odometry[before]) @ odometry[after] @ blend @ lever
        return every
