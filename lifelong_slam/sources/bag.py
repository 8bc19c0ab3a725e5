"""Scans from ROS 1 bags, ROS 2 bags and MCAP files."""

import logging
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError, TopicError, did_you_mean
from lifelong_slam.scan import NANOSECONDS, Scan
from lifelong_slam.sources.assembly import assemble
from lifelong_slam.sources.bag_reference import REFERENCE_TYPES, read_reference
from lifelong_slam.sources.channel import Topic
from lifelong_slam.sources.headers import Arrival, read_header
from lifelong_slam.sources.joined_sweeps import join_sweeps
from lifelong_slam.sources.lidars import Lidars
from lifelong_slam.sources.livox import LIVOX_TYPES, decode_livox
from lifelong_slam.sources.ordering import in_order
from lifelong_slam.sources.pointcloud2 import Cloud, decode
from lifelong_slam.sources.recording import Recording, open_recording
from lifelong_slam.sources.static_frames import BASE_FRAMES, StaticFrames, bare
from lifelong_slam.sources.units import check_scale
from lifelong_slam.trajectory import Trajectory

_log = logging.getLogger(__name__)

_TF_TYPE = "tf2_msgs/msg/TFMessage"
CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2", *LIVOX_TYPES)
_FIRST = 20  # messages that tell which LiDARs there are, and what their stamps are worth


class BagSource:
    """The clouds of one topic of a bag, stamped by their headers.

    Where several LiDARs share a topic, told apart by their frame_id, their clouds are brought into
    one frame by `/tf_static`, and a scan is what all of them measured during a turn.

    Attributes:
        path: the bag: a file, a ROS 2 folder, or a folder with the parts of a split ROS 1 bag.
        topic: the cloud topic that is read.
        reference_topic: the topic of the reference poses, or None.
        unreadable: messages of the topic that could not be used in the latest pass: they can't be
            decoded, or it isn't known where their LiDAR sits.
        reordered: scans put back in order in the latest pass.
    """

    def __init__(
        self,
        path: str,
        topic: str | None = None,
        reference_topic: str | None = None,
        frame: str | None = None,
        scale: float = 1.0,
    ) -> None:
        """Find the topics, and read the static poses of the LiDARs.

        Args:
            path: the bag's file or folder.
            topic: a PointCloud2 (or Livox CustomMsg) topic; None takes the only one there is.
            reference_topic: Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped.
            frame: frame_id of the LiDAR to read, where several share the topic; None reads all.
            scale: metres in one unit of the clouds' coordinates.

        Raises:
            SourceError: the path is missing or not a bag, the scale makes no sense, or nothing tells when
                the clouds were measured.
            TopicError: a topic or frame is missing, has the wrong type, or must be named.
        """
        self.path = Path(path)
        self.reference_topic = reference_topic
        self.unreadable = 0
        self.reordered = 0
        self._scale = check_scale(scale)
        self._recording = open_recording(self.path)
        topics = dict(self._recording.topics)
        self.topic = _choose_topic(topics, topic, self.path)
        if reference_topic is not None:
            _check_topic(topics, reference_topic, REFERENCE_TYPES, "reference", self.path)
        self._info = topics[self.topic]
        self._frame = None if frame is None else bare(frame)
        self._frames = _static_frames(self._recording)
        self._lidars = Lidars(self._first_arrivals(), self._frames, self._where)
        self._base_frame, self._T_base_sensor = self._find_base(self._lidars.main)

    def __len__(self) -> int:
        """Return the number of messages on the topic."""
        return self._info.count

    def __iter__(self) -> Iterator[Scan]:
        """Yield the clouds in recorded order, those that came late put back in their places.

        Undecodable ones are counted and left out.

        Raises:
            SourceError: the clouds have no x, y, z, or not one could be decoded.
        """
        self.unreadable = self.reordered = 0
        self._lidars.rewind()
        lidars: deque[str] = deque()
        sweeps = assemble(self._clouds(lidars), self._where, self._scale)
        named_sweeps = ((lidars.popleft(), sweep) for sweep in sweeps)
        scans = join_sweeps(named_sweeps, lambda: self._lidars.turn)
        count = 0
        for scan in in_order(scans, self._note_late):
            count += 1
            yield scan
        self._log_end(count)
        if self.unreadable and count == 0:
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

    @property
    def _where(self) -> str:
        return f"{self.path.name} {self.topic}"

    def _first_arrivals(self) -> list[Arrival]:
        """Return the first messages of the frame asked for; of any with none.

        Raises:
            TopicError: there are messages, but none of that frame.
        """
        seen: Counter[str] = Counter()
        first = list(islice(self._arrivals(seen), _FIRST))
        if seen and not first:
            raise TopicError(
                f"{self._where}: no cloud is in frame '{self._frame}'."
                f"{did_you_mean(str(self._frame), seen)} Their frames: {', '.join(sorted(seen))}"
            )
        return first

    def _arrivals(self, seen: Counter[str]) -> Iterator[Arrival]:
        """Yield the topic's messages of the frame asked for; frames of all are counted in `seen`."""
        for receive_time, raw in self._recording.messages(self.topic):
            try:
                header = read_header(raw, self._info.ros1)
            except Exception as error:  # a damaged message may break its decoder in any way
                self._note_unreadable(error)
                continue
            seen[header.frame] += 1
            if self._frame in (None, header.frame):
                yield Arrival(receive_time, header, raw)

    def _clouds(self, lidars: deque[str]) -> Iterator[tuple[int, Cloud]]:
        """Yield times and decoded clouds, and append the frames of their LiDARs to `lidars`."""
        for arrival in self._arrivals(Counter()):
            lidar = arrival.header.frame
            try:
                cloud = self._lidars.to_main(self._decode(arrival.raw), lidar)
                time = self._lidars.time(arrival)
            except SourceError as error:
                raise SourceError(f"{self.path}, topic {self.topic}: {error}") from None
            except Exception as error:  # a damaged message may break its decoder in any way
                self._note_unreadable(error)
                continue
            lidars.append(lidar)
            yield time, cloud

    def _decode(self, raw: bytes) -> Cloud:
        if self._info.msgtype in LIVOX_TYPES:
            return decode_livox(raw, self._info.ros1)
        return decode(self._recording.deserialize(raw, self.topic))

    def _note_unreadable(self, error: Exception) -> None:
        self.unreadable += 1
        if self.unreadable == 1:
            _log.warning("%s: unreadable message on %s: %s", self.path, self.topic, error)

    def _note_late(self, scan: Scan) -> None:
        self.reordered += 1
        if self.reordered == 1:
            _log.warning(
                "%s: the scan at %.3f s came behind a later one: put back in order",
                *(self._where, scan.stamp / NANOSECONDS),
            )

    def _log_end(self, scans: int) -> None:
        if self.unreadable:
            _log.warning("%s: %d unreadable messages left out", self.path, self.unreadable)
        if len(sweeps := self._lidars.sweeps) > 1:
            total = sweeps.total()
            listed = ", ".join(f"{count} of {name}" for name, count in sweeps.items())
            _log.info(
                "%s: %d of %d sweeps used (%s), joined to %d scans",
                *(self._where, total, total + self.unreadable, listed, scans),
            )

    def _find_base(self, frame: str) -> tuple[str, NDArray[np.float64]]:
        """Return the name of the base frame and T_base_sensor of the sensor's frame."""
        if found := self._frames.T_base(frame):
            return found
        _log.info(
            "%s: /tf_static doesn't lead from '%s' to %s: the sensor's frame is taken as base",
            *(self.path.name, frame, " or ".join(BASE_FRAMES)),
        )
        return frame, np.eye(4)


