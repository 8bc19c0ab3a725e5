"""Which vertices a pose graph can do without."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lifelong_slam.graph.trail import Trail

Array = NDArray[np.float64]

_REACH = 3.0  # spacings up to which others count towards a vertex's density
_GRAIN = 0.25  # spacings between the spots of the trail
_HASTE = 1.1  # times as dense an older vertex must be to go before a new one


class Selection(Protocol):
    """Chooses vertices to remove."""

    def settle(
        self, poses: Mapping[int, Array], new: Collection[int], older: Collection[int]
    ) -> list[int]:
        """Choose among vertices that have left the window of the newest.

        Args:
            poses: (4, 4) T_map_vertex of all that left the window and are still there.
            new: those of them that left it since the last call and may go.
            older: those that were kept before and may go; others are protected.

        Returns:
            Vertices in the order in which they should be removed.
        """
        ...

    def reduce(
        self, poses: Mapping[int, Array], removable: Collection[int], count: int
    ) -> list[int]:
        """Choose, once and for all, `count` of the removable vertices, or fewer if they run out."""
        ...

    def adopt(self, poses: Mapping[int, Array], hosts: Mapping[int, int]) -> None:
        """Take over what was settled in earlier sessions; most selections needn't know.

        Args:
            poses: (4, 4) T_map_vertex of all vertices that there have ever been.
            hosts: the vertex that each of them is or hangs on, of those that are still there; of
                one component.
        """
        return


class Geometry(Selection):
    """The densest go first, so that those that stay are spread evenly (Kurz, Holoch and Biber 2021).

    The density of a vertex is scale-invariant, SID(i) = sum over j of 1 / |x_i - x_j|, over the
    others within three spacings: further away the sum tells how near a vertex is to the map's centre.
    With a sensor that doesn't see all around, two vertices in one place that look different ways are
    different views: x has the position and, to scale, the direction of view.

    Those that stay cover the trail, all spots where vertices have ever been: each spot has one of them
    within the spacing, and none of them could go without leaving a spot bare.
    """

    def __init__(self, spacing: float, field_of_view: float = 360.0) -> None:
        """Set up.

        Args:
            spacing: metres within which each spot of the trail has a vertex.
            field_of_view: horizontal, degrees; vertices that look half of it apart count as one
                spacing apart.
        """
        self._spacing = spacing
        half = np.radians(field_of_view) / 2
        self._view_radius = 0.0 if field_of_view >= 360 else spacing / (2 * np.sin(half / 2))
        self._trail = Trail(self._places, _GRAIN * spacing)

    def settle(
        self, poses: Mapping[int, Array], new: Collection[int], older: Collection[int]
    ) -> list[int]:
        """Remove the densest while the others still cover the trail; see Selection."""
        if not poses:
            return []
        ids, T = np.array(list(poses)), np.array(list(poses.values()))
        self._trail.extend(ids, T)
        places = self._places(T)
        cover = _Cover(places, self._trail.places(ids, T), self._spacing)
        density = _Density(places, _REACH * self._spacing)
        factors = dict.fromkeys(older, 1.0) | dict.fromkeys(new, _HASTE)
        haste = np.array([factors.get(vertex, 0.0) for vertex in poses])
        removed = density.thin(haste, cover)
        self._trail.rehome(ids, T, removed)
        return [int(i) for i in ids[removed]]

    def adopt(self, poses: Mapping[int, Array], hosts: Mapping[int, int]) -> None:
        """Take over the trail of earlier sessions; see Selection."""
        self._trail.adopt(poses, hosts)

    def reduce(
        self, poses: Mapping[int, Array], removable: Collection[int], count: int
    ) -> list[int]:
        """Remove the densest first; see Selection."""
        ids = np.array(list(poses))
        places = self._places(np.array(list(poses.values())).reshape(-1, 4, 4))
        # The spacing that the others end up with: to the nearest of as many as one has to stand for.
        share = int(np.ceil(len(ids) / max(len(ids) - count, 1)))
        neighbours = min(share + 1, len(ids))
        spacing = float(np.median(cKDTree(places).query(places, k=[neighbours])[0]))
        density = _Density(places, _REACH * max(spacing, 1e-6))
        free = np.isin(ids, list(removable)).astype(float)
        return [int(ids[i]) for i in density.thin(free, None, count)]

    def _places(self, T: Array) -> Array:
        """Return (n, 6) positions and scaled directions of view of (n, 4, 4) poses."""
        return np.concatenate([T[:, :3, 3], self._view_radius * T[:, :3, 0]], axis=1)


class _Density:
    """Scale-invariant density of points, kept up to date while they are taken away."""

    def __init__(self, places: Array, reach: float) -> None:
        pairs = cKDTree(places).sparse_distance_matrix(
            cKDTree(places), reach, output_type="coo_matrix"
        )
        apart = pairs.row != pairs.col
        row, column = pairs.row[apart], pairs.col[apart]
        distance = np.maximum(pairs.data[apart], 1e-6)
        order = np.argsort(row, kind="stable")
        self._ends = np.searchsorted(row[order], np.arange(len(places) + 1))
        self._neighbours, self._distances = column[order], distance[order]
        self._values = np.bincount(row, 1 / distance, minlength=len(places))

    def thin(self, haste: Array, cover: "_Cover | None", count: int | None = None) -> list[int]:
        """Take away the densest points without which the others still cover all spots.

        Args:
            haste: (n,) factor of a point's density; zero protects it.
            cover: of the points; None if nothing has to be covered.
            count: how many to take away at most.
        """
        candidates = haste > 0
        removed: list[int] = []
        while candidates.any() and (count is None or len(removed) < count):
            densest = int(np.argmax(np.where(candidates, haste * self._values, -1.0)))
            candidates[densest] = False  # either goes or, as fewer and fewer cover a spot, stays
            if cover is None or cover.release(densest):
                self._take(densest)
                removed.append(densest)
        return removed

    def _take(self, i: int) -> None:
        span = slice(self._ends[i], self._ends[i + 1])
        np.subtract.at(self._values, self._neighbours[span], 1 / self._distances[span])


class _Cover:
    """How many points each spot has within reach, kept up to date while they are taken away."""

    def __init__(self, places: Array, spots: Array, reach: float) -> None:
        near = cKDTree(spots).query_ball_point(places, reach)
        self._near = [np.array(spots, dtype=np.int64) for spots in near]
        self._counts = np.bincount(np.concatenate(self._near), minlength=len(spots))

    def release(self, i: int) -> bool:
        """Take point i away if every spot near it has another one; tell whether that was so."""
        is_spare = bool((self._counts[self._near[i]] > 1).all())
        self._counts[self._near[i]] -= is_spare
        return is_spare


@dataclass(frozen=True, slots=True)
class Decimate(Selection):
    """Every k-th vertex in time stays.

    Attributes:
        every: k.
    """

    every: int = 3

    def settle(
        self, poses: Mapping[int, Array], new: Collection[int], older: Collection[int]
    ) -> list[int]:
        """Keep the new ones whose number k divides; see Selection."""
        return [vertex for vertex in sorted(new) if vertex % self.every]

    def reduce(
        self, poses: Mapping[int, Array], removable: Collection[int], count: int
    ) -> list[int]:
        """Keep vertices at equal distances in time; see Selection."""
        ids = np.array(sorted(removable))
        kept = max(len(ids) - count, 0)
        staying = np.round(np.linspace(0, len(ids) - 1, kept)).astype(int)
        return [int(i) for i in np.delete(ids, staying)]


class Everything(Selection):
    """No vertex stays: for a visitor who only asks where he is."""

    def settle(
        self, poses: Mapping[int, Array], new: Collection[int], older: Collection[int]
    ) -> list[int]:
        """Remove all new ones; see Selection."""
        return sorted(new)

    def reduce(
        self, poses: Mapping[int, Array], removable: Collection[int], count: int
    ) -> list[int]:
        """Remove the oldest; see Selection."""
        return sorted(removable)[:count]


class Random(Selection):
    """Any vertex goes as likely as any other."""

    def __init__(self, keep: float = 1 / 3, seed: int = 0) -> None:
        """Set up.

        Args:
            keep: share of the vertices that stay.
            seed: of the draws.
        """
        self._keep = keep
        self._rng = np.random.default_rng(seed)

    def settle(
        self, poses: Mapping[int, Array], new: Collection[int], older: Collection[int]
    ) -> list[int]:
        """Draw for each new one; see Selection."""
        ids = np.array(sorted(new))
        return [int(i) for i in ids[self._rng.random(len(ids)) >= self._keep]]

    def reduce(
        self, poses: Mapping[int, Array], removable: Collection[int], count: int
    ) -> list[int]:
        """Draw without putting back; see Selection."""
        return [int(i) for i in self._rng.permutation(sorted(removable))[:count]]
