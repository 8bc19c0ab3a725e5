"""ROS 1 bags, ROS 2 bags and MCAP files behind one small reader."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from rosbags.highlevel import AnyReader

from formats.bags import check_chunks, open_bag
from lifelong_slam.errors import SourceError
from lifelong_slam.sources.channel import Topic
from lifelong_slam.sources.natural_order import natural_order
from lifelong_slam.sources.salvage import SalvagedRecording, is_bag
from lifelong_slam.sources.typestores import default_typestore

_log = logging.getLogger(__name__)

_SUFFIXES = (".bag", ".mcap", ".db3")


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
                name: Topic(name, info.msgtype or "several types", info.msgcount, self._ros1)
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
        SourceError: there is no such path, or nothing in it can be read as a bag.
    """
    paths = _bag_paths(path)
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
    _log.warning(
        "%s is cut short or damaged, or has no index (%s): %d whole messages on %d topics are used",
        *(path, reason, count, len(salvaged.topics)),
    )
    return salvaged


def storage_files(paths: Iterable[Path]) -> list[Path]:
    """Return the files that hold messages: those of a folder, or the paths themselves."""
    files = []
    for path in paths:
        files += _parts(path) if path.is_dir() else [path]
    return files


def _bag_paths(path: Path) -> list[Path]:
    """Return what the reader is given: one file, a ROS 2 folder, or the parts of a split bag."""
    if not path.exists():
        raise SourceError(f"no such file or folder: {path}")
    if path.is_file():
        if path.stat().st_size == 0:
            raise SourceError(f"{path} is empty (0 bytes): there is no recording in it")
        return [path]
    if (path / "metadata.yaml").is_file():
        return [path]
    if parts := _parts(path):
        return parts
    raise SourceError(f"{path} holds no bag: expected *.bag, *.mcap, or metadata.yaml with *.db3")


def _parts(folder: Path) -> list[Path]:
    """Return the bag files in a folder, of the first kind that is there."""
    kinds = (sorted(folder.glob(f"*{suffix}"), key=natural_order) for suffix in _SUFFIXES)
    return next((files for files in kinds if files), [])


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