def _choose_topic(topics: dict[str, Topic], topic: str | None, path: Path) -> str:
    if topic is not None:
        _check_topic(topics, topic, CLOUD_TYPES, "point cloud", path)
        return topic
    candidates = _fitting(topics, CLOUD_TYPES, filled=True)
    if len(candidates) == 1:
        return candidates[0].name
    if candidates:
        raise TopicError(
            f"{path} has {len(candidates)} point cloud topics; name one as topic: "
            f"{_listed(candidates)}"
        )
    raise TopicError(
        f"{path} has no point cloud topic; its topics: {_listed(topics.values())}"
        f"{_unreadable_encodings(topics.values())}"
    )


def _check_topic(
    topics: dict[str, Topic], topic: str, types: tuple[str, ...], what: str, path: Path
) -> None:
    if topic not in topics:
        raise TopicError(
            f"{path} has no topic '{topic}'.{did_you_mean(topic, topics)} "
            f"Its topics: {_listed(topics.values())}"
        )
    if unreadable := _unreadable_encodings([topics[topic]]):
        raise TopicError(f"{path}: {topics[topic]}{unreadable}")
    if topics[topic].msgtype not in types:
        raise TopicError(
            f"{path}: topic '{topic}' is of type {topics[topic].msgtype}, not a {what}; "
            f"{what} topics there: {_listed(_fitting(topics, types))}"
        )


def _fitting(topics: dict[str, Topic], types: tuple[str, ...], filled: bool = False) -> list[Topic]:
    fitting = [t for t in topics.values() if t.msgtype in types and t.readable]
    return [t for t in fitting if t.count or not filled]


def _listed(topics: Iterable[Topic]) -> str:
    return ", ".join(sorted(map(str, topics))) or "none"


def _unreadable_encodings(topics: Iterable[Topic]) -> str:
    encodings = sorted({topic.encoding for topic in topics if not topic.readable})
    if not encodings:
        return ""
    return f": messages in {' or '.join(encodings)} can't be read, only those of ROS 1 and ROS 2"


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
