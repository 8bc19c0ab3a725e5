"""The SQLite file of a map: its tables, and who may open it how.

At rest a map is a single file in rollback mode, which can be read from anywhere without changing a byte.
A writer switches it to write-ahead logging (WAL) and holds it locked until it closes; the lock is the
operating system's and ends with the process. What a killed writer had committed lies in the ``-wal``
file beside the map, and is seen by readers and taken over by the next writer. (To read that log SQLite
makes a ``-shm`` file, which the next writer removes.) What lies there and isn't of the map (see
`map_log`) readers leave out and writers rename. Transactions survive the end of the process; if the
machine loses power the last ones may be missing, and the rest is whole.
"""

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from lifelong_slam.errors import MapError
from lifelong_slam.files import atomic_path, set_aside
from lifelong_slam.mapping import map_log
from lifelong_slam.mapping.map_log import NEW_GENERATION

logger = logging.getLogger(__name__)

_APPLICATION = 0x4C534C4D  # "LSLM"
_SCHEMA_VERSION = 3
_OLDEST_VERSION = 1
_ALONE = "mode=ro&immutable=1"
_SECONDS_TO_WAIT = 0.5  # for others, who may need the file for a moment only

# What no map has, and what can make SQLite compute without an end, or give values of another type.
_FOREIGN = """
SELECT name FROM sqlite_schema WHERE type NOT IN ('table', 'index')
UNION ALL SELECT name FROM pragma_table_list
    WHERE schema = 'main' AND name NOT LIKE 'sqlite%' AND (type <> 'table' OR NOT strict)
UNION ALL SELECT t.name || '.' || c.name FROM pragma_table_list AS t, pragma_table_xinfo(t.name) AS c
    WHERE t.schema = 'main' AND t.name NOT LIKE 'sqlite%' AND (c.hidden OR NOT (c."notnull" OR c.pk))
"""
_EDGES = """
CREATE TABLE edges (
    id INTEGER PRIMARY KEY,
    source INTEGER NOT NULL REFERENCES vertices,
    target INTEGER NOT NULL REFERENCES vertices,
    kind TEXT NOT NULL CHECK (kind IN ('odometry', 'loop', 'composed')),
    rejected INTEGER NOT NULL,
    T_source_target BLOB NOT NULL,
    covariance BLOB NOT NULL
) STRICT;
CREATE INDEX edges_of_source ON edges (source);
CREATE INDEX edges_of_target ON edges (target);
"""
_SCHEMA = f"""
PRAGMA application_id = {_APPLICATION};
PRAGMA user_version = {_SCHEMA_VERSION};

CREATE TABLE map (
    sensor TEXT NOT NULL,
    T_base_sensor BLOB NOT NULL,
    voxel_size REAL NOT NULL,
    created INTEGER NOT NULL,
    version TEXT NOT NULL,
    generation TEXT NOT NULL,  -- names the state that the map is in, see `map_log`
    parent TEXT NOT NULL  -- that of the state before
) STRICT;
CREATE TABLE sessions (
    id INTEGER PRIMARY KEY,
    started INTEGER NOT NULL,
    source TEXT NOT NULL,
    config TEXT NOT NULL,
    finished INTEGER NOT NULL,
    located INTEGER NOT NULL
) STRICT;
-- Every keyframe ever taken: a vertex of the graph, or removed from it.
CREATE TABLE keyframes (
    id INTEGER PRIMARY KEY,
    session INTEGER NOT NULL REFERENCES sessions,
    stamp INTEGER NOT NULL,
    travelled REAL NOT NULL
) STRICT;
CREATE TABLE vertices (
    id INTEGER PRIMARY KEY REFERENCES keyframes,
    T_map BLOB NOT NULL,
    T_odom BLOB NOT NULL,
    covariance BLOB NOT NULL
) STRICT;
CREATE TABLE removals (
    number INTEGER PRIMARY KEY,  -- in the order in which they were made
    id INTEGER NOT NULL UNIQUE REFERENCES keyframes,
    support BLOB NOT NULL  -- neighbours, which are vertices or were removed later, poses and gains
) STRICT;
CREATE TABLE features (
    id INTEGER PRIMARY KEY REFERENCES vertices ON DELETE CASCADE,
    points BLOB NOT NULL
) STRICT;
CREATE TABLE unsettled (  -- points for the map that are in no submap yet
    id INTEGER PRIMARY KEY REFERENCES vertices ON DELETE CASCADE,
    points BLOB NOT NULL
) STRICT;
CREATE TABLE submaps (
    id INTEGER PRIMARY KEY REFERENCES vertices ON DELETE CASCADE,
    voxels BLOB NOT NULL
) STRICT;
{_EDGES}
CREATE TABLE scans (
    id INTEGER PRIMARY KEY,
    session INTEGER NOT NULL REFERENCES sessions,
    anchor INTEGER NOT NULL REFERENCES keyframes,
    poses BLOB NOT NULL
) STRICT;
CREATE TABLE places (
    id INTEGER PRIMARY KEY REFERENCES keyframes,
    points BLOB NOT NULL
) STRICT;
"""
_UPGRADES = {  # from each older format to the next
    # In the first one edges were odometry or loop closures, and composed ones counted as the latter.
    1: f"""
BEGIN;
ALTER TABLE edges RENAME TO old_edges;
DROP INDEX edges_of_source;
DROP INDEX edges_of_target;
{_EDGES}
INSERT INTO edges SELECT * FROM old_edges;
DROP TABLE old_edges;
PRAGMA user_version = 2;
COMMIT;
""",
    # The second one had no generations.
    2: f"""
BEGIN;
ALTER TABLE map ADD COLUMN generation TEXT NOT NULL DEFAULT '';
ALTER TABLE map ADD COLUMN parent TEXT NOT NULL DEFAULT '';
UPDATE map SET generation = {NEW_GENERATION}, parent = {NEW_GENERATION};
PRAGMA user_version = 3;
COMMIT;
""",
}


