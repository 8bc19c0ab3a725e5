"""The whole pipeline.

scan -> odometry -> keyframe -> pose graph <-> loop closures
                                    |
                                    v
                                 pruning -> map, trajectory
"""

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import ConfigError
from lifelong_slam.geometry import adjoint, invert
from lifelong_slam.graph.marginalisation import StarMesh
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.pruning import Pruner, Pruning
from lifelong_slam.graph.removal import Removal, RemovalLog, recover
from lifelong_slam.graph.selection import Everything
from lifelong_slam.loop_closure.closer import LoopCloser, relative_covariance
from lifelong_slam.mapping.keyframe import Keyframe, KeyframeSelector
from lifelong_slam.mapping.session import MapSession
from lifelong_slam.mapping.static_map import StaticMap, thin
from lifelong_slam.mapping.track import Track
from lifelong_slam.memory import kept
from lifelong_slam.odometry.odometry import Odometry, OdometryEstimate, Tracking
from lifelong_slam.odometry.tracking import TrackingLog
from lifelong_slam.result import Edge, GraphSnapshot, SlamResult, StageTimes
from lifelong_slam.scan import Scan

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

_NO_POINTS = np.zeros((0, 3), np.float32)


class LifelongSlam:
    """Odometry, loop closures and a pose graph as large as the place; poses are of the sensor.

    The newest keyframes form a window. Those that leave it have seen the loop closures that concern
    them: they are settled, which puts what they saw into the map and lets the graph do without those that
    it doesn't need. Every scan keeps a pose for ever: it hangs on its keyframes by odometry, and a
    removed keyframe hangs on the vertices that were around it.
    """

    def __init__(
        self,
        odometry: Odometry,
        loop_closer: LoopCloser,
        pruning: Pruning,
        static_map: StaticMap,
        keyframe_distance: float = 2.0,
        keyframe_rotation: float = 0.35,
        window: int = 40,
        settle_every: int = 10,
    ) -> None:
        """Put the stages together.

        Args:
            odometry: front end.
            loop_closer: proposes and verifies loop closures.
            pruning: keeps the graph small.
            static_map: the map of what keyframes saw.
            keyframe_distance: metres between keyframes.
            keyframe_rotation: radians between keyframes.
            window: how many of the newest keyframes aren't settled yet; together they should be
                as long as the map's range, so that a loop is closed before its ends meet in the map.
            settle_every: keyframes that leave the window at a time, after an optimisation.
        """
        self._odometry = odometry
        self._selector = KeyframeSelector(keyframe_distance, keyframe_rotation)
        self._loop_closer = loop_closer
        self._pruning = pruning
        self._static_map = static_map
        self._window_size = window
        self._settle_every = settle_every
        self._graph = PoseGraph()
        self._track = Track()
        self._tracking = TrackingLog()
        self._keyframes: dict[int, Keyframe] = {}  # those that are vertices
        self._window: list[int] = []
        self._removals = RemovalLog()
        self._session: MapSession | None = None
        self._map_points: NDArray[np.float32] | None = None  # of a map that stays as it is
        self._unsaved = _Unsaved()
        self._next_id = 0
        self._watched = -1  # newest keyframe that a viewer has seen
        # Covariance of the newest keyframe since the last closure.
        self._drift: Array = np.zeros((6, 6))

    @property
    def voxel_size(self) -> float:
        """Of the map, metres."""
        return self._static_map.voxel_size

    def begin(self, session: MapSession) -> None:
        """Go on from the map of a session, and write to it; before the first scan.

        Raises:
            ConfigError: the pruning can't be combined with a map file.
        """
        if not self._pruning.leaves_edges:
            raise ConfigError("what this pruning leaves has no place in a map file: choose another")
        self._session = session
        saved = session.take_saved()
        if saved is None:
            return
        self._next_id = saved.next_keyframe
        self._keyframes = dict(saved.keyframes)
        self._graph.restore(saved.poses, saved.edges, saved.rejected)
        self._static_map.restore(saved.voxels())
        keyframe_poses, hosts = saved.keyframe_poses(), saved.hosts()
        self._loop_closer.places.restore(saved.places, keyframe_poses, hosts)
        if session.localize:
            self._map_points = self._static_map.points(saved.poses)
            self._pruning = Pruner(Everything(), StarMesh())
            return
        unsettled = [i for i, keyframe in saved.keyframes.items() if len(keyframe.points)]
        for root in self._graph.roots:
            component = self._graph.component(root)
            hung = {i: host for i, host in hosts.items() if host in component}
            self._pruning.adopt(component - set(unsettled), keyframe_poses, hung)
        self._window = unsettled  # a session that was cut off
        self._graph.optimise()
        self._settle(len(unsettled))
        self._static_map.forget_views()

    def process(self, scan: Scan) -> StageTimes:
        """Take in one scan: odometry always, the graph and the map if it becomes a keyframe."""
        stages = _Stages()
        estimate = self._odometry.register(scan)
        self._tracking.update(scan, estimate)
        self._track.add(estimate.stamp, estimate.T_odom_sensor)
        stages.end("odometry_ms")
        if self._selector.takes(estimate):
            keyframe = self._add_keyframe(estimate)
            news = self._close_loops(keyframe, estimate)
            stages.end("loop_ms")
            due = len(self._window) >= self._window_size + self._settle_every
            if news or due:
                self._graph.optimise()
            stages.end("optimise_ms")
            if due:
                self._settle(self._settle_every)
            stages.end("prune_ms")
            self._save(self._track.scans_before_newest())
        return StageTimes(
            **stages.milliseconds, vertices=len(self._graph), edges=self._graph.edge_count
        )

    def finish(self) -> SlamResult:
        """Put all closures to the vote, settle the window, and return trajectory, map and graph.

        To be called once, after the last scan.
        """
        self._graph.optimise()
        for edge in self._loop_closer.look_back(self._keyframes, self._graph, count=None):
            self._graph.add_edge(edge)
        self._graph.optimise(reconsider=True)
        self._settle(len(self._window))
        self._save(self._track.scans_after_newest())
        poses = recover(self._graph.poses(), self._removals)
        graph = self._snapshot()
        return SlamResult(
            trajectory=self._track.trajectory(np.array([poses[i] for i in self._track.keyframes])),
            map_points=self._static_map.points(graph.poses)
            if self._map_points is None
            else self._map_points,
            graph=graph,
            tracking=self._tracking,
            doubts=tuple(self._doubts()),
            counts={
                **self._odometry.counts,
                **self._loop_closer.counts,
                "loop closures rejected": len(self._graph.rejected),
                "keyframes": len(self._track.keyframes),
                "keyframes pruned": len(self._removals),
                **self._pruning.counts,
                **self._end_session(),
            },
        )

    def watch(self) -> tuple[Array, GraphSnapshot | None]:
        """Return the newest (4, 4) T_map_sensor, and the graph where a keyframe has been added."""
        newest = self._track.keyframes[-1]
        news = newest != self._watched
        self._watched = newest
        T_map_sensor = self._graph.pose(newest) @ self._track.since_keyframe()
        return T_map_sensor, self._snapshot() if news else None

    @property
    def _session_id(self) -> int:
        return self._session.id if self._session else 0

    def _snapshot(self) -> GraphSnapshot:
        """Return the graph without other sessions that are in frames of their own."""
        own = [i for i in self._graph.vertices if self._keyframes[i].session == self._session_id]
        connected: set[int] = set()
        for vertex in own or self._graph.roots[:1]:
            if vertex not in connected:
                connected |= self._graph.component(vertex)
        return GraphSnapshot(
            {i: T for i, T in self._graph.poses().items() if i in connected},
            [edge for edge in self._graph.edges if edge.source in connected],
        )

    def _add_keyframe(self, estimate: OdometryEstimate) -> Keyframe:
        """Make a keyframe of the newest scan, and a vertex with its odometry."""
        T_map_sensor = np.eye(4)
        if estimate.tracking is Tracking.STARTED and self._window:
            T_map_sensor = self._graph.pose(self._window[-1]) @ self._track.since_keyframe()
            self._part()
        last = self._keyframes[self._window[-1]] if self._window else None
        keyframe = Keyframe(
            id=self._next_id,
            session=self._session_id,
            stamp=estimate.stamp,
            T_odom_sensor=estimate.T_odom_sensor,
            covariance=estimate.covariance,
            travelled=self._track.travelled,
            features=kept(estimate.cloud.positions.astype(np.float32)),
            points=kept(thin(estimate.points, self._static_map.voxel_size)),
        )
        self._next_id += 1
        self._keyframes[keyframe.id] = keyframe
        self._window.append(keyframe.id)
        self._track.mark_keyframe(keyframe.id, starts=last is None)
        if last is None:
            self._graph.add_vertex(keyframe.id, T_map_sensor)
        else:
            motion = invert(last.T_odom_sensor) @ keyframe.T_odom_sensor
            covariance = relative_covariance(last, keyframe, motion)
            self._graph.add_odometry(Edge(last.id, keyframe.id, motion, covariance, "odometry"))
            A = adjoint(invert(motion))
            self._drift = A @ self._drift @ A.T + covariance
        return keyframe

    def _part(self) -> None:
        """Settle all that was driven, as odometry doesn't lead from there to the newest scan.

        What follows is a component of its own, which a loop closure may join to the others.
        """
        self._graph.optimise()
        self._settle(len(self._window))
        self._loop_closer.part()
        self._drift = np.zeros((6, 6))

    def _close_loops(self, keyframe: Keyframe, estimate: OdometryEstimate) -> bool:
        """Look for loop closures; tell whether one is news to the graph."""
        sigma = float(np.sqrt(np.linalg.eigvalsh(self._drift[3:, 3:])[-1]))
        again = self._loop_closer.look_back(self._keyframes, self._graph)
        edges = self._loop_closer.close(
            keyframe, estimate.cloud, self._keyframes, self._graph, sigma
        )
        news = False
        for edge in (*again, *edges):
            news |= self._graph.is_news(edge)
            if edge.target in self._graph.component(edge.source):
                self._graph.add_edge(edge)
            else:
                self._graph.join(edge)
        if edges:
            self._drift = edges[-1].covariance
        return news

    def _settle(self, count: int) -> None:
        """Let the oldest of the window into the map, and prune the graph; it is at its optimum."""
        leaving, self._window = self._window[:count], self._window[count:]
        if not leaving:
            return
        around = self._graph.component(leaving[0]) - set(self._window)
        poses = {vertex: self._graph.pose(vertex) for vertex in sorted(around)}
        removals = self._pruning.settle(self._graph, leaving)
        removed = [removal.vertex for removal in removals]
        lasting = {vertex: T for vertex, T in poses.items() if vertex in self._graph}
        if self._map_points is None:
            for vertex in removed:
                self._static_map.rehome(vertex, {vertex: poses[vertex], **lasting})
            keyframes = [self._keyframes[vertex] for vertex in leaving]
            self._static_map.settle(keyframes, [poses[vertex] for vertex in leaving], lasting)
        for vertex in leaving:
            self._keyframes[vertex] = replace(self._keyframes[vertex], points=_NO_POINTS)
        self._loop_closer.places.rehome(removed, poses, lasting)
        for vertex in removed:
            del self._keyframes[vertex]
        self._removals.extend(removals)
        self._unsaved.removals += removals
        self._unsaved.settled += leaving

    def _save(self, scans: tuple[int, NDArray[np.int64], Array] | None) -> None:
        """Write what the newest keyframe changed to the map's file."""
        unsaved, self._unsaved = self._unsaved, _Unsaved()
        if self._session is None:
            return
        changed = self._static_map.take_changed()
        self._session.write(
            graph=self._graph,
            vertices=self._keyframes,
            scans=[scans] if scans else [],
            removals=unsaved.removals,
            settled=unsaved.settled,
            submaps={i: self._static_map.submaps[i] for i in changed},
            places=self._loop_closer.places.take_new(),
        )

    def _doubts(self) -> Iterator[str]:
        if doubt := self._graph.doubt:
            yield doubt
        if self._session is not None and self._session.localize and not self._session.is_located:
            yield "the session was not located in the map that it was to be localised in"

    def _end_session(self) -> dict[str, int]:
        """Mark the session in the map's file as done; return whether it is located in the map."""
        if self._session is None:
            return {}
        self._session.end()
        if not self._session.is_located:
            logger.warning(
                "this session was not located in the map: it stays apart, in a frame of its own"
                " (drive where the map is for 30 m or more, or start there)"
            )
        return {"located in the map": int(self._session.is_located)}


@dataclass
class _Unsaved:
    """What happened since the map's file was last written."""

    removals: list[Removal] = field(default_factory=list)
    settled: list[int] = field(default_factory=list)


class _Stages:
    """Stopwatch for the stages of one scan."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.milliseconds: dict[str, float] = {}

    def end(self, stage: str) -> None:
        """Note the time since the last stage ended."""
        now = time.perf_counter()
        self.milliseconds[stage] = 1e3 * (now - self._last)
        self._last = now
