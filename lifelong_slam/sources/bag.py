"""Scans from ROS 1 bags, ROS 2 bags and MCAP files."""

import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError, TopicError, did_you_mean
from lifelong_slam.scan import NANOSECONDS, Scan
from lifelong_slam.sources.assembly import assemble
from lifelong_slam.sources.bag_reference import REFERENCE_TYPES, read_reference
from lifelong_slam.sources.channel import Topic
from lifelong_slam.sources.livox import LIVOX_TYPES, decode_livox
from lifelong_slam.sources.pointcloud2 import Cloud, decode
from lifelong_slam.sources.recording import Recording, open_recording
from lifelong_slam.sources.static_frames import BASE_FRAMES, StaticFrames
from lifelong_slam.sources.units import check_scale
from lifelong_slam.trajectory import Trajectory

_log = logging.getLogger(__name__)

_TF_TYPE = "tf2_msgs/msg/TFMessage"
CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2", *LIVOX_TYPES)


class BagSource:
    """The clouds of one topic of a bag, stamped by their headers.

    Attributes:
        path: the bag: a file, a ROS 2 folder, or a folder with the parts of a split ROS 1 bag.
        topic: the cloud topic that is read.
        reference_topic: the topic of the reference poses, or None.
        unreadable: messages of the topic that could not be decoded in the latest pass.
    """

    def __init__(
        self,
        path: str,
        topic: str | None = None,
        reference_topic: str | None = None,
        scale: float = 1.0,
    ) -> None:
        """Find the topics and read the sensor's static pose.

        Args:
            path: the bag's file or folder.
            topic: a PointCloud2 (or Livox CustomMsg) topic; None takes the only one there is.
            reference_topic: Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped.
            scale: metres in one unit of the clouds' coordinates.

        Raises:
            SourceError: the path is missing or not a bag, or the scale makes no sense.
            TopicError: a topic is missing, has the wrong type, or must be named.
        """
        self.path = Path(path)
        self.reference_topic = reference_topic
        self.unreadable = 0
        self._scale = check_scale(scale)
        self._recording = open_recording(self.path)
        topics = dict(self._recording.topics)
        self.topic = _choose_topic(topics, topic, self.path)
        if reference_topic is not None:
            _check_topic(topics, reference_topic, REFERENCE_TYPES, "reference", self.path)
        self._count = topics[self.topic].count
        headers = list(_first_headers(self._recording, self.topic, 2))
        self._unstamped = bool(headers) and not any(stamp_of(header) for header in headers)
        if self._unstamped:
            _log.warning("%s %s: headers hold no stamps: receive times used", path, self.topic)
        self._frames = _static_frames(self._recording)
        self._base_frame, self._T_base_sensor = self._find_base(
            str(headers[0].frame_id) if headers else ""
        )

    def __len__(self) -> int:
        """Return the number of messages on the topic."""
        return self._count

    def __iter__(self) -> Iterator[Scan]:
        """Yield the clouds in order of receive time; undecodable ones are counted and left out.

        Raises:
            SourceError: the clouds have no x, y, z, or not one could be decoded.
        """
        self.unreadable = 0
        yield from assemble(self._clouds(), f"{self.path.name} {self.topic}", self._scale)
        if self.unreadable:
            _log.warning("%s: %d unreadable messages left out", self.path, self.unreadable)
        if self.unreadable and self.unreadable == self._count:
            raise SourceError(f"{self.path}: no message on {self.topic} could be decoded")

    def reference(self) -> Trajectory | None:
        """Return T_reference_base from the reference topic, or None where none was named.

        Raises:
            SourceError: the topic holds no usable pose.
        """
        if self.reference_topic is None:
            return None
        return read_reference(self._recording, self.reference_topic, self._frames, self._base_frame)

    @property
    def T_base_sensor(self) -> NDArray[np.float64]:
        """(4, 4) pose of the sensor on the vehicle by `/tf_static`; the identity without it."""
        return self._T_base_sensor

    def _clouds(self) -> Iterator[tuple[int, Cloud]]:
        """Yield header stamps and decoded clouds; undecodable messages are counted."""
        for receive_time, raw in self._recording.messages(self.topic):
            try:
                stamp, cloud = self._decode(raw)
            except SourceError as error:
                raise SourceError(f"{self.path}, topic {self.topic}: {error}") from None
            except Exception as error:  # a damaged message may break its decoder in any way
                self.unreadable += 1
                if self.unreadable == 1:
                    _log.warning("%s: unreadable message on %s: %s", self.path, self.topic, error)
                continue
            yield (receive_time if self._unstamped else stamp), cloud

    def _decode(self, raw: bytes) -> tuple[int, Cloud]:
        topic = self._recording.topics[self.topic]
        if topic.msgtype in LIVOX_TYPES:
            return decode_livox(raw, topic.ros1)
        message = self._recording.deserialize(raw, self.topic)
        return stamp_of(message.header), decode(message)

    def _find_base(self, frame: str) -> tuple[str, NDArray[np.float64]]:
        """Return the name of the base frame and T_base_sensor of the sensor's frame."""
        if found := self._frames.T_base(frame):
            return found
        _log.info(
            "%s: /tf_static doesn't lead from '%s' to %s: the sensor's frame is taken as base",
            *(self.path.name, frame, " or ".join(BASE_FRAMES)),
        )
        return frame, np.eye(4)


