"""A run's part in a map file: what it finds there, and what it adds as it goes."""

import logging
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import MapError
from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.removal import Removal
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.mapping.saved_map import MapInfo, MapUpdate, SavedMap, Scans
from lifelong_slam.mapping.store import MapStore
from lifelong_slam.mapping.submap import Submap
from lifelong_slam.result import Edge

Array = NDArray[np.float64]
Mode = Literal["map", "localize"]

logger = logging.getLogger(__name__)

_TOLERANCE = 1e-6  # between calibrations that count as the same


class MapSession:
    """An open map file in which a run is a session, or only looks.

    A file that can't be written any more, as when the disk is full, doesn't end the run: it keeps what it
    has got by then, as if the run had been killed.

    Attributes:
        localize: the map is read, and stays as it is.
        id: of this session.
        failure: why the file isn't written any more, or None.
    """

    def __init__(self, store: MapStore, saved: SavedMap | None, id: int, localize: bool) -> None:
        """Wrap an open file; `open` is the way to get one."""
        self._store = store
        self._saved = saved
        self.id = id
        self.localize = localize
        self.failure: MapError | None = None
        self._is_open = True
        # Sessions in a frame of their own; one may be joined to the map by a later one.
        self._unlocated = {s.id for s in saved.sessions if not s.located} if saved else set()
        if id > 0 or localize:
            self._unlocated.add(id)
        self._is_nowhere = localize and saved is None
        self._roots: list[int] = []
        self._edges: dict[int, Edge] = dict(saved.edges) if saved else {}
        self._rejected = saved.rejected if saved else frozenset()
        self._poses: dict[int, Array] = dict(saved.poses) if saved else {}

    @property
    def is_located(self) -> bool:
        """Whether the session is in the map's frame; known after each call of `write`."""
        return self.id not in self._unlocated

    @classmethod
    def open(
        cls,
        path: Path,
        mode: Mode,
        sensor: str,
        T_base_sensor: Array,
        voxel_size: float,
        source: str,
        config: str,
    ) -> "MapSession":
        """Open a map and begin a session, or make a new map.

        Args:
            path: of the file.
            mode: "map" to add to it, "localize" to leave it as it is.
            sensor: name of the sensor's settings.
            T_base_sensor: (4, 4) pose of the sensor on the base.
            voxel_size: metres, of the map.
            source: name of what the scans come from.
            config: of the run, YAML.

        Raises:
            MapError: the file is not a map or damaged, was made with another sensor or voxel size, or
                is to be localised in and isn't there.
        """
        localize = mode == "localize"
        if not path.exists() and not localize:
            _make(path, sensor, T_base_sensor, voxel_size)
        with MapStore.open(path, read_only=True) as look:  # a map that doesn't fit stays untouched
            _check_fit(path, look.info(), sensor, T_base_sensor, voxel_size)
        store = MapStore.open(path, read_only=localize)
        try:
            saved = store.load()
            session = len(saved.sessions) if localize else store.begin_session(source, config)
        except BaseException:
            store.close()
            raise
        return cls(store, saved if saved.poses else None, session, localize)

    def __enter__(self) -> "MapSession":
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_open:
            with self._going_on():
                self._close()

    def take_saved(self) -> SavedMap | None:
        """Return the map as earlier sessions left it, once; None for a new one."""
        saved = self._saved
        self._saved = None
        return saved

    def write(
        self,
        graph: PoseGraph,
        vertices: Mapping[int, Keyframe],
        scans: Iterable[tuple[int, NDArray[np.int64], Array]],
        removals: Iterable[Removal],
        settled: Collection[int],
        submaps: Mapping[int, Submap],
        places: Mapping[int, NDArray[np.float32]],
    ) -> None:
        """Write what changed since the last call, in one transaction; nothing when localising.

        Args:
            graph: as it stands.
            vertices: keyframes that are in it.
            scans: new ones: keyframe that they hang on, (N,) stamps, (N, 4, 4) T_keyframe_scan.
            removals: new ones.
            settled: keyframes whose points are in the submaps from now on.
            submaps: that changed, by owner.
            places: new local maps by keyframe.
        """
        roots = graph.roots
        located: set[int] = set()
        if roots != self._roots and not self._is_nowhere:
            located = self._unlocated & _located(graph, vertices)
        self._roots = roots
        self._unlocated -= located
        if self.localize or self.failure:
            return
        edges, rejected, poses = graph.keyed_edges(), graph.rejected_keys, graph.poses()
        update = MapUpdate(
            keyframes=[vertices[i] for i in sorted(poses.keys() - self._poses.keys())],
            poses={i: T for i, T in poses.items() if not _same(self._poses.get(i), T)},
            removed=list(removals),
            edges={key: e for key, e in edges.items() if self._edges.get(key) is not e},
            removed_edges=self._edges.keys() - edges.keys(),
            rejected=rejected if rejected != self._rejected else None,
            scans=[Scans(self.id, *rows) for rows in scans],
            settled=[vertex for vertex in settled if vertex in graph],
            submaps={i: submap.arrays() for i, submap in submaps.items()},
            places=places,
            located=located,
        )
        with self._going_on():
            self._store.write(update)
        self._edges, self._rejected, self._poses = edges, rejected, poses

    def end(self) -> None:
        """Mark the session as finished and close the file, which then has to be written no more."""
        if not self.localize and not self.failure:
            with self._going_on():
                self._store.end_session(self.id)
                self._close()

    def _close(self) -> None:
        self._is_open = False
        self._store.close()

    @contextmanager
    def _going_on(self) -> Iterator[None]:
        """Have the run go on without a file that can't be written.

        It isn't closed yet, which would take the space that results may have.
        """
        try:
            yield
        except MapError as error:
            if self.failure is None:
                logger.error("%s: the run goes on without it", error)
                self.failure = error
                self._store.release_space()


def _make(path: Path, sensor: str, T_base_sensor: Array, voxel_size: float) -> None:
    """Make a map, unless another process does so at the same time."""
    try:
        MapStore.create(path, sensor, T_base_sensor, voxel_size).close()
    except MapError:
        if not path.exists():
            raise


def _located(graph: PoseGraph, vertices: Mapping[int, Keyframe]) -> set[int]:
    """Return the sessions in the component of the map's first vertex."""
    connected = graph.component(graph.roots[0])
    return {keyframe.session for i, keyframe in vertices.items() if i in connected}


def _same(before: Array | None, now: Array) -> bool:
    return before is not None and bool(np.array_equal(before, now))


def _check_fit(
    path: Path, info: MapInfo, sensor: str, T_base_sensor: Array, voxel_size: float
) -> None:
    """Refuse a map that was made with other settings."""
    if info.sensor != sensor:
        raise MapError(f"{path} was made with sensor={info.sensor}, not {sensor}")
    if not np.allclose(info.T_base_sensor, T_base_sensor, atol=_TOLERANCE):
        raise MapError(
            f"{path} was made with the sensor elsewhere on the base:\n{info.T_base_sensor}\n"
            f"and not\n{T_base_sensor}"
        )
    if info.voxel_size != voxel_size:
        raise MapError(f"{path} has voxels of {info.voxel_size} m, not {voxel_size} m")
