"""Whether the log beside a map file belongs to it.

What a killed writer had committed lies in ``FILE-wal``, and SQLite takes in whatever has that name:
nothing in such a log says which database it was written for
(https://www.sqlite.org/fileformat2.html#the_write_ahead_log). A map that is put back from a backup, or
made anew, would be mixed with pages of the one before. So each state of a map in which a log begins is
a *generation* with a random name, and the first page in the log is the one that holds it: the name
of what the log leads to, and that of its parent, which it goes on from. The file has either of the
two, the former once that page has been brought over, if the log is its own.
"""

import os
import sqlite3
from pathlib import Path

NEW_GENERATION = "lower(hex(randomblob(16)))"
_HEADER, _FRAME_HEADER, _PAGE_SIZES = 32, 24, (512, 65536)  # bytes, of a log
_PAGE_SIZE, _SALTS = slice(8, 12), slice(16, 24)  # in its header
_PAGES_AFTER_COMMIT, _FRAME_SALTS = slice(4, 8), slice(8, 16)  # in a frame's; the former else 0
_READ_VERSION, _LOGGED = 19, 2  # byte of a database file, and what it is while there is a log
_LONGEST = 4 << 20  # bytes of a log until it is brought into the file, as by SQLite itself


def log_of(path: Path) -> Path:
    """Return where SQLite keeps the log of a map."""
    return Path(f"{path.resolve()}-wal")


def begin_log(connection: sqlite3.Connection) -> None:
    """Bring the log into the file, and begin another one for the generation to come."""
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    connection.execute(f"UPDATE map SET parent = generation, generation = {NEW_GENERATION}")


def keep_short(connection: sqlite3.Connection, path: Path) -> None:
    """Begin another log where the one at hand is long, or nothing is in it yet."""
    log = log_of(path)
    if not log.exists() or not 0 < log.stat().st_size < _LONGEST:
        begin_log(connection)


def cut_to_commit(path: Path) -> None:
    """Cut off what a transaction that failed left in the log, as space is what it may have failed for."""
    with log_of(path).open("r+b") as log:
        size = int.from_bytes((header := log.read(_HEADER))[_PAGE_SIZE])
        frames = range(_HEADER, log.seek(0, os.SEEK_END), _FRAME_HEADER + size)
        committed = 0
        for start in frames:
            log.seek(start)
            frame = log.read(_FRAME_HEADER)
            if frame[_FRAME_SALTS] == header[_SALTS] and any(frame[_PAGES_AFTER_COMMIT]):
                committed = start + _FRAME_HEADER + size
        log.truncate(committed)


def is_foreign(path: Path, alone: sqlite3.Connection) -> bool:
    """Tell whether a log lies beside a map that isn't its own; nobody may write to it meanwhile.

    Args:
        path: of the map.
        alone: connection to the map that sees no log.
    """
    log = log_of(path)
    if not log.exists() or not (page := _first_page(log)):
        return False
    generation = _generation(alone)
    if generation is None:  # an older format: SQLite's header says whether a writer was at work
        # Not read from the file, as closing that would drop all locks that this process has on it.
        return alone.serialize()[_READ_VERSION] != _LOGGED
    return generation.encode() not in page


def _first_page(log: Path) -> bytes:
    """Return the first page in a log, empty where none is whole."""
    with log.open("rb") as file:
        size = int.from_bytes(file.read(_HEADER)[_PAGE_SIZE])
        if not _PAGE_SIZES[0] <= size <= _PAGE_SIZES[1]:  # it is no log at all
            size = _PAGE_SIZES[0]
        file.seek(_HEADER + _FRAME_HEADER)
        page = file.read(size)
    return page if len(page) == size else b""


def _generation(alone: sqlite3.Connection) -> str | None:
    """Return the generation of a map file without its log; None where it doesn't say."""
    try:
        (generation,) = alone.execute("SELECT generation FROM map").fetchone()
    except (sqlite3.DatabaseError, TypeError):
        return None
    return str(generation)
