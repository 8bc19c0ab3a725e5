"""KISS-SLAM as published: KISS-ICP, local maps, closures between them, and its own optimisation.

Guadagnino et al., *KISS-SLAM*, IROS 2025. It weighs every edge by the identity and has no robust
kernel; its edges therefore carry the identity as covariance, a placeholder.

The package keeps local maps of 0.5 m voxels. So that its map can be compared with others', points
are collected here as well, at the same resolution as for the other systems, in pieces of the path
short enough to be rigid; once the poses are final each piece is put where its first pose is.
"""

import contextlib
import io
import logging
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import ConfigError
from lifelong_slam.result import Edge, EdgeKind, GraphSnapshot, SlamResult, StageTimes
from lifelong_slam.scan import Scan
from lifelong_slam.systems.kiss_icp import check_settings, point_times
from lifelong_slam.systems.point_map import PointMap
from lifelong_slam.trajectory import Trajectory

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)
_PIECE_LENGTH = 20.0


class KissSlamSystem:
    """KISS-SLAM with its default settings, apart from what depends on the sensor."""

    def __init__(
        self,
        min_range: float,
        max_range: float,
        voxel_size: float,
        deskew: bool = True,
        map_voxel_size: float | None = 0.2,
        threads: int = 0,
    ) -> None:
        """Set up the package's own SLAM; the arguments are those of `KissIcpSystem`.

        Raises:
            ConfigError: the kiss-slam package isn't installed, or a range or size makes no sense.
        """
        check_settings(min_range, max_range, voxel_size, map_voxel_size)
        package = _import_kiss_slam()
        config = package.config.KissSLAMConfig()
        config.odometry.preprocessing.min_range = min_range
        config.odometry.preprocessing.max_range = max_range
        config.odometry.preprocessing.deskew = deskew
        config.odometry.mapping.voxel_size = voxel_size
        config.odometry.registration.max_num_threads = threads
        self._slam = package.slam.KissSLAM(config)
        self._edges = _record_factors(self._slam)
        _silence_optimiser(self._slam)
        self._pieces = None if map_voxel_size is None else _Pieces(map_voxel_size)
        self._watch = _OdometryWatch(self._slam.odometry)
        self._stamps: list[int] = []
        self._edges_watched = 0

    def process(self, scan: Scan) -> StageTimes:
        """Take in one scan; a local map that is full is closed and compared with the others."""
        start = time.perf_counter()
        with _prints_to_log():
            self._slam.process_scan(scan.points, point_times(scan))
        total_ms = 1e3 * (time.perf_counter() - start)
        if self._pieces is not None:
            motion = self._slam.odometry.last_delta
            self._pieces.add(len(self._stamps), self._watch.deskewed, motion)
        self._stamps.append(scan.end_stamp)
        return StageTimes(
            odometry_ms=self._watch.elapsed_ms,
            loop_ms=total_ms - self._watch.elapsed_ms,  # local maps, closures and optimisation
            vertices=len(self._slam.local_map_graph.graph),
            edges=len(self._edges),
        )

    def watch(self) -> tuple[Array, GraphSnapshot | None]:
        """Return the latest T_map_sensor, and the graph of local maps if it grew."""
        T_map_sensor = self._slam.local_map_graph.last_keypose @ self._slam.odometry.last_pose
        grown = len(self._edges) > self._edges_watched
        self._edges_watched = len(self._edges)
        return T_map_sensor, self._graph() if grown else None

    def finish(self) -> SlamResult:
        """Close the last local map and optimise every pose, as the package's own pipeline does."""
        with _prints_to_log():
            self._slam.generate_new_node()
            self._slam.local_map_graph.erase_last_local_map()
            poses = self._final_poses()
        points = self._pieces.join(poses) if self._pieces else np.empty((0, 3), np.float32)
        return SlamResult(
            trajectory=Trajectory(
                np.array(self._stamps, dtype=np.int64), np.array(poses).reshape(-1, 4, 4)
            ),
            map_points=points,
            graph=self._graph(),
            counts={"loops_accepted": len(self._slam.get_closures())},
        )

    def _graph(self) -> GraphSnapshot:
        nodes = self._slam.local_map_graph.local_maps()
        poses = {int(node.id): np.array(node.keypose) for node in nodes}
        edges = [e for e in self._edges if e.source in poses and e.target in poses]
        return GraphSnapshot(poses, edges)

    def _final_poses(self) -> list[Array]:
        if len(self._stamps) == 1:  # a graph without edges crashes the package's optimiser
            return [np.eye(4)]
        with _native_stderr_silenced():
            estimates = self._slam.fine_grained_optimization()[1].estimates()
        return [np.asarray(estimates[i]) for i in sorted(estimates)]


