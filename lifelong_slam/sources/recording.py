"""ROS 1 bags, ROS 2 bags and MCAP files behind one small reader."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol
from weakref import finalize

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2

from formats.bags import check_chunks, open_bag
from lifelong_slam.errors import SourceError
from lifelong_slam.sources.bag_files import bag_paths, storage_files
from lifelong_slam.sources.channel import ROS1, Topic
from lifelong_slam.sources.salvage import SalvagedRecording, is_bag
from lifelong_slam.sources.typestores import default_typestore
from lifelong_slam.sources.unfinished_db3 import finished, is_unfinished

_log = logging.getLogger(__name__)


class Recording(Protocol):
    """A recording that has been found readable; files are open only while messages are read."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics by name."""
        ...

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield receive time in ns and raw message, from the start."""
        ...

    def deserialize(self, raw: bytes, topic: str) -> Any:
        """Decode a raw message of a topic.

        Raises:
            Exception: of whatever kind, if the message is damaged.
        """
        ...


class IndexedRecording:
    """An intact recording, read with the help of its index."""

    def __init__(self, paths: list[Path]) -> None:
        """Read the topics.

        Raises:
            Exception: of whatever kind, if the files are damaged or are no recording.
        """
        self._paths = paths
        self._ros1 = all(path.suffix == ".bag" for path in paths)
        self._defaults = default_typestore(self._ros1)
        for path in paths:
            check_chunks(path)
        with self._open() as reader:
            self._store = reader.typestore
            self._topics = {
                name: Topic(
                    name,
                    info.msgtype or "several types",
                    info.msgcount,
                    _encoding(info.connections),
                )
                for name, info in reader.topics.items()
            }

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics by name."""
        return self._topics

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield receive time in ns and raw message, in order of receive time.

        Where the index leads to damaged data, the rest comes from what is whole behind it.
        """
        last, count = -1, 0
        try:
            with self._open() as reader:
                connections = [c for c in reader.connections if c.topic == topic]
                for _, receive_time, raw in reader.messages(connections):
                    last, count = receive_time, count + 1
                    yield receive_time, raw
        except Exception as error:  # damaged files raise whatever the parser met first
            _log.warning(
                "%s is damaged (%s): after message %d on %s, what is whole is used",
                *(self._paths[0], _reason(error), count, topic),
            )
            rest = SalvagedRecording(storage_files(self._paths)).messages(topic)
            yield from ((time, raw) for time, raw in rest if time > last)

    def deserialize(self, raw: bytes, topic: str) -> Any:
        """Decode a raw message of a topic."""
        msgtype = self._topics[topic].msgtype
        if self._ros1:
            return self._store.deserialize_ros1(raw, msgtype)
        return self._store.deserialize_cdr(raw, msgtype)

    def _open(self) -> AnyReader:
        return open_bag(self._paths, self._defaults)


def open_recording(path: Path) -> Recording:
    """Open a bag, file or folder, of any of the formats; a damaged one as far as it is readable.

    Raises:
        SourceError: there is no such path, nothing in it can be read as a bag, or there is no room to
            take in the log of a recorder that was killed.
    """
    paths = bag_paths(path)
    if not any(map(is_unfinished, paths)):
        return _open(path, paths)
    scratch = TemporaryDirectory(prefix="lifelong_slam_")
    folder = Path(scratch.name)
    recording = _open(path, [finished(p, folder) if is_unfinished(p) else p for p in paths])
    finalize(recording, scratch.cleanup)
    return recording


def _open(path: Path, paths: list[Path]) -> Recording:
    try:
        return IndexedRecording(paths)
    except Exception as error:  # damaged files raise whatever the parser met first
        reason = _reason(error)
    files = storage_files(paths)
    if not any(is_bag(file) for file in files):
        raise SourceError(f"{path} is not a ROS 1 bag, ROS 2 bag or MCAP: {reason}")
    salvaged = SalvagedRecording(files)
    count = sum(topic.count for topic in salvaged.topics.values())
    if count == 0:
        raise SourceError(f"{path} is damaged and no message in it is whole: {reason}")
    if paths != files or not salvaged.is_whole:  # a folder that is no ROS 2 bag, or damaged files
        _log.warning(
            "%s is cut short or damaged, or has no index (%s): %d whole messages on %d topics are used",
            *(path, reason, count, len(salvaged.topics)),
        )
    return salvaged


def _encoding(connections: Iterable[Connection]) -> str:
    """Return how the messages of a topic are serialised."""
    kinds = {
        c.ext.serialization_format for c in connections if isinstance(c.ext, ConnectionExtRosbag2)
    }
    return " and ".join(sorted(kinds)) or ROS1


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