def stamp_of(header: Any) -> int:
    """Return a deserialised header's stamp in integer nanoseconds."""
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)


def _choose_topic(topics: dict[str, Topic], topic: str | None, path: Path) -> str:
    if topic is not None:
        _check_topic(topics, topic, CLOUD_TYPES, "point cloud", path)
        return topic
    candidates = [t for t in topics.values() if t.msgtype in CLOUD_TYPES and t.count]
    if len(candidates) == 1:
        return candidates[0].name
    if candidates:
        raise TopicError(
            f"{path} has {len(candidates)} point cloud topics; name one as topic: "
            f"{_listed(candidates)}"
        )
    raise TopicError(f"{path} has no point cloud topic; its topics: {_listed(topics.values())}")


def _check_topic(
    topics: dict[str, Topic], topic: str, types: tuple[str, ...], what: str, path: Path
) -> None:
    if topic not in topics:
        raise TopicError(
            f"{path} has no topic '{topic}'.{did_you_mean(topic, topics)} "
            f"Its topics: {_listed(topics.values())}"
        )
    if topics[topic].msgtype not in types:
        fitting = [t for t in topics.values() if t.msgtype in types]
        raise TopicError(
            f"{path}: topic '{topic}' is of type {topics[topic].msgtype}, not a {what}; "
            f"{what} topics there: {_listed(fitting)}"
        )


def _listed(topics: Iterable[Topic]) -> str:
    listed = [f"{t.name} ({t.msgtype}, {t.count} messages)" for t in topics]
    return ", ".join(sorted(listed)) or "none"


def _static_frames(recording: Recording) -> StaticFrames:
    messages = []
    for topic in recording.topics.values():
        if topic.msgtype != _TF_TYPE or not topic.name.endswith("/tf_static"):
            continue
        for _, raw in recording.messages(topic.name):
            try:
                messages.append(recording.deserialize(raw, topic.name))
            except Exception as error:  # a damaged message may break its decoder in any way
                _log.warning("unreadable message on %s: %s", topic.name, error)
    return StaticFrames(messages)


def _first_headers(recording: Recording, topic: str, count: int) -> Iterator[Any]:
    """Yield the headers of the first messages that can be decoded."""
    for _, raw in recording.messages(topic):
        try:
            header = recording.deserialize(raw, topic).header
        except Exception as error:  # a damaged message may break its decoder in any way
            _log.debug("unreadable message on %s: %s", topic, error)
            continue
        yield header
        count -= 1
        if count == 0:
            return
