"""Place recognition without a pose guess: map-closures on local maps (Gupta et al., ICRA 2024)."""

from dataclasses import dataclass

import numpy as np
from map_closures.config import MapClosuresConfig
from map_closures.map_closures import MapClosures
from numpy.typing import NDArray

from lifelong_slam.geometry import invert
from lifelong_slam.mapping.keyframe import Keyframe, join

Array = NDArray[np.float64]

_STRIDE = 4  # every fourth map point: a density image needs no more


@dataclass(frozen=True, slots=True)
class Recognition:
    """Two local maps that look alike.

    Attributes:
        reference: middle keyframe of the older local map.
        query: middle keyframe of the newer one.
        T_reference_query: (4, 4) guess between the two, from the ground plane's match.
        inliers: matched features behind the guess.
    """

    reference: Keyframe
    query: Keyframe
    T_reference_query: Array
    inliers: int


class PlaceRecogniser:
    """Builds local maps of odometry as keyframes come in, and matches each with the older ones."""

    def __init__(self, length: float, resolution: float, min_inliers: int) -> None:
        """Set up an empty database.

        Args:
            length: metres of path that a local map covers.
            resolution: metres a pixel of the density images.
            min_inliers: matched features from which two maps are held to look alike.
        """
        config = MapClosuresConfig(density_map_resolution=resolution, inliers_threshold=min_inliers)
        self._detector = MapClosures(config)
        self._length = length
        self._min_inliers = min_inliers
        self._current: list[Keyframe] = []
        self._centres: list[Keyframe] = []

    def add(self, keyframe: Keyframe) -> Recognition | None:
        """Take in a keyframe; where it completes a local map, look for the place in older ones."""
        self._current.append(keyframe)
        if keyframe.travelled - self._current[0].travelled < self._length:
            return None
        keyframes, self._current = self._current, []
        centre = keyframes[len(keyframes) // 2]
        return self._match(centre, self._local_map(keyframes, centre))

    def _local_map(self, keyframes: list[Keyframe], centre: Keyframe) -> Array:
        """Join the map points of keyframes; the features are too sparse to tell places apart."""
        clouds = [keyframe.points[::_STRIDE] for keyframe in keyframes]
        return join(clouds, [k.T_odom_sensor for k in keyframes], centre.T_odom_sensor)

    def _match(self, centre: Keyframe, points: Array) -> Recognition | None:
        self._centres.append(centre)
        closure = self._detector.get_best_closure(len(self._centres) - 1, points)
        if closure.number_of_inliers < self._min_inliers:
            return None
        T_query_reference = np.asarray(closure.pose)
        return Recognition(
            reference=self._centres[closure.source_id],
            query=centre,
            T_reference_query=invert(T_query_reference),
            inliers=int(closure.number_of_inliers),
        )
