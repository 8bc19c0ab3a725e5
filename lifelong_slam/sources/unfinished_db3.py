"""ROS 2 SQLite bags whose recorder was killed: their latest messages are in a log beside them.

SQLite keeps what isn't in the file yet in a write-ahead log, ``-wal``; or, in its older mode, what the
file held before a change that isn't complete, in a rollback journal, ``-journal``. It brings a file in
order when it opens it, by writing to it. A recording isn't ours to write to, so that is done to a copy.
"""

import logging
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

from lifelong_slam.errors import SourceError

_log = logging.getLogger(__name__)

_LOGS = ("-wal", "-journal")


def is_unfinished(path: Path) -> bool:
    """Tell whether a log that is not empty lies beside a file."""
    return bool(_logs(path))


def finished(path: Path, scratch: Path) -> Path:
    """Return a copy, in folder `scratch`, of a bag's file with what is in the log beside it.

    Where the log is damaged or of another file, it is left out with a warning and `path` returned.

    Raises:
        SourceError: there is no room for the copy.
    """
    logs = _logs(path)
    names = " and ".join(log.name for log in logs)
    copy = scratch / path.name
    try:
        for file in (path, *logs):
            shutil.copyfile(file, scratch / file.name)
    except OSError as error:
        raise SourceError(
            f"{path} must be copied to be read together with {names}: {error}; give a folder with"
            " enough room in the environment variable TMPDIR"
        ) from None
    if not _take_in_log(copy):
        _log.warning("%s: %s beside it is damaged or not its own: left out", path, names)
        return path
    _log.warning(
        "%s: its recorder was stopped before it was done: read together with %s, in a copy of %.1f MB",
        *(path, names, copy.stat().st_size / 1e6),
    )
    return copy


def _logs(path: Path) -> list[Path]:
    logs = (path.with_name(path.name + suffix) for suffix in _LOGS)
    return [log for log in logs if log.is_file() and log.stat().st_size]


def _take_in_log(path: Path) -> bool:
    """Have SQLite bring a file in order; tell whether it is sound afterwards."""
    try:
        with closing(sqlite3.connect(path)) as database:
            database.execute("PRAGMA journal_mode = DELETE").fetchall()
            (verdict,) = database.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.Error as error:
        _log.debug("%s: %s", path, error)
        return False
    return bool(verdict == "ok")
