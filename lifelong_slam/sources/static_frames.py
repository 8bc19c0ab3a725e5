"""The static transforms of a recording: where the sensor sits on the vehicle."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.geometry import from_quaternion, invert

BASE_FRAMES = ("base_link", "base", "base_footprint")


class StaticFrames:
    """A tree of frames, each with its fixed pose in its parent."""

    def __init__(self, messages: Iterable[Any]) -> None:
        """Collect the transforms of deserialised TFMessages; later ones replace earlier ones."""
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}
        for message in messages:
            for stamped in message.transforms:
                T_parent_child = pose_matrix(
                    stamped.transform.translation, stamped.transform.rotation
                )
                if T_parent_child is not None:
                    child, parent = bare(stamped.child_frame_id), bare(stamped.header.frame_id)
                    self._parents[child] = (parent, T_parent_child)

    def __len__(self) -> int:
        return len(self._parents)

    def T_base(self, frame: str) -> tuple[str, NDArray[np.float64]] | None:
        """Return the vehicle's frame above `frame` and T_base_frame (4, 4), or None."""
        frame, T_base_frame = bare(frame), np.eye(4)
        for _ in range(len(self._parents) + 1):  # bounded: a file may hold a cycle
            if frame in BASE_FRAMES:
                return frame, T_base_frame
            if frame not in self._parents:
                return None
            frame, T_parent_child = self._parents[frame]
            T_base_frame = T_parent_child @ T_base_frame
        return None

    def T_between(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Return T_target_source (4, 4) if both hang from one root, else None."""
        from_target, from_source = self._to_root(target), self._to_root(source)
        if from_target[0] != from_source[0]:
            return None
        return np.asarray(invert(from_target[1]) @ from_source[1])

    def _to_root(self, frame: str) -> tuple[str, NDArray[np.float64]]:
        frame, T_root_frame = bare(frame), np.eye(4)
        for _ in self._parents:
            if frame not in self._parents:
                break
            frame, T_parent_child = self._parents[frame]
            T_root_frame = T_parent_child @ T_root_frame
        return frame, T_root_frame


def bare(frame: str) -> str:
    """Return a frame's name without the leading slash of ROS's early days."""
    return frame.lstrip("/")


def pose_matrix(position: Any, quaternion: Any) -> NDArray[np.float64] | None:
    """Return the (4, 4) pose of ROS messages, or None where it isn't a finite rigid pose."""
    xyz = np.array([position.x, position.y, position.z], dtype=np.float64)
    xyzw = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], dtype=np.float64)
    if not np.isfinite(xyz).all() or not 0.5 < np.linalg.norm(xyzw) < 2.0:
        return None
    return from_quaternion(xyz, xyzw)
