"""What a SLAM system hands over at the end of a run; everything is in the sensor's frame."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.odometry.tracking import TrackingLog
from lifelong_slam.trajectory import Trajectory

EdgeKind = Literal["odometry", "loop", "composed"]


@dataclass(frozen=True, slots=True)
class Edge:
    """A measured relative pose between two vertices.

    Attributes:
        source: vertex whose frame the measurement is expressed in.
        target: vertex that was measured.
        T_source_target: (4, 4) pose of the target in the source's frame.
        covariance: (6, 6), tangent order rotation (rad) then translation (m), in the target's frame
            (GTSAM's convention for a BetweenFactor).
        kind: odometry; a loop closure; or composed of several measurements, of which at least one was a
            closure. What isn't odometry can be outvoted.
    """

    source: int
    target: int
    T_source_target: NDArray[np.float64]
    covariance: NDArray[np.float64]
    kind: EdgeKind


@dataclass(frozen=True, slots=True)
class Prior:
    """A measured pose of a vertex in the map frame, of GPS or a surveyed point for example.

    Attributes:
        vertex: that was measured.
        T_map_vertex: (4, 4) its measured pose.
        covariance: (6, 6), tangent order rotation (rad) then translation (m), in the vertex's frame.
    """

    vertex: int
    T_map_vertex: NDArray[np.float64]
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GraphSnapshot:
    """Vertices and edges of a pose graph at one moment.

    Attributes:
        poses: T_map_vertex (4, 4) by vertex id.
        edges: measurements between them; rejected loop closures are not among them.
        fixed: vertices that stay exactly where they are.
        priors: measured poses of vertices.
        planar: all poses lie in a plane (z, roll and pitch zero), and only what lies in it was measured.
    """

    poses: dict[int, NDArray[np.float64]]
    edges: list[Edge]
    fixed: tuple[int, ...] = ()
    priors: tuple[Prior, ...] = ()
    planar: bool = False


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Where the time of one scan went, and the size of the graph after it."""

    odometry_ms: float = 0.0
    loop_ms: float = 0.0
    optimise_ms: float = 0.0
    prune_ms: float = 0.0
    vertices: int = 0
    edges: int = 0


@dataclass(frozen=True, slots=True)
class SlamResult:
    """The outcome of a run.

    Attributes:
        trajectory: T_map_sensor at every scan, at the instant of the sweep's last point.
        map_points: (M, 3) float32, metres, static points in the map frame.
        graph: the final pose graph.
        counts: whatever the system counted, e.g. loop closures accepted and rejected by reason.
        tracking: what the poses rest on, of a system that knows.
        doubts: what the system itself says against its result, a sentence each.
    """

    trajectory: Trajectory
    map_points: NDArray[np.float32]
    graph: GraphSnapshot
    counts: dict[str, int] = field(default_factory=dict)
    tracking: TrackingLog | None = None
    doubts: tuple[str, ...] = ()
