"""The map: what keyframes saw, voxelised, without what moved, in memory bounded by the place.

Voxels belong to vertices that stay in the graph, their owners, and move with them. A moving object leaves
points where later, or earlier, a ray passes freely: each keyframe speaks for the voxels that it hits and
against those that it looked through (the idea of Removert: Kim and Kim, IROS 2020), and a clamped count of
both decides (see `Submap`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from kiss_icp.voxelization import voxel_down_sample
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lifelong_slam.geometry import invert, transform
from lifelong_slam.mapping.keyframe import Keyframe
from lifelong_slam.mapping.submap import Submap, voxel_keys
from lifelong_slam.mapping.view import SIGHT, View, in_sight

Array = NDArray[np.float64]
Points = NDArray[np.float32]

_STRIDE = 2  # every second keyframe looks; a moving thing is passed by more than one
_LOOKS_BACK = 15  # views before those at hand that new voxels are held against too
_BLOCK = 2.0  # metres; what goes to one owner


def thin(points: Array, voxel_size: float) -> Points:
    """Keep one of the (N, 3) points a voxel."""
    return np.asarray(voxel_down_sample(points, voxel_size), dtype=np.float32)


class StaticMap:
    """The map of a place, which takes in keyframes for as long as the place is visited.

    Its size, and the time that a keyframe takes, depend on the place and not on the number of keyframes.

    Attributes:
        voxel_size: metres; one point a voxel, the mean of what was measured in it.
        max_range: metres from the sensor up to which points enter the map.
    """

    def __init__(self, voxel_size: float = 0.2, max_range: float = 80.0) -> None:
        """Start an empty map; see the class for the arguments."""
        self.voxel_size = voxel_size
        self.max_range = max_range
        self._submaps: dict[int, Submap] = {}
        self._changed: set[int] = set()
        self._views: list[View] = []
        self._settled = 0

    @property
    def submaps(self) -> Mapping[int, Submap]:
        """Voxels by owner."""
        return self._submaps

    def restore(self, submaps: Mapping[int, Submap]) -> None:
        """Go on from a saved map, which the place may have changed since; odometry starts anew."""
        self._submaps = dict(submaps)
        for submap in submaps.values():
            submap.doubt()
        self._changed.clear()
        self.forget_views()

    def forget_views(self) -> None:
        """Get ready for keyframes whose odometry starts anew."""
        self._views.clear()

    def take_changed(self) -> set[int]:
        """Return the owners whose voxels changed since the last call."""
        changed, self._changed = self._changed, set()
        return changed

    def settle(
        self,
        keyframes: Sequence[Keyframe],
        T_map_keyframes: Sequence[Array],
        poses: Mapping[int, Array],
    ) -> None:
        """Take in what keyframes saw, once loop closures have had their say on where they were.

        Args:
            keyframes: to take in, in their order; later than those before them, and their odometry
                continuous with theirs.
            T_map_keyframes: (4, 4) each.
            poses: (4, 4) T_map_vertex of all vertices that may own voxels; at least one.
        """
        if not keyframes:
            return
        owners = _Owners(poses)
        self._look(keyframes, T_map_keyframes, owners)
        self._hit(keyframes, T_map_keyframes, owners)
        del self._views[:-_LOOKS_BACK]

    def rehome(self, vertex: int, poses: Mapping[int, Array]) -> None:
        """Hand the voxels of a vertex that is about to be removed to the nearest of the others.

        Args:
            vertex: that is removed; it may own nothing.
            poses: (4, 4) T_map_vertex of this vertex and of all that may own voxels; at least two.
        """
        self._changed.discard(vertex)
        submap = self._submaps.pop(vertex, None)
        if submap is None:
            return
        others = _Owners({owner: T for owner, T in poses.items() if owner != vertex})
        points = transform(poses[vertex], submap.means.astype(np.float64))
        voxels = others.divide(points, submap.weights, self.voxel_size)
        scores = np.add.reduceat(submap.scores[voxels.order].astype(np.int64), voxels.starts)
        for owner, part in voxels.by_owner():
            self._submap(others.ids[owner]).merge(
                voxels.keys[part], voxels.means[part], voxels.weights[part], scores[part]
            )

    def points(self, poses: Mapping[int, Array]) -> Points:
        """Return (M, 3) float32 static points in the map frame, one for each voxel of that frame.

        Args:
            poses: (4, 4) T_map_vertex; owners that aren't among them are left out.
        """
        clouds: list[Array] = [np.zeros((0, 3))]
        weights: list[NDArray[np.uint8]] = [np.zeros(0, np.uint8)]
        for owner in sorted(self._submaps.keys() & poses.keys()):
            submap = self._submaps[owner]
            means = submap.means[submap.static].astype(np.float64)
            clouds.append(transform(poses[owner], means))
            weights.append(submap.weights[submap.static])
        points = np.concatenate(clouds)
        one_owner = np.zeros(len(points), np.intp)
        voxels = _Voxels.group(one_owner, points, np.concatenate(weights), self.voxel_size)
        return voxels.means.astype(np.float32)

    def _submap(self, owner: int) -> Submap:
        """Return an owner's submap to be changed."""
        self._changed.add(owner)
        return self._submaps.setdefault(owner, Submap.empty())

    def _look(
        self, keyframes: Sequence[Keyframe], T_map_keyframes: Sequence[Array], owners: "_Owners"
    ) -> None:
        """Count keyframes against the voxels that they looked through, and remember their views."""
        first = -self._settled % _STRIDE
        self._settled += len(keyframes)
        views = [View.of(k.points, k.T_odom_sensor) for k in keyframes[first::_STRIDE]]
        looks: dict[int, NDArray[np.int64]] = {}
        for view, T_map_sensor in zip(views, T_map_keyframes[first::_STRIDE], strict=True):
            for owner, voxels in self._looked_through(view, T_map_sensor, owners):
                count = looks.setdefault(owner, np.zeros(len(self._submaps[owner]), np.int64))
                count[voxels] += 1
        for owner, count in looks.items():
            self._submap(owner).weaken(count)
        self._views += views

    def _looked_through(
        self, view: View, T_map_sensor: Array, owners: "_Owners"
    ) -> Iterator[tuple[int, NDArray[np.intp]]]:
        """Yield owners, and the indices of their voxels that a view looked through."""
        seen = list(self._in_sight(T_map_sensor, owners))
        if not seen:
            return
        through = view.looks_through(np.concatenate([points for _, _, points in seen]))
        ends = np.cumsum([len(points) for _, _, points in seen])
        for (owner, voxels, _), part in zip(seen, np.split(through, ends[:-1]), strict=True):
            if np.any(part):
                yield owner, voxels[part]

    def _in_sight(
        self, T_map_sensor: Array, owners: "_Owners"
    ) -> Iterator[tuple[int, NDArray[np.intp], Points]]:
        """Yield owners, the indices of their voxels in sight, and these in the sensor's frame."""
        known = [i for i, owner in enumerate(owners.ids) if owner in self._submaps]
        if not known:
            return
        T_owner_sensor = invert(owners.poses[known]) @ T_map_sensor
        sensor = T_owner_sensor[:, :3, 3]
        bounds = np.array([self._submaps[owners.ids[i]].bounds for i in known])
        outside = np.maximum(bounds[:, 0] - sensor, sensor - bounds[:, 1])
        near = np.linalg.norm(np.maximum(outside, 0), axis=1) < SIGHT
        for i in np.flatnonzero(near):
            owner = owners.ids[known[i]]
            yield owner, *in_sight(self._submaps[owner].means, invert(T_owner_sensor[i]))

    def _hit(
        self, keyframes: Sequence[Keyframe], T_map_keyframes: Sequence[Array], owners: "_Owners"
    ) -> None:
        """Count keyframes for the voxels that they hit; hold new ones against the views around."""
        hits = [
            self._hits(keyframe, T, owners)
            for keyframe, T in zip(keyframes, T_map_keyframes, strict=True)
        ]
        T_odom_first = keyframes[0].T_odom_sensor
        samples = [
            transform(invert(T_odom_first) @ keyframe.T_odom_sensor, points).astype(np.float32)
            for keyframe, (_, points) in zip(keyframes, hits, strict=True)
        ]
        voxels = _Voxels.group(
            np.concatenate([hit.owners for hit, _ in hits]),
            np.concatenate([hit.means for hit, _ in hits]),
            np.concatenate([hit.weights for hit, _ in hits]),
            self.voxel_size,
        )
        parts = [(self._submap(owners.ids[i]), part) for i, part in voxels.by_owner()]
        known = [submap.contains(voxels.keys[part]) for submap, part in parts]
        is_new = ~np.concatenate([np.zeros(0, np.bool_), *known])
        new = voxels.order[voxels.starts[is_new]]
        scores = np.diff(voxels.starts, append=len(voxels.order))
        scores[is_new] -= self._looks_around(np.concatenate(samples)[new], T_odom_first)
        for submap, part in parts:
            submap.merge(voxels.keys[part], voxels.means[part], voxels.weights[part], scores[part])

    def _hits(
        self, keyframe: Keyframe, T_map_keyframe: Array, owners: "_Owners"
    ) -> tuple["_Voxels", Array]:
        """Return the M voxels that a keyframe hit, and a point in each, (M, 3) in its own frame."""
        points = keyframe.points
        points = points[np.einsum("ni,ni->n", points, points) < self.max_range**2]
        points = points.astype(np.float64)
        moved = transform(T_map_keyframe, points)
        voxels = owners.divide(moved, np.ones(len(points), np.uint8), self.voxel_size)
        return voxels, points[voxels.order[voxels.starts]]

    def _looks_around(self, points: Points, T_odom_points: Array) -> NDArray[np.int64]:
        """Count for each of (N, 3) points in a frame of odometry how many recent views looked through.

        Odometry relates the views: it is good over their distance, and optimisation leaves it alone.
        """
        counts = np.zeros(len(points), np.int64)
        for view in self._views:
            near, seen = in_sight(points, invert(view.T_odom_sensor) @ T_odom_points)
            counts[near] += view.looks_through(seen)
        return counts


