"""Where the robot has been, as far as pruning needs to know."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lifelong_slam.geometry import invert

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Trail:
    """Spots where vertices have been, a grain apart, that outlast the vertices.

    A spot hangs on a vertex that is there, its host, and so moves with the graph. There are as many as the
    place has room for, however often it is visited.
    """

    def __init__(self, place_of: Callable[[Array], Array], grain: float) -> None:
        """Set up without any spot.

        Args:
            place_of: makes (n, k) places, between which distances are measured, of (n, 4, 4) poses.
            grain: distance within which a spot stands for others.
        """
        self._place_of = place_of
        self._grain = grain
        self._hosts: Indices = np.zeros(0, dtype=np.int64)
        self._T_host_spot: Array = np.zeros((0, 4, 4))

    def extend(self, ids: Indices, T: Array) -> None:
        """Add spots where vertices are that have none near them.

        Args:
            ids: (n,) vertices.
            T: (n, 4, 4) their poses, in one frame.
        """
        places, spots = self._place_of(T), self.places(ids, T)
        new = np.ones(len(ids), dtype=bool)
        if len(spots):
            new = cKDTree(spots).query(places)[0] > self._grain
        new[new] = _apart(places[new], self._grain)
        self._add(ids[new], np.tile(np.eye(4), (new.sum(), 1, 1)))

    def adopt(self, poses: Mapping[int, Array], hosts: Mapping[int, int]) -> None:
        """Take over the trail of vertices that were there earlier.

        Args:
            poses: (4, 4) of all vertices that there have ever been.
            hosts: the vertex that each of them is or hangs on, of those that are still there; of
                one component.
        """
        T = np.array([poses[i] for i in hosts]).reshape(-1, 4, 4)
        T_map_host = np.array([poses[i] for i in hosts.values()]).reshape(-1, 4, 4)
        kept = _apart(self._place_of(T), self._grain)
        self._add(
            np.array(list(hosts.values()), dtype=np.int64)[kept], (invert(T_map_host) @ T)[kept]
        )

    def places(self, ids: Indices, T: Array) -> Array:
        """Return the (m, k) places of the spots that hang on vertices with (n, 4, 4) poses T."""
        hung, rows = self._hung(ids)
        return self._place_of(T[rows] @ self._T_host_spot[hung])

    def rehome(self, ids: Indices, T: Array, removed: list[int]) -> None:
        """Hang what hung on removed vertices on the nearest that stay.

        Args:
            ids: (n,) vertices.
            T: (n, 4, 4) their poses.
            removed: which of the n are to be removed.
        """
        hung, rows = self._hung(ids)
        homeless = np.isin(rows, removed)
        if not homeless.any():
            return
        hung, rows = hung[homeless], rows[homeless]
        T_spot = T[rows] @ self._T_host_spot[hung]
        staying = np.delete(np.arange(len(ids)), removed)
        nearest = cKDTree(self._place_of(T[staying])).query(self._place_of(T_spot))[1]
        self._hosts[hung] = ids[staying[nearest]]
        self._T_host_spot[hung] = invert(T[staying[nearest]]) @ T_spot

    def _add(self, hosts: Indices, T_host_spot: Array) -> None:
        self._hosts = np.concatenate([self._hosts, hosts])
        self._T_host_spot = np.concatenate([self._T_host_spot, T_host_spot])

    def _hung(self, ids: Indices) -> tuple[Indices, Indices]:
        """Return the spots that hang on some of the vertices, and for each the row of its host."""
        hung = np.flatnonzero(np.isin(self._hosts, ids))
        order = np.argsort(ids)
        return hung, order[np.searchsorted(ids, self._hosts[hung], sorter=order)]


def _apart(places: Array, grain: float) -> NDArray[np.bool_]:
    """Return (n,) which places to keep so that each has one within the grain, in their order."""
    near = cKDTree(places).query_ball_point(places, grain) if len(places) else []
    kept = np.ones(len(places), dtype=bool)
    for i, others in enumerate(near):
        if kept[i]:
            kept[others] = False
            kept[i] = True
    return kept