class _Pieces:
    """Points of consecutive scans, in the frame of the first scan of each piece of the path."""

    def __init__(self, voxel_size: float) -> None:
        self._voxel_size = voxel_size
        self._done: list[tuple[int, NDArray[np.float32]]] = []
        self._start = 0
        self._pose = np.eye(4)
        self._map: PointMap | None = None

    def add(self, index: int, points: Array, motion: Array) -> None:
        """Add the points of scan `index`, which moved by `motion` since the scan before."""
        self._pose = self._pose @ motion
        if self._map is None or np.linalg.norm(self._pose[:3, 3]) > _PIECE_LENGTH:
            self._close()
            self._start, self._pose, self._map = index, np.eye(4), PointMap(self._voxel_size)
        self._map.add(points, self._pose)

    def join(self, poses: list[Array]) -> NDArray[np.float32]:
        """Put every piece at the final pose of its first scan and return one cloud."""
        self._close()
        whole = PointMap(self._voxel_size)
        for start, points in self._done:
            whole.add(points.astype(np.float64), poses[start])
        return whole.points()

    def _close(self) -> None:
        if self._map is not None:
            self._done.append((self._start, self._map.points()))
            self._map = None


class _OdometryWatch:
    """Keeps the deskewed points of the last scan that went through an odometry, and its time."""

    def __init__(self, odometry: Any) -> None:
        self.deskewed: Array = np.empty((0, 3))
        self.elapsed_ms = 0.0
        self._register_frame = odometry.register_frame
        odometry.register_frame = self._register

    def _register(self, frame: Array, timestamps: Array) -> tuple[Array, Array]:
        start = time.perf_counter()
        self.deskewed, source = self._register_frame(frame, timestamps)
        self.elapsed_ms = 1e3 * (time.perf_counter() - start)
        return self.deskewed, source


def _import_kiss_slam() -> Any:
    try:
        import kiss_slam.config
        import kiss_slam.slam
    except ImportError as error:
        raise ConfigError(
            f"system=kiss_slam needs the kiss-slam package ({error}):"
            " run `pip install -e .[kiss-slam]` in the project's folder"
        ) from error
    return kiss_slam


def _record_factors(slam: Any) -> list[Edge]:
    """Have every factor that the SLAM adds to its graph noted down, and return the notes."""
    edges: list[Edge] = []
    add_factor = slam.optimizer.add_factor

    def add_and_note(source: int, target: int, T_target_source: Array, information: Array) -> None:
        add_factor(source, target, T_target_source, information)
        kind: EdgeKind = "odometry" if source == target + 1 else "loop"
        edges.append(Edge(int(target), int(source), T_target_source, np.eye(6), kind))

    slam.optimizer.add_factor = add_and_note
    return edges


def _silence_optimiser(slam: Any) -> None:
    optimize = slam.optimizer.optimize

    def optimize_silently() -> None:
        with _native_stderr_silenced():
            optimize()

    slam.optimizer.optimize = optimize_silently


@contextlib.contextmanager
def _native_stderr_silenced() -> Iterator[None]:
    """Drop what compiled code writes to the process's stderr: g2o reports each iteration there."""
    sys.stderr.flush()
    kept = os.dup(2)
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@contextlib.contextmanager
def _prints_to_log() -> Iterator[None]:
    """Send what the package prints to the log."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        yield
    for line in filter(None, map(str.strip, text.getvalue().splitlines())):
        _log.debug(line)
