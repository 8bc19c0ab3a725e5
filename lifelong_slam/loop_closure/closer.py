"""From a new keyframe to verified loop closures."""

import logging
from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import adjoint, invert
from lifelong_slam.loop_closure.appearance import PlaceRecogniser
from lifelong_slam.loop_closure.verification import Verdict, Verifier
from lifelong_slam.mapping.keyframe import Keyframe, submap
from lifelong_slam.odometry.odometry import OdometryEstimate
from lifelong_slam.registration import Cloud
from lifelong_slam.result import Edge

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

_SUBMAP_REACH = 3  # keyframes before and after the candidate that make up the submap
_MAX_TURN = 1.0  # rad; among candidates, those that look the same way are preferred by this scale


class LoopCloser:
    """Proposes places that the newest keyframe may have returned to, and verifies them.

    Proposals come from the graph where its uncertainty says which places are in reach, and from
    appearance for every completed local map, whatever the drift.
    """

    def __init__(
        self,
        voxel_size: float,
        min_travel: float = 40.0,
        spacing: float = 8.0,
        min_reach: float = 6.0,
        max_reach: float = 20.0,
        local_map_length: float = 50.0,
        density_resolution: float = 0.5,
        min_inliers: int = 10,
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
            local_map_length: metres of path that a local map for place recognition covers.
            density_resolution: metres a pixel in place recognition.
            min_inliers: features that two local maps must share.
            min_overlap: see Verifier, as the next two.
            max_residual: metres.
            min_degeneracy: ratio.
        """
        self._verifier = Verifier(voxel_size, min_overlap, max_residual, min_degeneracy)
        self._recogniser = PlaceRecogniser(local_map_length, density_resolution, min_inliers)
        self._voxel_size = voxel_size
        self._min_travel = min_travel
        self._spacing = spacing
        self._reach = (min_reach, max_reach)
        self._keyframes: list[Keyframe] = []
        self._index: dict[int, int] = {}
        self._last_attempt = 0.0
        self.counts: Counter[str] = Counter()

    def close(
        self, keyframe: Keyframe, cloud: Cloud, pose: Callable[[int], Array], sigma: float
    ) -> list[Edge]:
        """Take in a keyframe and return the verified loop closures that it gives rise to.

        Args:
            keyframe: the newest one.
            cloud: its points, ready for registration.
            pose: current (4, 4) T_map_vertex of a vertex; the keyframe's own included.
            sigma: standard deviation of the keyframe's position since the last closure, metres.
        """
        self._index[keyframe.id] = len(self._keyframes)
        self._keyframes.append(keyframe)
        edges = [self._by_place(keyframe, cloud, pose, sigma), self._by_appearance(keyframe, pose)]
        return [edge for edge in edges if edge is not None]

    def _by_place(
        self, keyframe: Keyframe, cloud: Cloud, pose: Callable[[int], Array], sigma: float
    ) -> Edge | None:
        """Try the best old keyframe within reach of the current estimate."""
        if keyframe.travelled - self._last_attempt < self._spacing:
            return None
        candidate = self._nearest(keyframe, pose, float(np.clip(3 * sigma, *self._reach)))
        if candidate is None:
            return None
        self._last_attempt = keyframe.travelled
        guess = invert(pose(candidate.id)) @ pose(keyframe.id)
        return self._verify("place", candidate, keyframe, cloud, guess, pose)

    def _nearest(
        self, keyframe: Keyframe, pose: Callable[[int], Array], reach: float
    ) -> Keyframe | None:
        """Return the old keyframe within reach that is nearest in place and viewing direction."""
        old = self._old(self._keyframes, keyframe)
        if not old:
            return None
        here = pose(keyframe.id)
        poses = np.array([pose(k.id) for k in old])
        distance = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1)
        turn = np.arccos(np.clip(poses[:, :3, 0] @ here[:3, 0], -1, 1))
        best = int(np.argmin(distance / reach + turn / _MAX_TURN))
        return old[best] if distance[best] <= reach else None

    def _by_appearance(self, keyframe: Keyframe, pose: Callable[[int], Array]) -> Edge | None:
        """Try the place that a completed local map looks like."""
        recognition = self._recogniser.add(keyframe)
        if recognition is None:
            return None
        query = recognition.query
        cloud = Cloud.prepare(query.features.astype(np.float64), self._voxel_size)
        # Of the older local map, the keyframe nearest to where the query seems to be.
        target = pose(recognition.reference.id) @ recognition.T_reference_query
        nearby = self._old(self._around(recognition.reference, 4 * _SUBMAP_REACH), query)
        if not nearby:
            return None
        candidate = min(
            nearby, key=lambda k: float(np.linalg.norm(pose(k.id)[:3, 3] - target[:3, 3]))
        )
        return self._verify(
            "appearance", candidate, query, cloud, invert(pose(candidate.id)) @ target, pose
        )

    def _around(self, keyframe: Keyframe, reach: int) -> list[Keyframe]:
        """Return the keyframes that were taken shortly before and after one, itself included."""
        i = self._index[keyframe.id]
        return self._keyframes[max(i - reach, 0) : i + reach + 1]

    def _old(self, keyframes: list[Keyframe], query: Keyframe) -> list[Keyframe]:
        """Return those of the keyframes that were left long enough before the query."""
        return [k for k in keyframes if query.travelled - k.travelled >= self._min_travel]

    def _verify(
        self,
        kind: str,
        candidate: Keyframe,
        query: Keyframe,
        cloud: Cloud,
        guess: Array,
        pose: Callable[[int], Array],
    ) -> Edge | None:
        """Register the query to the candidate's submap; log and count the outcome."""
        # Without what is recent: a submap that holds the query itself fits at any guess.
        around = self._old(self._around(candidate, _SUBMAP_REACH), query)
        target = submap(around, [pose(k.id) for k in around], pose(candidate.id))
        verdict, result = self._verifier.verify(target, cloud, [guess])
        self.counts[f"loop by {kind}: {verdict}"] += 1
        logger.info(
            "loop %d -> %d by %s: %s (overlap %.2f, residual %.3f m, degeneracy %.3f)",
            query.id, candidate.id, kind, verdict,
            result.overlap, result.residual, result.degeneracy,
        )  # fmt: skip
        if verdict is not Verdict.ACCEPTED:
            return None
        covariance = result.covariance + relative_covariance(
            candidate, query, result.T_target_source
        )
        return Edge(candidate.id, query.id, result.T_target_source, covariance, "loop")


def relative_covariance(
    source: Keyframe | OdometryEstimate,
    target: Keyframe | OdometryEstimate,
    T_source_target: Array,
) -> Array:
    """Return the (6, 6) covariance, in the target's frame, that the errors of both ends cause."""
    A = adjoint(invert(T_source_target))
    covariance: Array = A @ source.covariance @ A.T + target.covariance
    return covariance
