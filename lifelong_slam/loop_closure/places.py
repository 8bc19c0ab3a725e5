"""The places of a map that can be recognised, each hung on a vertex of the graph."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import invert, rotation_angle
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.loop_closure.relocalisation import (
    LOCAL_MAP_SPACING,
    LocalMap,
    Location,
    Relocaliser,
    SessionLocator,
)

Array = NDArray[np.float64]

_SAME_VIEW = 0.5  # rad
_EARLIER = -1  # session of the places that a map came with


@dataclass(frozen=True, slots=True)
class _Anchor:
    """Where a place is; the keyframe that it was seen from may be gone."""

    vertex: int
    T_vertex_place: Array
    session: int
    travelled: float


class Places:
    """Recognises local maps, and grows with the place: where there is one already, none is added."""

    def __init__(self, voxel_size: float, min_travel: float) -> None:
        """Set up without places.

        Args:
            voxel_size: of the clouds that are registered, metres.
            min_travel: metres to drive before a place counts as revisited.
        """
        self._relocaliser = Relocaliser(voxel_size)
        self._locator = SessionLocator(max_offset=2 * voxel_size)
        self._min_travel = min_travel
        self._anchors: dict[int, _Anchor] = {}
        self._new: dict[int, NDArray[np.float32]] = {}

    def restore(
        self,
        places: Mapping[int, NDArray[np.float32]],
        poses: Mapping[int, Array],
        hosts: Mapping[int, int],
    ) -> None:
        """Take in the places of earlier sessions.

        Args:
            places: (N, 3) local maps by the keyframe whose frame they are in.
            poses: (4, 4) T_map_keyframe of these keyframes and of their hosts.
            hosts: the vertex that each of them hangs on, or is.
        """
        for place, points in places.items():
            host = hosts[place]
            T_host_place = invert(poses[host]) @ poses[place]
            self._anchors[place] = _Anchor(host, T_host_place, _EARLIER, 0.0)
            self._relocaliser.add_place(place, points)

    def part(self) -> None:
        """Take note that odometry doesn't lead from the local maps before to those that follow."""
        self._locator.clear()

    def anchor(self, place: int) -> tuple[int, Array]:
        """Return the vertex that a place hangs on, and the place's (4, 4) pose in its frame."""
        anchor = self._anchors[place]
        return anchor.vertex, anchor.T_vertex_place

    def rehome(
        self, removed: Collection[int], poses: Mapping[int, Array], lasting: Mapping[int, Array]
    ) -> None:
        """Hang the places of vertices that the graph has removed on the nearest that stay.

        Args:
            removed: ids of the vertices.
            poses: their (4, 4) T_map_vertex, others may be among them.
            lasting: (4, 4) T_map_vertex of those that stay, in the same component.
        """
        for place, anchor in self._anchors.items():
            if anchor.vertex in removed:
                T_map_place = poses[anchor.vertex] @ anchor.T_vertex_place
                self._anchors[place] = _hung(T_map_place, lasting, anchor.session, anchor.travelled)

    def take_new(self) -> dict[int, NDArray[np.float32]]:
        """Return the local maps that were added since the last call, by keyframe."""
        new, self._new = self._new, {}
        return new

    def locate(
        self, query: LocalMap, graph: PoseGraph, reachable: Collection[int]
    ) -> list[Location]:
        """Return where the graph's places put a local map; none if that isn't certain.

        In the query's own component one place is enough. In another one, where nothing else speaks
        for it, two local maps must agree.

        Args:
            query: a local map around a vertex.
            graph: that the places hang on.
            reachable: the vertices of the query's component.
        """
        old = {
            i
            for i, anchor in self._anchors.items()
            if anchor.vertex not in reachable or self._is_old(anchor, query)
        }
        locations = self._relocaliser.locate(query, old)
        inside = [at for at in locations if self._anchors[at.reference_id].vertex in reachable]
        if inside:
            return inside[:1]
        return self._locator.agreeing(
            self._in_oldest_component(locations, graph), lambda place: self._pose(place, graph)
        )

    def add(self, local_map: LocalMap, graph: PoseGraph, reachable: Collection[int]) -> None:
        """Keep a local map if its component has no place there that looks the same way."""
        here = local_map.reference
        T_map_here = graph.pose(here.id)
        for place, anchor in self._anchors.items():
            if anchor.vertex in reachable:
                motion = invert(self._pose(place, graph)) @ T_map_here
                near = np.linalg.norm(motion[:3, 3]) < 0.9 * LOCAL_MAP_SPACING
                if near and rotation_angle(motion) < _SAME_VIEW:
                    return
        self._anchors[here.id] = _Anchor(here.id, np.eye(4), here.session, here.travelled)
        self._relocaliser.add_place(here.id, local_map.points)
        self._new[here.id] = local_map.points

    def _in_oldest_component(self, locations: list[Location], graph: PoseGraph) -> list[Location]:
        """Return those in one frame: sessions that were never located may show the same place."""
        for root in graph.roots:
            connected = graph.component(root)
            inside = [at for at in locations if self._anchors[at.reference_id].vertex in connected]
            if inside:
                return inside
        return []

    def _pose(self, place: int, graph: PoseGraph) -> Array:
        anchor = self._anchors[place]
        pose: Array = graph.pose(anchor.vertex) @ anchor.T_vertex_place
        return pose

    def _is_old(self, anchor: _Anchor, query: LocalMap) -> bool:
        """Tell whether a place was left long enough before the query."""
        if anchor.session != query.reference.session:
            return True
        return query.reference.travelled - anchor.travelled >= self._min_travel


def _hung(
    T_map_place: Array, vertices: Mapping[int, Array], session: int, travelled: float
) -> _Anchor:
    """Hang a place on the nearest vertex."""
    positions = np.array([T[:3, 3] for T in vertices.values()])
    nearest = int(np.argmin(np.linalg.norm(positions - T_map_place[:3, 3], axis=1)))
    vertex = list(vertices)[nearest]
    return _Anchor(vertex, invert(vertices[vertex]) @ T_map_place, session, travelled)
