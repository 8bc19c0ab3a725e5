"""Finding a new session in a saved map without any guess of its pose.

A local map, the points of 20 m of path, is compared with those that earlier sessions left.
map-closures (Gupta et al., ICRA 2024) proposes places by appearance, generalised ICP of the whole
local map verifies them, and a session counts as located once two local maps along its path agree
with odometry.

What makes the density images of map-closures repeatable, and with it a hand-held sensor of 70
degrees recognisable:

- Local maps are thinned to one point a voxel before they are counted, so that a pixel tells how much
  surface stands above it, not how long the sensor looked there.
- They are levelled first: a keyframe's frame is tilted as the sensor was (20 degrees in a hand), and
  a wall seen from above is a line only if it is upright.
"""

import logging
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from map_closures.config import MapClosuresConfig
from map_closures.map_closures import ClosureCandidate, MapClosures
from numpy.typing import NDArray

from lifelong_slam.geometry import exp, invert, rotation_angle, transform
from lifelong_slam.loop_closure.verification import Verdict, Verifier
from lifelong_slam.mapping.keyframe import Keyframe, join
from lifelong_slam.mapping.static_map import thin
from lifelong_slam.registration import Cloud, Registration

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

LOCAL_MAP_LENGTH = 20.0  # metres of path in a local map: enough to see a place from several sides
LOCAL_MAP_SPACING = 10.0  # metres of path between two, so that they overlap by half
LOCAL_MAP_RADIUS = 80.0  # metres around the middle keyframe; a small image has few features

_THINNING = 0.5  # voxel of a local map over the voxel of registration
_PIXEL = 0.75  # pixel of a density image over the voxel of registration
_CONES = np.radians([35.0, 18.0, 9.0, 5.0, 5.0])  # around the up so far, where ground is sought
_SHELF = 16  # places in one database of map-closures
_STEP = 4  # map-closures never matches two local maps whose numbers differ by less
_QUERIES = _SHELF  # that a database takes in before it is made anew: it can't forget them
_PENDING = 3  # latest locations that a new one may agree with
_RIVAL = 0.8  # share of the best support from which a place elsewhere makes it ambiguous


@dataclass(frozen=True, slots=True)
class Candidate:
    """A saved place that looks like the query.

    Attributes:
        reference_id: id that the place was added with.
        T_reference_query: (4, 4) guess, from the match of the density images.
        inliers: matched features behind the guess.
    """

    reference_id: int
    T_reference_query: Array
    inliers: int


@dataclass(frozen=True, slots=True)
class LocalMap:
    """What was seen along a stretch of path: a place to save, or a query.

    Attributes:
        reference: the keyframe in the middle.
        begin: metres that were travelled up to its first keyframe.
        points: (N, 3) in its frame, one a voxel; some 20 000, a quarter of a megabyte.
    """

    reference: Keyframe
    begin: float
    points: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Location:
    """A query that has been registered to a saved place.

    Attributes:
        reference_id: id that the place was added with.
        query: the keyframe in the middle of the query.
        registration: of the two local maps; its T_target_source is T_reference_query. Its
            covariance, in the query's frame, is that of the fit alone: how well each end's keyframe
            lies in its own local map comes on top (`closer.relative_covariance`).
    """

    reference_id: int
    query: Keyframe
    registration: Registration