class _Owners:
    """The vertices that points can be given to.

    Attributes:
        ids: of the vertices.
        poses: (K, 4, 4) T_map_vertex.
    """

    def __init__(self, poses: Mapping[int, Array]) -> None:
        self.ids = list(poses)
        self.poses = np.array(list(poses.values()))

    def divide(self, points: Array, weights: NDArray[np.integer], voxel_size: float) -> "_Voxels":
        """Return the voxels, each of the nearest vertex, that (N, 3) points of the map frame fill."""
        # Whole blocks go to the owner nearest to their middle: a search for every point takes longer.
        blocks, block = np.unique(voxel_keys(points, _BLOCK), return_inverse=True)
        member = np.zeros(len(blocks), np.intp)
        member[block] = np.arange(len(points))
        middles = (np.floor(points[member] / _BLOCK) + 0.5) * _BLOCK
        nearest = cKDTree(self.poses[:, :3, 3]).query(middles)[1][block]
        T = invert(self.poses)[nearest]
        local = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
        return _Voxels.group(nearest, local, weights, voxel_size)


@dataclass(frozen=True, slots=True)
class _Voxels:
    """Points grouped by owner and voxel.

    Attributes:
        order: (N,) indices of the points, group by group.
        starts: (M,) where each group starts in `order`.
        owners: (M,) owner of each voxel, ascending.
        keys: (M,) ascending within an owner.
        means: (M, 3) by weight.
        weights: (M,) sums.
    """

    order: NDArray[np.intp]
    starts: NDArray[np.intp]
    owners: NDArray[np.intp]
    keys: NDArray[np.int64]
    means: Array
    weights: NDArray[np.int64]

    @classmethod
    def group(
        cls,
        owners: NDArray[np.intp],
        points: Array,
        weights: NDArray[np.integer],
        voxel_size: float,
    ) -> "_Voxels":
        """Group (N, 3) points, given in their owners' frames, with (N,) weights."""
        keys = voxel_keys(points, voxel_size)
        # Two sorts, the second one of few bits, take an eighth of the time of lexsort.
        order = np.argsort(keys)
        few_bits = np.min_scalar_type(owners.max(initial=0))
        order = order[np.argsort(owners[order].astype(few_bits), kind="stable")]
        keys, owners = keys[order], owners[order]
        is_start = np.ones(len(order), np.bool_)
        is_start[1:] = (keys[1:] != keys[:-1]) | (owners[1:] != owners[:-1])
        starts = np.flatnonzero(is_start)
        weights = weights[order].astype(np.int64)
        sums = np.add.reduceat(weights, starts)
        means = [np.add.reduceat(points[order, axis] * weights, starts) / sums for axis in range(3)]
        return cls(order, starts, owners[starts], keys[starts], np.stack(means, axis=1), sums)

    def by_owner(self) -> Iterator[tuple[int, slice]]:
        """Yield each owner with the slice of its voxels."""
        starts = np.flatnonzero(np.diff(self.owners, prepend=-1))
        ends = np.flatnonzero(np.diff(self.owners, append=-1)) + 1
        for start, end in zip(starts, ends, strict=True):
            yield int(self.owners[start]), slice(start, end)
