"""Watch a run: a viewer hears of every scan; the stub ignores it all, Rerun's records a file."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import ConfigError
from lifelong_slam.geometry import to_quaternion
from lifelong_slam.result import GraphSnapshot

Array = NDArray[np.float64]

_SCAN, _PATH = [90, 170, 255], [60, 200, 120]
_EDGES = {"odometry": [150, 150, 150], "loop": [235, 95, 20], "composed": [160, 80, 200]}
_PIECE = 200  # poses in one piece of the path


class Viewer(Protocol):
    """Whoever shows a run while it goes on."""

    def update(
        self, stamp: int, T_map_sensor: Array, points: Array, graph: GraphSnapshot | None
    ) -> None:
        """Show one scan.

        Args:
            stamp: the pose's instant, integer nanoseconds.
            T_map_sensor: (4, 4) pose.
            points: (N, 3) metres, sensor frame.
            graph: the pose graph, where it has changed since the last scan.
        """
        ...

    def close(self) -> None:
        """Finish; nothing follows."""
        ...


class StubViewer:
    """Shows nothing."""

    def update(
        self, stamp: int, T_map_sensor: Array, points: Array, graph: GraphSnapshot | None
    ) -> None:
        """Ignore the scan."""

    def close(self) -> None:
        """Do nothing."""


class RerunViewer:
    """Records a run for the Rerun viewer, without opening a window; `rerun FILE.rrd` shows it."""

    def __init__(self, path: str, max_points: int = 20_000) -> None:
        """Start a recording.

        Args:
            path: the .rrd file to write; its folder is made.
            max_points: points of a scan to record, evenly picked.

        Raises:
            ConfigError: rerun-sdk is not installed.
        """
        self._rr = _import_rerun()
        self._max_points = max_points
        self._steps: list[Array] = []
        self._piece = 0
        self._start: int | None = None
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        self._recording = self._rr.RecordingStream("lifelong_slam")
        self._recording.save(path)
        self._recording.log("map", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def update(
        self, stamp: int, T_map_sensor: Array, points: Array, graph: GraphSnapshot | None
    ) -> None:
        """Record pose, scan and path, and the graph if there is one."""
        rr = self._rr
        self._start = stamp if self._start is None else self._start
        self._recording.set_time("run", duration=np.timedelta64(stamp - self._start, "ns"))
        self._recording.set_time("stamp", timestamp=np.datetime64(stamp, "ns"))
        pose = rr.Transform3D(
            translation=T_map_sensor[:3, 3],
            quaternion=rr.Quaternion(xyzw=to_quaternion(T_map_sensor)),
        )
        self._recording.log("map/sensor", pose)
        chosen = points[:: -(-len(points) // self._max_points) or 1]
        self._recording.log("map/sensor/scan", rr.Points3D(chosen, radii=0.03, colors=_SCAN))
        self._log_path(T_map_sensor[:3, 3])
        if graph is not None:
            self._log_graph(graph)

    def close(self) -> None:
        """Write what is buffered and end the recording."""
        self._recording.flush()
        self._recording.disconnect()

    def _log_path(self, position: Array) -> None:
        """Record the path in pieces: all of it at every scan would grow with the square of time."""
        self._steps.append(position)
        strip = self._rr.LineStrips3D([self._steps], colors=_PATH, radii=0.03)
        self._recording.log(f"map/path/{self._piece:05d}", strip)
        if len(self._steps) == _PIECE:
            self._steps = [position]
            self._piece += 1

    def _log_graph(self, graph: GraphSnapshot) -> None:
        """Record keyframes as points and edges as lines, each kind in its own colour."""
        rr = self._rr
        positions = [pose[:3, 3] for pose in graph.poses.values()]
        self._recording.log("map/graph/keyframes", rr.Points3D(positions, radii=0.15, colors=_PATH))
        for kind, colour in _EDGES.items():
            lines = [
                [graph.poses[edge.source][:3, 3], graph.poses[edge.target][:3, 3]]
                for edge in graph.edges
                if edge.kind == kind
            ]
            strips = rr.LineStrips3D(lines, colors=colour, radii=0.04)
            self._recording.log(f"map/graph/{kind}", strips)


def _import_rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise ConfigError(
            "viewer=rerun needs rerun-sdk: pip install 'lifelong-slam[rerun]'"
        ) from error
    return rerun