class LocalMapBuilder:
    """Cuts a session into overlapping local maps by odometry alone, as its keyframes come in."""

    def __init__(self, voxel_size: float) -> None:
        """Begin a session.

        Args:
            voxel_size: metres, of the registration; local maps have one point in half of it.
        """
        self._voxel_size = voxel_size
        self._window: deque[Keyframe] = deque()

    def clear(self) -> None:
        """Begin anew: odometry doesn't lead from the keyframes before to those that follow."""
        self._window.clear()

    def add(self, keyframe: Keyframe) -> LocalMap | None:
        """Take in a keyframe and return the local map that it completes, if it does."""
        self._window.append(keyframe)
        if keyframe.travelled - self._window[0].travelled < LOCAL_MAP_LENGTH:
            return None
        complete = list(self._window)
        while keyframe.travelled - self._window[0].travelled > LOCAL_MAP_LENGTH - LOCAL_MAP_SPACING:
            self._window.popleft()
        return self._join(complete)

    def _join(self, keyframes: list[Keyframe]) -> LocalMap:
        reference = keyframes[len(keyframes) // 2]
        points = join(
            [k.points for k in keyframes],
            [k.T_odom_sensor for k in keyframes],
            reference.T_odom_sensor,
        )
        near = points[np.linalg.norm(points, axis=1) < LOCAL_MAP_RADIUS]
        thinned = thin(near, _THINNING * self._voxel_size)
        return LocalMap(reference, keyframes[0].travelled, thinned)


@dataclass(frozen=True, slots=True)
class _Place:
    reference_id: int
    points: NDArray[np.float32]
    T_level_reference: Array


class _Shelf:
    """A database of a few places.

    map-closures matches whatever it takes in with all that it has under lower numbers, which takes
    some 16 ms each, and can't forget. So numbers descend, those of places below those of queries: a
    place is matched with nothing, a query with all places and with no other query. Its memory is as
    large as the largest number, which is why there are few places in each.
    """

    def __init__(self, resolution: float) -> None:
        self._config = MapClosuresConfig(density_map_resolution=resolution)
        self._places: list[_Place] = []
        self._clear()

    def add(self, place: _Place) -> None:
        self._enter(len(self._places), place)
        self._places.append(place)

    def match(self, levelled: Array) -> list[tuple[_Place, ClosureCandidate]]:
        """Return the places that (N, 3) points, levelled, resemble."""
        if self._queries == _QUERIES:
            self._clear()
            for i, place in enumerate(self._places):
                self._enter(i, place)
        self._queries += 1
        number = _SHELF + _QUERIES - self._queries
        closures = self._take_in(number, levelled)
        return [(self._places[_SHELF - 1 - c.source_id // _STEP], c) for c in closures]

    def _clear(self) -> None:
        self._detector = MapClosures(self._config)
        self._queries = 0

    def _enter(self, i: int, place: _Place) -> None:
        levelled = transform(place.T_level_reference, place.points.astype(np.float64))
        self._take_in(_SHELF - 1 - i, levelled)

    def _take_in(self, number: int, levelled: Array) -> list[ClosureCandidate]:
        closures: list[ClosureCandidate]
        closures = self._detector.get_top_k_closures(_STEP * number, levelled, -1)
        return closures


class Relocaliser:
    """The saved places, and the search for one that a local map shows."""

    def __init__(
        self,
        voxel_size: float,
        max_candidates: int = 5,
        min_overlap: float = 0.4,
        max_residual: float = 0.06,
        min_degeneracy: float = 0.01,
    ) -> None:
        """Set up without places.

        Args:
            voxel_size: of the clouds that are registered, metres.
            max_candidates: places to register a query to.
            min_overlap: see Verifier, as the next two; here a whole local map must overlap.
            max_residual: metres.
            min_degeneracy: ratio.
        """
        self._voxel_size = voxel_size
        self._max_candidates = max_candidates
        self._verifier = Verifier(voxel_size, min_overlap, max_residual, min_degeneracy)
        self._places: dict[int, _Place] = {}
        self._shelves: list[_Shelf] = []

    def __len__(self) -> int:
        return len(self._places)

    def add_place(self, reference_id: int, points: NDArray[np.float32]) -> None:
        """Take in the (N, 3) local map of a place, in the reference keyframe's frame."""
        level = upright(points.astype(np.float64), self._voxel_size)
        place = _Place(reference_id, points, level)
        if len(self._places) % _SHELF == 0:
            self._shelves.append(_Shelf(_PIXEL * self._voxel_size))
        self._places[reference_id] = place
        self._shelves[-1].add(place)

    def candidates(self, points: NDArray[np.float32], among: Collection[int]) -> list[Candidate]:
        """Return those of some places that a query's (N, 3) points look like, the likeliest first.

        The guesses vary a little from call to call: map-closures seeds its RANSAC by chance.
        """
        level = upright(points.astype(np.float64), self._voxel_size)
        levelled = transform(level, points.astype(np.float64))
        found = [
            match
            for shelf in self._shelves
            for match in shelf.match(levelled)
            if match[0].reference_id in among
        ]
        found.sort(key=lambda match: -match[1].number_of_inliers)
        return [
            Candidate(
                reference_id=place.reference_id,
                T_reference_query=invert(place.T_level_reference)
                @ invert(np.asarray(closure.pose))
                @ level,
                inliers=int(closure.number_of_inliers),
            )
            for place, closure in found[: self._max_candidates]
        ]

    def locate(self, query: LocalMap, among: Collection[int]) -> list[Location]:
        """Return those of some places that a query fits, the best supported first."""
        cloud = Cloud.prepare(query.points.astype(np.float64), self._voxel_size)
        locations = []
        for candidate in self.candidates(query.points, among):
            place = self._places[candidate.reference_id]
            verdict, registration = self._verifier.verify(
                place.points.astype(np.float64), cloud, [candidate.T_reference_query]
            )
            logger.info(
                "locating %d at %d: %s (%d features, overlap %.2f, residual %.3f m, degeneracy %.3f)",
                query.reference.id, candidate.reference_id, verdict, candidate.inliers,
                registration.overlap, registration.residual, registration.degeneracy,
            )  # fmt: skip
            if verdict is Verdict.ACCEPTED:
                locations.append(Location(candidate.reference_id, query.reference, registration))
        return sorted(locations, key=lambda found: -found.registration.support)


class SessionLocator:
    """Decides whether a session has been located.

    One verified place isn't enough: houses and corridors come in rows. Two local maps have to be
    found where odometry says they are to each other, and one that fits elsewhere about as well
    doesn't count.
    """

    def __init__(self, max_offset: float, max_turn: float = 0.1) -> None:
        """Begin a session.

        Args:
            max_offset: metres by which two locations may disagree; about two voxels.
            max_turn: radians by which they may.
        """
        self._max_offset = max_offset
        self._max_turn = max_turn
        self._pending: deque[Location] = deque(maxlen=_PENDING)

    def clear(self) -> None:
        """Begin anew: odometry doesn't lead from the local maps before to those that follow."""
        self._pending.clear()

    def agreeing(self, locations: list[Location], pose: Callable[[int], Array]) -> list[Location]:
        """Take in where the session's next local map fits and return the locations that agree.

        There are none until two local maps agree; then there are at least two, the newest last.

        Args:
            locations: of one local map, the best supported first.
            pose: (4, 4) T_map_reference of a place's reference, by its id.
        """
        if not locations or self._has_rival(locations, pose):
            return []
        best = locations[0]
        agreeing = [found for found in self._pending if self._agree(found, best, pose)]
        self._pending.append(best)
        return [*agreeing, best] if agreeing else []

    def _has_rival(self, locations: list[Location], pose: Callable[[int], Array]) -> bool:
        """Tell whether the query fits another spot about as well as the best one."""
        best = locations[0]
        least = _RIVAL * best.registration.support
        strong = [found for found in locations if found.registration.support >= least]
        return not all(self._agree(found, best, pose) for found in strong)

    def _agree(self, a: Location, b: Location, pose: Callable[[int], Array]) -> bool:
        """Tell whether two locations put b's query at the same pose in the map."""
        motion = invert(a.query.T_odom_sensor) @ b.query.T_odom_sensor
        by_a = pose(a.reference_id) @ a.registration.T_target_source @ motion
        by_b = pose(b.reference_id) @ b.registration.T_target_source
        difference = invert(by_a) @ by_b
        near = np.linalg.norm(difference[:3, 3]) < self._max_offset
        return bool(near and rotation_angle(difference) < self._max_turn)


def upright(points: Array, voxel_size: float) -> Array:
    """Return the (4, 4) rotation T_level_sensor that makes the ground of (N, 3) points level.

    Up is where the normals of the surfaces crowd near the sensor's own z axis, found by means in
    narrowing cones. The ground seen, not gravity, so that both visits find the same.
    """
    normals = Cloud.prepare(points, voxel_size).normals
    normals = np.where(normals[:, 2:] < 0, -normals, normals)
    up = np.array([0.0, 0.0, 1.0])
    for cone in _CONES:
        ground = normals[normals @ up > np.cos(cone)].sum(axis=0)
        if not ground.any():
            break
        up = ground / np.linalg.norm(ground)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    rotation = axis * np.arctan2(sine, up[2]) / max(sine, 1e-12)
    return exp(np.concatenate([rotation, np.zeros(3)]))
