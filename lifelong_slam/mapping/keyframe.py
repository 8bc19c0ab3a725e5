"""Keyframes: the scans that the map consists of."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import invert, rotation_angle, transform
from lifelong_slam.odometry.odometry import OdometryEstimate, Tracking

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A vertex of the graph and what was seen from it.

    Attributes:
        id: vertex id.
        session: the run that took it, counted within a map.
        stamp: nanoseconds.
        T_odom_sensor: (4, 4) pose by odometry alone.
        covariance: (6, 6) of its registration, in its own frame, rotation then translation.
        travelled: metres driven up to here.
        features: (N, 3) float32 points thinned for registration, in its own frame.
        points: (M, 3) float32 points for the map, in its own frame.
    """

    id: int
    session: int
    stamp: int
    T_odom_sensor: Array
    covariance: Array
    travelled: float
    features: NDArray[np.float32]
    points: NDArray[np.float32]


class KeyframeSelector:
    """Takes a scan as keyframe once the sensor has moved or turned enough.

    The first of a map is taken too. One that was only predicted isn't, unless it is the very first: nothing
    is known of where it was that its neighbours don't know.
    """

    def __init__(self, distance: float, rotation: float) -> None:
        """Set up.

        Args:
            distance: metres between keyframes.
            rotation: radians between keyframes.
        """
        self._distance = distance
        self._rotation = rotation
        self._last: Array | None = None

    def takes(self, estimate: OdometryEstimate) -> bool:
        """Tell whether this scan becomes a keyframe; remembers it if so."""
        if estimate.tracking is Tracking.PREDICTED and self._last is not None:
            return False
        if self._last is not None and estimate.tracking is Tracking.REGISTERED:
            motion = invert(self._last) @ estimate.T_odom_sensor
            moved = np.linalg.norm(motion[:3, 3]) >= self._distance
            if not moved and rotation_angle(motion) < self._rotation:
                return False
        self._last = estimate.T_odom_sensor
        return True


def submap(keyframes: Sequence[Keyframe], poses: Sequence[Array], centre: Array) -> Array:
    """Join the features of keyframes into (N, 3) points in the frame of `centre`.

    Args:
        keyframes: to join.
        poses: (4, 4) T_map_keyframe of each.
        centre: (4, 4) T_map_centre.
    """
    return join([keyframe.features for keyframe in keyframes], poses, centre)


def join(clouds: Sequence[NDArray[np.float32]], poses: Sequence[Array], centre: Array) -> Array:
    """Join (N_i, 3) clouds with poses T_map_cloud into (N, 3) points in the frame T_map_centre."""
    T_centre_map = invert(centre)
    return np.vstack(
        [
            transform(T_centre_map @ pose, cloud.astype(np.float64))
            for cloud, pose in zip(clouds, poses, strict=True)
        ]
    )
