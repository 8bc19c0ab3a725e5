"""The map as a file: written as a run goes, read when the next one starts.

One SQLite file a map and one transaction a keyframe, so that a run that is killed loses at most the
keyframe in flight.
"""

import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lifelong_slam import __version__
from lifelong_slam.errors import MapError
from lifelong_slam.mapping import codec, map_file, map_log
from lifelong_slam.mapping.map_reading import read_info, read_map
from lifelong_slam.mapping.map_writing import write_update
from lifelong_slam.mapping.saved_map import Array, MapInfo, MapUpdate, SavedMap


class MapStore:
    """An open map file. As a context manager it closes the file."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        """Wrap an open file; `create` and `open` are the ways to get one."""
        self._path = path
        self._connection = connection

    @classmethod
    def create(cls, path: Path, sensor: str, T_base_sensor: Array, voxel_size: float) -> "MapStore":
        """Make a new map and open it for writing.

        Args:
            path: where nothing may be yet.
            sensor: name of the sensor's settings.
            T_base_sensor: (4, 4) pose of the sensor on the base.
            voxel_size: metres, of the submaps' voxels.

        Raises:
            MapError: something is there already, or it can't be written.
        """
        pose = codec.pack_matrix(T_base_sensor)
        map_file.create_file(path, (sensor, pose, voxel_size, time.time_ns(), __version__))
        return cls.open(path)

    @classmethod
    def open(cls, path: Path, read_only: bool = False) -> "MapStore":
        """Open a map.

        Args:
            path: of the file.
            read_only: leave the file as it is, byte for byte; any number of readers may have it open
                at a time, but no writer beside them.

        Raises:
            MapError: there is no map that this version reads, it is damaged, or it is in use; the file
                stays as it is.
        """
        connect = map_file.connect_to_read if read_only else map_file.connect_to_write
        return cls(path, connect(path))

    def __enter__(self) -> "MapStore":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; after a writer it is a single file again."""
        with map_file.errors_of(self._path):
            map_file.close(self._connection)

    def release_space(self) -> None:
        """After a write that failed, take no more space than what was committed needs."""
        with suppress(OSError):
            map_log.cut_to_commit(self._path)

    def begin_session(self, source: str, config: str) -> int:
        """Add a session and return its id; the first one counts as located.

        Args:
            source: name of what the scans come from.
            config: of the run, YAML.
        """
        with self._transaction() as db:
            (session,) = db.execute("SELECT count(*) FROM sessions").fetchone()
            db.execute(
                "INSERT INTO sessions VALUES (?, ?, ?, ?, FALSE, ?)",
                (session, time.time_ns(), source, config, session == 0),
            )
        return int(session)

    def end_session(self, session: int) -> None:
        """Mark a session as finished."""
        with self._transaction() as db:
            db.execute("UPDATE sessions SET finished = TRUE WHERE id = ?", (session,))

    def write(self, update: MapUpdate) -> None:
        """Write all of an update, or nothing of it.

        Raises:
            MapError: the file can't be written, for instance because the disk is full.
            ValueError: a pose is given for what is not a vertex, or a cloud can't be stored.
            sqlite3.IntegrityError: the update names what the map doesn't hold.
        """
        with self._transaction() as db:
            write_update(db, update)

    def info(self) -> MapInfo:
        """Read what holds for the map as a whole.

        Raises:
            MapError: it is damaged.
        """
        with map_file.errors_of(self._path), self._connection as db:
            return read_info(db)

    def load(self) -> SavedMap:
        """Read all of the map, as of one moment.

        Raises:
            MapError: something in it is damaged, named by table and id.
        """
        with map_file.errors_of(self._path), self._connection as db:
            db.execute("BEGIN")
            try:
                return read_map(db)
            except MapError as error:
                raise MapError(f"{self._path} is damaged: {error}") from error

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """Commit what happens inside, or roll it back."""
        with map_file.errors_of(self._path), self._connection as db:
            map_log.keep_short(db, self._path)
            db.execute("BEGIN IMMEDIATE")
            db.execute("PRAGMA defer_foreign_keys = ON")
            yield db
