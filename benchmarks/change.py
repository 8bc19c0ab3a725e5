"""How well a map follows a place that changes: each object's share of voxels in the map.

Everything is in the world's frame. `benchmarks/seasons.py` tells how it is counted and why.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Literal

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lifelong_slam.simulation.movables import MovableTruth
from lifelong_slam.trajectory import Trajectory

Array = NDArray[np.float64]
Change = Literal["gone", "new", "stayed"]

VOXEL = 0.2  # metres
NEAR = 0.2  # metres from a voxel within which a map point stands for it
APART = 0.3  # metres off a surface from which on that surface doesn't explain a voxel
MIN_RETURNS = 5  # of a voxel
MIN_VOXELS = 10  # of an object
ROUTE_REACH = 30.0  # metres from the route; the map doesn't look for changes further away
_SURFACE_CHUNK = 200_000  # points at a time


class Surface:
    """The true surface of a session: all of it for distances, and its visible part as points.

    Args:
        mesh: (M, 3, 3) triangles, metres in the world's frame.
        visible: (N, 3) points on its visible part.
    """

    def __init__(self, mesh: NDArray[np.float32], visible: Array) -> None:
        self.visible = visible
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.reshape(-1, 3), np.float32)),
            o3d.core.Tensor.from_numpy(np.arange(3 * len(mesh), dtype=np.uint32).reshape(-1, 3)),
        )

    def distances(self, points: Array) -> Array:
        """Return the (N,) distances of (N, 3) points in metres."""
        parts = [
            self._scene.compute_distance(o3d.core.Tensor.from_numpy(chunk)).numpy()
            for chunk in _chunks(points.astype(np.float32))
        ]
        return np.concatenate([np.zeros(0), *parts])


@dataclass(frozen=True, slots=True)
class Visit:
    """A session's truth.

    Attributes:
        movables: what may change, and what was seen of it.
        surface: the true one.
        reference: T_world_base.
    """

    movables: MovableTruth
    surface: Surface
    reference: Trajectory

    def near_route(self, points: Array) -> NDArray[np.bool_]:
        """Tell which of (N, 3) points are within ROUTE_REACH of the route, seen from above."""
        route = cKDTree(self.reference.positions[::10, :2])
        distances, _ = route.query(points[:, :2], distance_upper_bound=ROUTE_REACH)
        return np.asarray(np.isfinite(distances))


@dataclass(frozen=True, slots=True)
class Stays:
    """Each object's latest stay up to a session, by object; sessions count from 0.

    Attributes:
        ids: (M,) sorted.
        kinds: (M,).
        first: (M,) session in which the stay began.
        last: (M,) session in which it ended, or the latest one.
    """

    ids: NDArray[np.int64]
    kinds: NDArray[np.str_]
    first: NDArray[np.int64]
    last: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ObjectScore:
    """How far the map has followed the change of one object.

    Attributes:
        session: after which the map was measured, from 1.
        object: id.
        kind: of object.
        change: what happened to it.
        visits: since the change.
        voxels: that count.
        share: of them that have a map point.
    """

    session: int
    object: int
    kind: str
    change: Change
    visits: int
    voxels: int
    share: float


@dataclass(frozen=True, slots=True)
class MapScore:
    """The whole map against the surface of the session.

    Attributes:
        session: from 1.
        points: in the map.
        trajectory_rmse_m: of the session's base positions, in the alignment of session 1.
        accuracy_mean_m: mean distance of map points to the surface.
        accuracy_10cm: share of map points within 0.1 m of the surface.
        accuracy_20cm: share within 0.2 m.
        completeness_20cm: share of the surface's voxels with a map point within 0.2 m.
    """

    session: int
    points: int
    trajectory_rmse_m: float
    accuracy_mean_m: float
    accuracy_10cm: float
    accuracy_20cm: float
    completeness_20cm: float


@dataclass(slots=True)
class ChangeMeter:
    """Measures a map after each session; sessions have to come in order."""

    visits: list[Visit] = field(default_factory=list)
    _maps: "list[cKDTree]" = field(default_factory=list)

    def measure(self, visit: Visit, points: Array) -> list[ObjectScore]:
        """Score every object after a further session.

        Args:
            visit: the session's truth.
            points: (N, 3) map after it, in the world's frame.
        """
        self.visits.append(visit)
        self._maps.append(cKDTree(points))
        now = len(self.visits) - 1
        stays = latest_stays([v.movables for v in self.visits])
        voxels, owner = seen_voxels([v.movables for v in self.visits], stays)
        gone, new = stays.last < now, (stays.first > 0) & (stays.last == now)
        counts = visit.near_route(voxels)
        counts &= np.where(gone[owner], self._gone_counts(voxels, owner, stays), True)
        counts &= np.where(new[owner], self._new_counts(voxels, owner, stays), True)
        there = _has_point(self._maps[now], voxels)
        change = np.where(gone, "gone", np.where(new, "new", "stayed"))
        since = np.where(gone, now - stays.last, now - stays.first + 1)
        total = np.bincount(owner[counts], minlength=len(stays.ids))
        kept = np.bincount(owner[counts & there], minlength=len(stays.ids))
        return [
            ObjectScore(
                now + 1, int(stays.ids[i]), str(stays.kinds[i]), change[i], int(since[i]),
                int(total[i]), float(kept[i] / total[i]),
            )
            for i in np.flatnonzero(total >= MIN_VOXELS)
        ]  # fmt: skip

    def _gone_counts(
        self, voxels: Array, owner: NDArray[np.int64], stays: Stays
    ) -> NDArray[np.bool_]:
        """Return which voxels were mapped while their object stood, and are empty space today."""
        counts = self.visits[-1].surface.distances(voxels) > APART
        last = stays.last[owner]
        for session, tree in enumerate(self._maps):
            counts[last == session] &= _has_point(tree, voxels[last == session])
        return counts

    def _new_counts(
        self, voxels: Array, owner: NDArray[np.int64], stays: Stays
    ) -> NDArray[np.bool_]:
        """Return which voxels were empty space in the session before their object came."""
        counts = np.ones(len(voxels), dtype=np.bool_)
        first = stays.first[owner]
        for session, visit in enumerate(self.visits[:-1]):
            chosen = first == session + 1
            counts[chosen] = visit.surface.distances(voxels[chosen]) > APART
        return counts


def latest_stays(sessions: Sequence[MovableTruth]) -> Stays:
    """Return the latest stay of every object that there has been in the sessions up to now."""
    ids, place = np.unique(np.concatenate([s.ids for s in sessions]), return_index=True)
    kinds = np.concatenate([s.kinds for s in sessions])[place]
    there = np.stack([np.isin(ids, s.ids) for s in sessions])
    number = np.arange(len(sessions))[:, None]
    last = np.where(there, number, -1).max(axis=0)
    absent_before = np.where(~there & (number < last), number, -1).max(axis=0)
    return Stays(ids, kinds, absent_before + 1, last)


def seen_voxels(sessions: Sequence[MovableTruth], stays: Stays) -> tuple[Array, NDArray[np.int64]]:
    """Return what was seen of each object in its stay.

    Returns:
        The mean spot of each voxel (V, 3), and the index into `stays` of its object (V,).
    """
    parts = []
    for number, session in enumerate(sessions):
        owner = np.searchsorted(stays.ids, session.objects)
        staying = (stays.first[owner] <= number) & (number <= stays.last[owner])
        rows = np.column_stack([session.points, owner, session.returns])
        parts.append(rows[staying])
    rows = np.concatenate(parts).astype(np.float64)
    cells = np.column_stack([rows[:, 3], np.floor(rows[:, :3] / VOXEL)]).astype(np.int64)
    cells, cell = np.unique(cells, axis=0, return_inverse=True)
    returns, spots = np.bincount(cell, rows[:, 4]), np.bincount(cell)
    middle = np.stack([np.bincount(cell, rows[:, i]) / spots for i in range(3)], axis=1)
    enough = returns >= MIN_RETURNS
    return middle[enough], cells[enough, 0]


def score_map(session: int, visit: Visit, points: Array, trajectory: Trajectory) -> MapScore:
    """Hold a map (N, 3) and the session's trajectory, both in the world's frame, to the truth."""
    errors = trajectory.positions - visit.reference.at(trajectory.stamps)[:, :3, 3]
    distances = visit.surface.distances(points)
    visible = visit.surface.visible
    surface = _voxel_means(visible[visit.near_route(visible)])
    return MapScore(
        session=session,
        points=len(points),
        trajectory_rmse_m=float(np.sqrt((errors**2).sum(axis=1).mean())),
        accuracy_mean_m=float(distances.mean()),
        accuracy_10cm=float((distances < 0.1).mean()),
        accuracy_20cm=float((distances < 0.2).mean()),
        completeness_20cm=float(_has_point(cKDTree(points), surface).mean()),
    )


def visits_needed(
    scores: Iterable[ObjectScore], change: Change, kind: str, threshold: float
) -> int | None:
    """Return after how many visits, and ever after, the mean share passes a threshold.

    It has to be at most `threshold` for what is gone, at least `threshold` for what is new; None
    if that isn't so after the most visits that were measured.
    """
    shares = mean_shares(scores, change, kind)
    needed = None
    for visits in sorted(shares, reverse=True):
        share = shares[visits]
        if (share > threshold) if change == "gone" else (share < threshold):
            break
        needed = visits
    return needed


def mean_shares(scores: Iterable[ObjectScore], change: Change, kind: str) -> dict[int, float]:
    """Return the mean share of the objects of a kind by the number of visits since the change."""
    chosen = [s for s in scores if (s.change, s.kind) == (change, kind)]
    visits = sorted({s.visits for s in chosen})
    return {n: fmean(s.share for s in chosen if s.visits == n) for n in visits}


def _has_point(tree: cKDTree, points: Array) -> NDArray[np.bool_]:
    """Return which of (N, 3) points have a map point nearby."""
    distance, _ = tree.query(points, distance_upper_bound=NEAR)
    return np.asarray(np.isfinite(distance))


def _voxel_means(points: Array) -> Array:
    """Return the mean point (V, 3) of each voxel that (N, 3) points fill."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return np.asarray(cloud.voxel_down_sample(VOXEL).points)


def _chunks(points: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    return np.array_split(points, max(len(points) // _SURFACE_CHUNK, 1))
