"""From a new keyframe to verified loop closures."""

import logging
from collections import Counter
from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import adjoint, invert
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.loop_closure.places import Places
from lifelong_slam.loop_closure.relocalisation import LocalMap, LocalMapBuilder, Location
from lifelong_slam.loop_closure.verification import Verdict, Verifier
from lifelong_slam.mapping.keyframe import Keyframe, submap
from lifelong_slam.odometry.odometry import OdometryEstimate
from lifelong_slam.registration import Cloud
from lifelong_slam.result import Edge

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

_SUBMAP_SIZE = 7  # keyframes around the candidate that make up the submap
_SUBMAP_RADIUS = 13.0  # metres around the candidate that they come from
_OVERLAP = 100.0  # metres of path; nearer local maps show the same by odometry already
_LOOK_EVERY = 40.0  # metres without a closure after which appearance is asked
_AT_A_TIME = 2  # keyframes of a stretch that are looked at again for each new one
_MAX_TURN = 1.0  # rad; among candidates, those that look the same way are preferred by this scale


class LoopCloser:
    """Proposes places that the newest keyframe may have returned to, and verifies them.

    Proposals come from the graph where its uncertainty says which vertices are in reach, and from
    appearance wherever no closure has confirmed it for a while. A session that begins in a saved map is
    located in it by appearance.

    A closure after a long way moves what was driven since the last one, which may then be within reach of
    places that it wasn't before. That stretch is searched again, a few keyframes at a time.
    """

    def __init__(
        self,
        voxel_size: float,
        min_travel: float = 40.0,
        spacing: float = 8.0,
        min_reach: float = 6.0,
        max_reach: float = 20.0,
        min_overlap: float = 0.5,
        max_residual: float = 0.06,
        min_degeneracy: float = 0.01,
    ) -> None:
        """Set up.

        Args:
            voxel_size: of the clouds that are registered, metres.
            min_travel: metres to drive before a place counts as revisited.
            spacing: metres to drive between two attempts by place.
            min_reach: metres around the estimate that are searched however certain it is.
            max_reach: metres beyond which only appearance is trusted to propose.
            min_overlap: see Verifier, as the next two.
            max_residual: metres.
            min_degeneracy: ratio.
        """
        self._verifier = Verifier(voxel_size, min_overlap, max_residual, min_degeneracy)
        self._local_maps = LocalMapBuilder(voxel_size)
        self._min_travel = min_travel
        self._spacing = spacing
        self._reach = (min_reach, max_reach)
        self._last_attempt = 0.0
        self._confirmed = 0.0  # metres travelled up to the last closure
        self._last_look = 0.0  # metres travelled when appearance was asked last
        self._attempts: list[float] = []  # metres travelled at attempts by place since then
        self._stretch: list[int] = []  # keyframes that a closure has moved, to be looked at again
        self.places = Places(voxel_size, max(min_travel, _OVERLAP))
        self.counts: Counter[str] = Counter()

    def part(self) -> None:
        """Take note that odometry doesn't lead from the keyframes before to those that follow."""
        self._local_maps.clear()
        self.places.part()

    def close(
        self,
        query: Keyframe,
        cloud: Cloud,
        keyframes: Mapping[int, Keyframe],
        graph: PoseGraph,
        sigma: float,
    ) -> list[Edge]:
        """Take in a keyframe and return the verified loop closures that it gives rise to.

        Args:
            query: the newest keyframe, a vertex of the graph.
            cloud: its points, ready for registration.
            keyframes: of all vertices.
            graph: where they are.
            sigma: standard deviation of the query's position since the last closure, metres.
        """
        reachable = graph.component(query.id)
        edges: list[Edge] = []
        if query.travelled - self._last_attempt >= self._spacing:
            old = self._older(query, keyframes, reachable)
            edges += self._by_place(query, cloud, old, graph, sigma)
        local_map = self._local_maps.add(query)
        if local_map is not None and local_map.reference.id in graph:
            edges += self._by_appearance(local_map, query, keyframes, graph, reachable)
        if edges:
            self._stretch += self._since_confirmed(query, keyframes)
            self._attempts = []
            self._confirmed = query.travelled
        return edges

    def look_back(
        self,
        keyframes: Mapping[int, Keyframe],
        graph: PoseGraph,
        count: int | None = _AT_A_TIME,
    ) -> list[Edge]:
        """Look for closures again along what earlier ones have moved, and return those that are verified.

        Args:
            keyframes: of all vertices.
            graph: where they are, optimised with the closures so far.
            count: keyframes at most that are tried; None: all that are left.
        """
        edges: list[Edge] = []
        while self._stretch and count != 0:
            keyframe = keyframes.get(self._stretch.pop())
            if keyframe is None:  # pruned meanwhile
                continue
            old = self._older(keyframe, keyframes, graph.component(keyframe.id))
            if best := _nearest(old, graph, graph.pose(keyframe.id), self._reach[0], 1):
                cloud = Cloud.prepare(
                    keyframe.features.astype(np.float64), self._verifier.voxel_size
                )
                edges += self._registered(keyframe, cloud, best[0], old, graph)
                count = None if count is None else count - 1
        self.counts["loop in hindsight"] += len(edges)
        return edges

    def _since_confirmed(self, query: Keyframe, keyframes: Mapping[int, Keyframe]) -> list[int]:
        """Return keyframes since the last closure, a spacing from each other and from attempts."""
        tried = [*self._attempts, query.travelled]
        chosen = []
        for keyframe in sorted(keyframes.values(), key=lambda keyframe: keyframe.travelled):
            own = keyframe.session == query.session
            if own and self._confirmed < keyframe.travelled < query.travelled:
                apart = np.abs(np.array(tried) - keyframe.travelled)
                if apart.min() >= self._spacing:
                    chosen.append(keyframe.id)
                    tried.append(keyframe.travelled)
        return chosen

    def _older(
        self, query: Keyframe, keyframes: Mapping[int, Keyframe], reachable: Collection[int]
    ) -> list[Keyframe]:
        """Return the keyframes in the query's frame that were left long enough before it."""
        return [k for i, k in keyframes.items() if i in reachable and self._is_old(k, query)]

    def _by_place(
        self, query: Keyframe, cloud: Cloud, old: list[Keyframe], graph: PoseGraph, sigma: float
    ) -> list[Edge]:
        """Register the query to the old keyframes around the best one within reach."""
        here = graph.pose(query.id)
        reach = float(np.clip(3 * sigma, *self._reach))
        best = _nearest(old, graph, here, reach, 1)
        if not best:
            return []
        self._last_attempt = query.travelled
        self._attempts.append(query.travelled)
        return self._registered(query, cloud, best[0], old, graph)

    def _registered(
        self, query: Keyframe, cloud: Cloud, best: Keyframe, old: list[Keyframe], graph: PoseGraph
    ) -> list[Edge]:
        """Register the query to the old keyframes around one of them; return the closure if verified."""
        here, centre = graph.pose(query.id), graph.pose(best.id)
        around = _nearest(old, graph, centre, _SUBMAP_RADIUS, _SUBMAP_SIZE)
        target = submap(around, [graph.pose(k.id) for k in around], centre)
        verdict, result = self._verifier.verify(target, cloud, [invert(centre) @ here])
        self.counts[f"loop by place: {verdict}"] += 1
        logger.info(
            "loop %d -> %d by place: %s (overlap %.2f, residual %.3f m, degeneracy %.3f)",
            query.id, best.id, verdict,
            result.overlap, result.residual, result.degeneracy,
        )  # fmt: skip
        if verdict is not Verdict.ACCEPTED:
            return []
        T = result.T_target_source
        covariance = result.covariance + relative_covariance(best, query, T)
        return [Edge(best.id, query.id, T, covariance, "loop")]

    def _by_appearance(
        self,
        local_map: LocalMap,
        query: Keyframe,
        keyframes: Mapping[int, Keyframe],
        graph: PoseGraph,
        reachable: Collection[int],
    ) -> list[Edge]:
        """Look for a local map among the places, unless closures tell where it is; keep a new one."""
        locations: list[Location] = []
        unlocated = len(reachable) < len(graph)
        unsure = query.travelled - max(self._confirmed, self._last_look) >= _LOOK_EVERY
        if unlocated or unsure:
            self._last_look = query.travelled
            locations = self.places.locate(local_map, graph, reachable)
            self.counts["loop by appearance"] += len(locations)
        self.places.add(local_map, graph, reachable)
        return [self._located(at, keyframes) for at in locations if at.query.id in graph]

    def _located(self, at: Location, keyframes: Mapping[int, Keyframe]) -> Edge:
        """Return the loop closure that puts a local map's keyframe to where it was recognised."""
        vertex, T_vertex_place = self.places.anchor(at.reference_id)
        T = T_vertex_place @ at.registration.T_target_source
        ends = relative_covariance(keyframes[vertex], at.query, T)
        return Edge(vertex, at.query.id, T, at.registration.covariance + ends, "loop")

    def _is_old(self, keyframe: Keyframe, query: Keyframe) -> bool:
        """Tell whether a keyframe was left long enough before the query."""
        if keyframe.session != query.session:
            return True
        return query.travelled - keyframe.travelled >= self._min_travel


def _nearest(
    keyframes: list[Keyframe], graph: PoseGraph, here: Array, reach: float, count: int
) -> list[Keyframe]:
    """Return those within reach that are nearest in place and viewing direction, the best first."""
    if not keyframes:
        return []
    T = np.array([graph.pose(keyframe.id) for keyframe in keyframes])
    distance = np.linalg.norm(T[:, :3, 3] - here[:3, 3], axis=1)
    turn = np.arccos(np.clip(T[:, :3, 0] @ here[:3, 0], -1, 1))
    cost = np.where(distance <= reach, distance / reach + turn / _MAX_TURN, np.inf)
    order = np.argsort(cost, kind="stable")[:count]
    return [keyframes[i] for i in order if np.isfinite(cost[i])]


def relative_covariance(
    source: Keyframe | OdometryEstimate,
    target: Keyframe | OdometryEstimate,
    T_source_target: Array,
) -> Array:
    """Return the (6, 6) covariance, in the target's frame, that the errors of both ends cause."""
    A = adjoint(invert(T_source_target))
    covariance: Array = A @ source.covariance @ A.T + target.covariance
    return covariance