def create_file(path: Path, row: tuple[object, ...]) -> None:
    """Make a map file without sessions, all at once.

    Args:
        path: where nothing may be yet.
        row: of table ``map``.

    Raises:
        MapError: something is there already, or it can't be written.
    """
    try:
        with (
            errors_of(path),
            atomic_path(path, exclusive=True) as temporary,
            closing(sqlite3.connect(temporary)) as connection,
        ):
            connection.executescript(_SCHEMA)
            values = f"?, ?, ?, ?, ?, {NEW_GENERATION}, {NEW_GENERATION}"
            connection.execute(f"INSERT INTO map VALUES ({values})", row)
            connection.commit()
    except FileExistsError as error:
        raise MapError(f"{path} is there already") from error


def connect_to_read(path: Path) -> sqlite3.Connection:
    """Open an undamaged map so that nothing can change it.

    Raises:
        MapError: there is no map that this version reads, it is damaged, or a writer has it open.
    """
    with errors_of(path), _closed_on_error(connect_to_check(path)) as connection:
        (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise MapError(f"{path} is damaged: {verdict}")
    return connection


def connect_to_check(path: Path) -> sqlite3.Connection:
    """Open a map as `connect_to_read` does, but perhaps a damaged one.

    Raises:
        MapError: there is no map that this version reads, or a writer has it open.
    """
    _check_header(path)
    with errors_of(path), _writers_kept_out(path) as strays:
        if not strays:
            return _connect(path, "mode=ro")
        logger.warning("%s is read without %s, which is not of this map", path, _names(strays))
        with closing(_connect_alone(path)) as alone:
            return _copy(alone)


def connect_to_write(path: Path) -> sqlite3.Connection:
    """Open an undamaged map to go on with it; nobody else can open it meanwhile.

    One of an older format becomes one of this version's.

    Raises:
        MapError: there is no map that this version reads, it is damaged, or another process has it
            open; the file stays as it is.
    """
    _check_header(path)
    _set_strays_aside(path)
    connect_to_read(path).close()
    with errors_of(path), _closed_on_error(_connect(path, "mode=rw")) as connection:
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
        # Takes in what a killed writer left. No journal as modes are switched: a kill would leave it.
        connection.execute("PRAGMA journal_mode = MEMORY")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA wal_autocheckpoint = 0")  # `map_log` has to know when
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("PRAGMA secure_delete = FAST")  # no page keeps an older generation
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("BEGIN IMMEDIATE")
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        connection.execute("COMMIT")
        for older in range(version, _SCHEMA_VERSION):
            connection.executescript(_UPGRADES[older])
        map_log.begin_log(connection)
        map_log.begin_log(connection)  # on no state of a map at rest, which backups are made of
    path.with_name(f"{path.name}-shm").unlink(
        missing_ok=True
    )  # a reader's; the lock says it's gone
    return connection


def close(connection: sqlite3.Connection) -> None:
    """Close a map; a writer leaves a single file."""
    with closing(connection):
        if not connection.execute("PRAGMA query_only").fetchone()[0]:
            connection.execute("PRAGMA journal_mode = MEMORY")


@contextmanager
def errors_of(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into a MapError that names the file, save those that are bugs."""
    try:
        yield
    except (sqlite3.IntegrityError, sqlite3.ProgrammingError):
        raise
    except sqlite3.DatabaseError as error:
        if _is_busy(error):
            raise MapError(f"{path} is in use by another process") from error
        raise MapError(f"{path.resolve()} can't be used: {error}") from error
    except UnicodeDecodeError as error:  # SQLite quotes what it can't read
        raise MapError(f"{path} is damaged: the names of its tables can't be read") from error


@contextmanager
def _closed_on_error(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    try:
        yield connection
    except BaseException:
        connection.close()
        raise


@contextmanager
def _writers_kept_out(path: Path) -> Iterator[list[Path]]:
    """Yield what lies beside a map and isn't of it, while no writer can open it.

    Where SQLite can't make sense of the map with what lies beside it, there is no lock.

    Raises:
        sqlite3.DatabaseError: a writer has it open, or it is damaged by itself.
    """
    log = map_log.log_of(path)
    had_log = log.exists()
    try:
        lock = _connect(path, "mode=ro")
    except sqlite3.DatabaseError as error:
        strays = [] if _is_busy(error) else _strays(path, error.sqlite_errorcode)
        if not strays:
            raise
        yield strays
        return
    with closing(lock):
        yield _strays(path)
        (mode,) = lock.execute("PRAGMA journal_mode").fetchone()
        if mode == "wal" and not had_log and log.stat().st_size == 0:
            log.unlink()  # SQLite has made it, as a writer was killed between log and file at rest


def _strays(path: Path, error: int = sqlite3.SQLITE_OK) -> list[Path]:
    """Return what lies beside a map and isn't of it, given what SQLite said as it opened all of it.

    A journal isn't ever: writers keep none. Those of earlier versions did while they switched modes,
    which is all that page 1 holds of such a transaction: with or without it the rest is whole.
    """
    with closing(_connect_alone(path)) as alone:
        logs = [map_log.log_of(path)] if map_log.is_foreign(path, alone) else []
    is_hot = error == sqlite3.SQLITE_READONLY_ROLLBACK
    return logs + [Path(f"{path.resolve()}-journal")] * is_hot


def _set_strays_aside(path: Path) -> None:
    """Rename what lies beside a map and isn't of it, which SQLite would mix with it."""
    with errors_of(path), _writers_kept_out(path) as strays:
        for stray in strays:
            aside = set_aside(stray)
            logger.warning("%s is not of this map: set aside as %s", stray, aside.name)


def _names(paths: list[Path]) -> str:
    return " and ".join(path.name for path in paths)


def _is_busy(error: sqlite3.DatabaseError) -> bool:
    return error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open a file and take a look at it, which is when SQLite notices what is wrong."""
    uri = f"{path.resolve().as_uri()}?{mode}"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_SECONDS_TO_WAIT)
    with _closed_on_error(connection):
        _prepare(connection, query_only=mode != "mode=rw")
        if mode == _ALONE:  # read even if it is shorter than it says, as the log has the rest
            connection.execute("PRAGMA writable_schema = ON")
        connection.execute("PRAGMA schema_version").fetchone()
    return connection


def _connect_alone(path: Path) -> sqlite3.Connection:
    """Open a file to read it as it is, whatever lies beside it."""
    return _connect(path, _ALONE)


def _copy(connection: sqlite3.Connection) -> sqlite3.Connection:
    """Return a copy in memory, where nothing lies beside it."""
    copy = sqlite3.connect(":memory:", isolation_level=None)
    with _closed_on_error(copy):
        connection.backup(copy)
        _prepare(copy, query_only=True)
    return copy


def _prepare(connection: sqlite3.Connection, query_only: bool) -> None:
    connection.text_factory = lambda text: text.decode(errors="replace")  # of damaged pages
    connection.execute(f"PRAGMA query_only = {query_only}")


def _check_header(path: Path) -> None:
    """Check that a file is a map that this version reads, and leave no files beside one that isn't."""
    if not path.is_file():
        raise MapError(f"{path} is not a file" if path.exists() else f"no such map: {path}")
    with errors_of(path), closing(_connect_alone(path)) as connection:
        (application,) = connection.execute("PRAGMA application_id").fetchone()
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        foreign = connection.execute(_FOREIGN).fetchall()
    if application != _APPLICATION:
        raise MapError(f"{path} is not a map of lifelong_slam")
    if foreign:
        raise MapError(f"{path} is not a map of lifelong_slam: it has '{foreign[0][0]}'")
    if not _OLDEST_VERSION <= version <= _SCHEMA_VERSION:
        raise MapError(
            f"{path} has map format {version}; this version of lifelong_slam knows {_OLDEST_VERSION}"
            f" to {_SCHEMA_VERSION}"
        )
