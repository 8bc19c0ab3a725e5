"""Read the rows of a ROS 2 SQLite bag one by one, until SQLite gives up."""

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from rosbags.typesys.msg import normalize_msgtype

from lifelong_slam.sources.channel import Channel

_log = logging.getLogger(__name__)

MAGIC = b"SQLite format 3\0"


def walk(path: Path) -> Iterator[tuple[Channel, int, bytes]]:
    """Yield channel, receive time in ns and raw message, in the order of the rows.

    Rows that SQLite can't read any more (the file is cut or malformed) end the walk.
    """
    uri = f"file:{quote(str(path.absolute()))}?immutable=1"
    with closing(sqlite3.connect(uri, uri=True)) as database:
        try:
            # without this, SQLite refuses every file that is shorter than its header says
            database.execute("PRAGMA writable_schema = ON")
            channels = _channels(database)
            # by row, not by time: the index on time may lie behind the cut
            query = "SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id"
            for topic, receive_time, raw in database.execute(query):
                if topic in channels:
                    yield channels[topic], receive_time, raw
        except sqlite3.Error as error:
            _log.debug("%s: end of what is readable: %s", path, error)


def _channels(database: sqlite3.Connection) -> dict[int, Channel]:
    definitions = _definitions(database)
    rows = database.execute("SELECT id, name, type FROM topics").fetchall()
    return {
        number: Channel(name, str(normalize_msgtype(kind)), *definitions.get(kind, ("", False)))
        for number, name, kind in rows
    }


def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, bool]]:
    """Return definition and whether it is IDL by type; older bags have none."""
    query = "SELECT topic_type, encoded_message_definition, encoding FROM message_definitions"
    try:
        rows = database.execute(query).fetchall()
    except sqlite3.Error:
        return {}
    return {kind: (text, "idl" in encoding) for kind, text, encoding in rows}
