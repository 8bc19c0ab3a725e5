"""Truth about what changes between sessions: `movable.npz` beside the bag of a session.

It lists every object that may be gone in another session, by an id that is the same in each session
of its stay, and the surface of it that the rig saw: the spots where beams met it and returned, by the
ray casting, without noise. What is gone or new between two sessions follows from the ids.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError
from lifelong_slam.simulation.raycast import Floats, Hits
from lifelong_slam.simulation.returns import Label, Returns
from lifelong_slam.simulation.seasons import Movable

_GRID = 0.05  # metres; one spot of an object in each cell
_BATCH = 100  # sweeps whose spots are joined at a time; bounds memory


@dataclass(frozen=True, slots=True)
class MovableTruth:
    """What changes between sessions, as one session saw it.

    Attributes:
        ids: (M,) int64 ids of the objects that are there, seen or not.
        kinds: (M,) their kinds: `car`, `box` or `leaves`.
        points: (N, 3) float32 spots on their surfaces where beams returned, one in each 5 cm, metres
            in the world's frame.
        objects: (N,) int64 id of the object that each spot is on.
        returns: (N,) int64 how many beams returned from each 5 cm.
    """

    ids: NDArray[np.int64]
    kinds: NDArray[np.str_]
    points: NDArray[np.float32]
    objects: NDArray[np.int64]
    returns: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Check that the arrays belong together.

        Raises:
            ValueError: their lengths disagree.
        """
        if len(self.ids) != len(self.kinds):
            raise ValueError(f"{len(self.ids)} ids do not fit {len(self.kinds)} kinds")
        shapes = self.points.shape, self.objects.shape, self.returns.shape
        count = len(self.points)
        if shapes != ((count, 3), (count,), (count,)):
            raise ValueError(f"points, objects and returns do not fit: {shapes}")


class SeenMovables:
    """Gathers what sweeps see of the objects whose triangles are the last of a world's.

    Args:
        movables: the objects, in the order of their triangles.
        triangles: how many the world has in all.
    """

    def __init__(self, movables: Sequence[Movable], triangles: int) -> None:
        self._movables = movables
        sizes = np.array([len(movable.mesh) for movable in movables])
        self._firsts = triangles - sizes.sum() + np.cumsum(sizes) - sizes
        self._rows: list[NDArray[np.float64]] = []  # x y z index returns

    def add(self, rays: Floats, hits: Hits, returns: Returns) -> None:
        """Add a sweep: its (C, R, 6) rays in the world, what they met and what came back."""
        beams = returns.column, returns.ring
        owner = np.searchsorted(self._firsts, hits.triangle[beams], side="right") - 1
        chosen = (owner >= 0) & (returns.label == Label.STATIC)
        ray, distance = rays[beams][chosen], hits.distance[beams][chosen]
        points = ray[:, :3] + ray[:, 3:] * distance[:, None]
        ones = np.ones(len(points))
        self._rows.append(np.column_stack([points, owner[chosen], ones]))
        if len(self._rows) == _BATCH:
            self._rows = [_thinned(np.concatenate(self._rows))]

    def truth(self) -> MovableTruth:
        """Return what was seen up to now."""
        rows = _thinned(np.concatenate([np.zeros((0, 5)), *self._rows]))
        ids = np.array([movable.id for movable in self._movables], dtype=np.int64)
        return MovableTruth(
            ids=ids,
            kinds=np.array([movable.kind for movable in self._movables], dtype=np.str_),
            points=rows[:, :3].astype(np.float32),
            objects=ids[rows[:, 3].astype(np.intp)],
            returns=rows[:, 4].astype(np.int64),
        )


def _thinned(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Keep the first of the (N, 5) rows in each cell of an object, with the sum of the returns."""
    cells = np.column_stack([rows[:, 3], np.floor(rows[:, :3] / _GRID)]).astype(np.int64)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    kept = rows[first]
    kept[:, 4] = np.bincount(cell, rows[:, 4], minlength=len(first))
    return kept


def write_movables(path: Path, truth: MovableTruth) -> None:
    """Write an .npz without pickle; its arrays are called as in `MovableTruth`."""
    np.savez_compressed(
        path,
        ids=truth.ids,
        kinds=truth.kinds,
        points=truth.points,
        objects=truth.objects,
        returns=truth.returns,
    )


def read_movables(path: Path) -> MovableTruth:
    """Read what `write_movables` wrote.

    Raises:
        SourceError: the file is missing, or something else.
    """
    if not path.is_file():
        raise SourceError(f"no {path}: only a campaign with a 'session' has one")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return MovableTruth(**{name: arrays[name] for name in MovableTruth.__slots__})
    except (ValueError, KeyError, OSError) as error:
        raise SourceError(f"{path} is not a list of movable objects: {error}") from error
