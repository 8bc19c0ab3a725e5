"""Reading of damaged bags: whatever is whole, from the start on, without an index."""

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rosbags.typesys.store import Typestore

from lifelong_slam.sources import salvage_db3, salvage_mcap, salvage_ros1
from lifelong_slam.sources.channel import Channel, Topic
from lifelong_slam.sources.typestores import merged_typestore

_log = logging.getLogger(__name__)

Walk = Callable[[Path], Iterator[tuple[Channel, int, bytes]]]

_FORMATS: dict[bytes, Walk] = {
    salvage_ros1.MAGIC: salvage_ros1.walk,
    salvage_mcap.MAGIC: salvage_mcap.walk,
    salvage_db3.MAGIC: salvage_db3.walk,
}


def is_bag(path: Path) -> bool:
    """Tell by a file's first bytes whether it is a recording of a known format."""
    return _format(path) is not None


class SalvagedRecording:
    """A damaged recording, walked from its start as far as that goes."""

    def __init__(self, paths: list[Path]) -> None:
        """Walk through the files once to learn their topics; files of other kinds hold nothing."""
        self._paths = paths
        self._counts: Counter[str] = Counter()
        self._channels: dict[str, Channel] = {}
        for channel, _, _ in self._walk():
            self._channels.setdefault(channel.topic, channel)
            self._counts[channel.topic] += 1
        self._store: Typestore | None = None

    @property
    def is_whole(self) -> bool:
        """Whether as many messages were found as the files say they hold; only MCAP tells."""
        return sum(self._counts.values()) == sum(map(salvage_mcap.stated_count, self._paths))

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics that have a whole message, by name."""
        return {
            name: Topic(name, channel.msgtype, self._counts[name], channel.encoding)
            for name, channel in self._channels.items()
        }

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield receive time in ns and raw message, in recorded order."""
        for channel, receive_time, raw in self._walk():
            if channel.topic == topic:
                yield receive_time, raw

    def deserialize(self, raw: bytes, topic: str) -> Any:
        """Decode a raw message of a topic."""
        channel = self._channels[topic]
        if self._store is None:
            self._store = merged_typestore(self._channels.values())
        if channel.ros1:
            return self._store.deserialize_ros1(raw, channel.msgtype)
        return self._store.deserialize_cdr(raw, channel.msgtype)

    def _walk(self) -> Iterator[tuple[Channel, int, bytes]]:
        for path in self._paths:
            walk = _format(path)
            try:
                yield from walk(path) if walk else ()
            except Exception as error:  # damaged files break their parsers in any way
                _log.debug("%s: end of what is readable: %r", path, error)


def _format(path: Path) -> Walk | None:
    with path.open("rb") as file:
        head = file.read(max(map(len, _FORMATS)))
    return next((walk for magic, walk in _FORMATS.items() if head.startswith(magic)), None)
