"""What a map file holds, and what a keyframe changes in it. Everything is in the sensor's frame."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import MapError
from lifelong_slam.graph.removal import Removal, recover
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.mapping.submap import Submap
from lifelong_slam.result import Edge, GraphSnapshot
from lifelong_slam.trajectory import Trajectory

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[np.generic]]


@dataclass(frozen=True, slots=True)
class MapInfo:
    """What holds for a map as a whole, whatever the session.

    Attributes:
        sensor: name of its settings.
        T_base_sensor: (4, 4) pose of the sensor on the base.
        voxel_size: metres, of the submaps' voxels.
        created: nanoseconds since 1970.
        version: of lifelong_slam that made the file.
    """

    sensor: str
    T_base_sensor: Array
    voxel_size: float
    created: int
    version: str


@dataclass(frozen=True, slots=True)
class Session:
    """One run that added to the map.

    Attributes:
        id: counts from 0.
        started: nanoseconds since 1970, by the clock of the machine.
        source: name of what the scans came from.
        config: of the run, YAML.
        finished: False if the run was killed, or still goes on.
        located: whether a loop closure joins it to earlier sessions; the first one always is.
    """

    id: int
    started: int
    source: str
    config: str
    finished: bool
    located: bool


@dataclass(frozen=True, slots=True)
class Scans:
    """Successive scans that hang on one keyframe.

    Attributes:
        session: that they belong to.
        anchor: keyframe, which may have been removed.
        stamps: (N,) int64 nanoseconds.
        T_anchor_scan: (N, 4, 4).
    """

    session: int
    anchor: int
    stamps: NDArray[np.int64]
    T_anchor_scan: Array


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """All that one keyframe changes in the map; written as a whole or not at all.

    Attributes:
        keyframes: new vertices.
        poses: T_map_vertex (4, 4) of the new vertices, and of others that moved.
        removed: vertices that leave the graph, in this order; their clouds and submaps go.
        edges: new or changed edges by id; ids are the graph's own.
        removed_edges: their ids.
        rejected: ids of all loop closures that are rejected now, or None if these are as before.
        scans: new ones.
        settled: vertices whose points are in a submap from now on; their points go.
        submaps: new or changed arrays of voxels by owner.
        places: new local maps for place recognition, by keyframe: (N, 3) points in its frame.
        removed_places: keyframes whose local maps go.
        located: sessions that a loop closure has joined to earlier ones.
    """

    keyframes: Sequence[Keyframe] = ()
    poses: Mapping[int, Array] = field(default_factory=dict)
    removed: Sequence[Removal] = ()
    edges: Mapping[int, Edge] = field(default_factory=dict)
    removed_edges: Collection[int] = ()
    rejected: Collection[int] | None = None
    scans: Sequence[Scans] = ()
    settled: Collection[int] = ()
    submaps: Mapping[int, Mapping[str, NDArray[np.generic]]] = field(default_factory=dict)
    places: Mapping[int, NDArray[np.float32]] = field(default_factory=dict)
    removed_places: Collection[int] = ()
    located: Collection[int] = ()


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map file's content.

    Attributes:
        info: what holds for all of it.
        sessions: in their order.
        keyframes: vertices of the graph by id; those settled have no points.
        poses: T_map_vertex (4, 4) by vertex.
        edges: by id, rejected ones among them.
        rejected: ids of edges that are rejected.
        removals: of all other keyframes ever taken, in the order in which they were made.
        scans: every scan ever taken, in the order of writing.
        submaps: arrays of voxels by owner.
        places: (N, 3) float32 local maps by keyframe, which may have been removed.
    """

    info: MapInfo
    sessions: list[Session]
    keyframes: dict[int, Keyframe]
    poses: dict[int, Array]
    edges: dict[int, Edge]
    rejected: frozenset[int]
    removals: list[Removal]
    scans: list[Scans]
    submaps: dict[int, Arrays]
    places: dict[int, NDArray[np.float32]]

    def voxels(self) -> dict[int, Submap]:
        """Return the submaps by owner."""
        return {i: Submap(**arrays) for i, arrays in self.submaps.items()}  # type: ignore[arg-type]

    @property
    def next_keyframe(self) -> int:
        """The lowest id above those of all keyframes ever taken."""
        return max([-1, *self.poses, *(removal.vertex for removal in self.removals)]) + 1

    def of_sessions(self, sessions: Collection[int]) -> "SavedMap":
        """Return what some of the sessions added, as far as it is still there.

        Raises:
            MapError: there is no such session.
        """
        if unknown := set(sessions) - {session.id for session in self.sessions}:
            raise MapError(
                f"the map has no session {min(unknown)}, only {len(self.sessions)} from 0"
            )
        keyframes = {i: k for i, k in self.keyframes.items() if k.session in sessions}
        return replace(
            self,
            sessions=[session for session in self.sessions if session.id in sessions],
            keyframes=keyframes,
            edges={i: e for i, e in self.edges.items() if {e.source, e.target} <= keyframes.keys()},
            scans=[scans for scans in self.scans if scans.session in sessions],
            submaps={i: arrays for i, arrays in self.submaps.items() if i in keyframes},
        )

    def graph(self) -> GraphSnapshot:
        """Return the pose graph, without rejected edges."""
        edges = [edge for i, edge in self.edges.items() if i not in self.rejected]
        return GraphSnapshot({i: self.poses[i] for i in self.keyframes}, edges)

    def keyframe_poses(self) -> dict[int, Array]:
        """Return T_map_keyframe (4, 4) of every keyframe ever taken.

        Raises:
            MapError: one hangs on what is neither a vertex nor removed later.
        """
        try:
            return recover(self.poses, self.removals)
        except LookupError as error:
            raise MapError(str(error)) from error

    def hosts(self) -> dict[int, int]:
        """Return the vertex that each keyframe ever taken is, or hangs on most of all in the end."""
        hosts = {vertex: vertex for vertex in self.poses}
        for removal in reversed(self.removals):
            hosts[removal.vertex] = hosts[int(removal.neighbours[0])]
        return hosts

    def trajectory(self) -> Trajectory:
        """Return T_map_sensor at every scan in the order of time.

        Raises:
            MapError: two scans have the same stamp, or `keyframe_poses` fails.
        """
        poses = self.keyframe_poses()
        stamps = np.concatenate([np.zeros(0, np.int64), *(s.stamps for s in self.scans)])
        T = [poses[s.anchor] @ s.T_anchor_scan for s in self.scans]
        order = np.argsort(stamps, kind="stable")
        if np.any(np.diff(stamps[order]) == 0):
            raise MapError("scans of different sessions have the same stamps: choose one session")
        return Trajectory(stamps[order], np.concatenate([np.zeros((0, 4, 4)), *T])[order])
