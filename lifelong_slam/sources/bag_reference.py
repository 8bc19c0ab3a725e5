"""The reference trajectory of a bag."""

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.sources.recording import Recording
from lifelong_slam.sources.references import ordered_trajectory
from lifelong_slam.sources.static_frames import StaticFrames, bare, pose_matrix
from lifelong_slam.trajectory import Trajectory

_log = logging.getLogger(__name__)

REFERENCE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)


def read_reference(recording: Recording, topic: str, frames: StaticFrames, base: str) -> Trajectory:
    """Read T_reference_base, sorted and with distinct stamps.

    Messages that name the frame they hold for (Odometry, TransformStamped) are carried to `base`
    by the static transforms; where that frame is unknown there, it is taken to be the base.

    Raises:
        SourceError: the topic holds no usable pose.
    """
    stamps, poses, unusable, child = [], [], 0, ""
    for _, raw in recording.messages(topic):
        try:
            message = recording.deserialize(raw, topic)
            pose = _pose(message)
        except Exception as error:  # a damaged message may break its decoder in any way
            _log.debug("unreadable message on %s: %s", topic, error)
            pose = None
        if pose is None:
            unusable += 1
            continue
        stamp = message.header.stamp
        stamps.append(int(stamp.sec) * NANOSECONDS + int(stamp.nanosec))
        poses.append(pose)
        child = bare(getattr(message, "child_frame_id", ""))
    if unusable:
        _log.warning("%s: %d messages without a usable pose left out", topic, unusable)
    trajectory = ordered_trajectory(stamps, poses, f"topic {topic}")
    return _carried(trajectory, frames, child, base)


def _pose(message: Any) -> NDArray[np.float64] | None:
    """Return the (4, 4) pose in a message of any of the reference types."""
    if hasattr(message, "transform"):
        return pose_matrix(message.transform.translation, message.transform.rotation)
    pose = message.pose
    if hasattr(pose, "pose"):
        pose = pose.pose
    return pose_matrix(pose.position, pose.orientation)


def _carried(trajectory: Trajectory, frames: StaticFrames, child: str, base: str) -> Trajectory:
    if not child or child == bare(base):
        return trajectory
    T_child_base = frames.T_between(child, base)
    if T_child_base is None:
        _log.info("the reference holds for '%s', unknown to /tf_static: taken as base", child)
        return trajectory
    return Trajectory(trajectory.stamps, trajectory.poses @ T_child_base)
