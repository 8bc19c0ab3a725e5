"""The SQLite file of a map: its tables, and who may open it how.

At rest a map is a single file in rollback mode, which can be read from anywhere without changing a byte.
A writer switches it to write-ahead logging (WAL) and holds it locked until it closes; the lock is the
operating system's and ends with the process. What a killed writer had committed lies in the ``-wal``
file beside the map, and is seen by readers and taken over by the next writer. (To read that log SQLite
makes a ``-shm`` file, which the next writer removes.) Transactions survive the end of the process; if the
machine loses power the last ones may be missing, and the rest is whole.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from lifelong_slam.errors import MapError
from lifelong_slam.files import atomic_path

_APPLICATION = 0x4C534C4D  # "LSLM"
_SCHEMA_VERSION = 2
_OLDEST_VERSION = (
    1  # it has the same tables, but no composed edges: such count as loop closures there
)
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
    version TEXT NOT NULL
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
_UPGRADE = f"""
BEGIN;
ALTER TABLE edges RENAME TO old_edges;
DROP INDEX edges_of_source;
DROP INDEX edges_of_target;
{_EDGES}
INSERT INTO edges SELECT * FROM old_edges;
DROP TABLE old_edges;
PRAGMA user_version = {_SCHEMA_VERSION};
COMMIT;
"""


def create_file(path: Path, row: tuple[object, ...]) -> None:
    """Make a map file without sessions, all at once.

    Args:
        path: where nothing may be yet.
        row: of table ``map``.

    Raises:
        MapError: something is there already, or it can't be written.
    """
    if path.exists():
        raise MapError(f"{path} is there already")
    with (
        errors_of(path),
        atomic_path(path) as temporary,
        closing(sqlite3.connect(temporary)) as connection,
    ):
        connection.executescript(_SCHEMA)
        connection.execute("INSERT INTO map VALUES (?, ?, ?, ?, ?)", row)
        connection.commit()


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
    with errors_of(path):
        try:
            return _connect(path, "mode=ro")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_READONLY_ROLLBACK:
                raise
            # A writer was killed as it switched the journal's mode, which is all that page 1 holds of
            # that transaction: with or without it the rest is whole.
            return _connect(path, "mode=ro&immutable=1")


def connect_to_write(path: Path) -> sqlite3.Connection:
    """Open an undamaged map to go on with it; nobody else can open it meanwhile.

    One of an older format becomes one of this version's.

    Raises:
        MapError: there is no map that this version reads, it is damaged, or another process has it
            open; the file stays as it is.
    """
    connect_to_read(path).close()
    with errors_of(path), _closed_on_error(_connect(path, "mode=rw")) as connection:
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("BEGIN IMMEDIATE")
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        connection.execute("COMMIT")
        if version < _SCHEMA_VERSION:
            connection.executescript(_UPGRADE)
    path.with_name(f"{path.name}-shm").unlink(
        missing_ok=True
    )  # a reader's; the lock says it's gone
    return connection


def close(connection: sqlite3.Connection) -> None:
    """Close a map; a writer leaves a single file."""
    with closing(connection):
        if not connection.execute("PRAGMA query_only").fetchone()[0]:
            connection.execute("PRAGMA journal_mode = DELETE")


@contextmanager
def errors_of(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into a MapError that names the file, save those that are bugs."""
    try:
        yield
    except (sqlite3.IntegrityError, sqlite3.ProgrammingError):
        raise
    except sqlite3.DatabaseError as error:
        if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
            raise MapError(f"{path} is in use by another process") from error
        raise MapError(f"{path} can't be used: {error}") from error
    except UnicodeDecodeError as error:  # SQLite quotes what it can't read
        raise MapError(f"{path} is damaged: the names of its tables can't be read") from error


@contextmanager
def _closed_on_error(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    try:
        yield connection
    except BaseException:
        connection.close()
        raise


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open a file and take a look at it, which is when SQLite notices what is wrong."""
    uri = f"{path.resolve().as_uri()}?{mode}"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_SECONDS_TO_WAIT)
    connection.text_factory = lambda text: text.decode(errors="replace")  # of damaged pages
    with _closed_on_error(connection):
        connection.execute(f"PRAGMA query_only = {mode != 'mode=rw'}")
        connection.execute("PRAGMA schema_version").fetchone()
    return connection


def _check_header(path: Path) -> None:
    """Check that a file is a map that this version reads, and leave no files beside one that isn't."""
    if not path.is_file():
        raise MapError(f"{path} is not a file" if path.exists() else f"no such map: {path}")
    has_log = Path(f"{path.resolve()}-wal").exists()  # without which the file may be in pieces
    mode = "mode=ro" if has_log else "mode=ro&immutable=1"
    with errors_of(path), closing(_connect(path, mode)) as connection:
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
