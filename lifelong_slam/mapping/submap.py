"""The part of the map that one vertex of the graph carries."""

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.memory import GrowingArray

Points = NDArray[np.float32]
Keys = NDArray[np.int64]

LOW, HIGH = -4, 6  # clamps of the score; see `Submap`
DOUBTED = 2  # the most that a score is after an absence
_MAX_WEIGHT = 100  # points in a mean, above which old ones fade
_KEY_BITS = 21  # a voxel's coordinate; 2^20 voxels of 0.2 m are 210 km


def voxel_keys(points: NDArray[np.floating], voxel_size: float) -> Keys:
    """Return one integer for the voxel of each of (N, 3) points."""
    cells = np.floor(points / voxel_size).astype(np.int64) + (1 << (_KEY_BITS - 1))
    return np.asarray(
        (cells[:, 0] << 2 * _KEY_BITS) | (cells[:, 1] << _KEY_BITS) | cells[:, 2], dtype=np.int64
    )


class Submap:
    """Voxels in the frame of their owner, so that they go where optimisation moves it.

    A voxel's score counts keyframes that hit it, less those that looked through it, clamped as
    occupancy is in OctoMap (Hornung et al., Autonomous Robots 2013, eq. 4): what stood for years leaves
    the map as fast as what stood for a day. A voxel is static while its score isn't negative, so one
    with score `HIGH` is gone once `HIGH + 1` keyframes have looked through it. At `LOW` it is forgotten.

    Attributes:
        keys: (N,) int64 voxels, ascending; see `voxel_keys`.
        means: (N, 3) float32 mean of what was measured in each, metres, owner's frame.
        weights: (N,) uint8 measurements in the mean, capped.
        scores: (N,) int8, above `LOW` and up to `HIGH`.
        bounds: (2, 3) float32 lower and upper corner of a box that holds all means.
    """

    __slots__ = ("_parts", "bounds")

    def __init__(
        self, keys: Keys, means: Points, weights: NDArray[np.uint8], scores: NDArray[np.int8]
    ) -> None:
        """Put together copies of what `arrays` gave.

        Raises:
            ValueError: the arrays' lengths differ, or keys don't ascend.
        """
        if means.shape != (len(keys), 3) or not len(keys) == len(weights) == len(scores):
            raise ValueError("a submap's keys, means, weights and scores must have one length")
        if np.any(np.diff(keys) <= 0):
            raise ValueError("a submap's keys must ascend")
        self._parts = (
            GrowingArray(keys),
            GrowingArray(means),
            GrowingArray(weights),
            GrowingArray(scores),
        )
        self.bounds = _bounds(means)

    @classmethod
    def empty(cls) -> "Submap":
        """Return one without voxels."""
        means = np.zeros((0, 3), np.float32)
        return cls(np.zeros(0, np.int64), means, np.zeros(0, np.uint8), np.zeros(0, np.int8))

    @property
    def keys(self) -> Keys:  # noqa: D102 - see the class
        return self._parts[0].rows

    @property
    def means(self) -> Points:  # noqa: D102 - see the class
        return self._parts[1].rows

    @property
    def weights(self) -> NDArray[np.uint8]:  # noqa: D102 - see the class
        return self._parts[2].rows

    @property
    def scores(self) -> NDArray[np.int8]:  # noqa: D102 - see the class
        return self._parts[3].rows

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return what the constructor takes, by name; they change as the submap does."""
        return {name: getattr(self, name) for name in ("keys", "means", "weights", "scores")}

    @property
    def static(self) -> NDArray[np.bool_]:
        """(N,) whether each voxel is in the map."""
        return np.asarray(self.scores >= 0)

    def __len__(self) -> int:
        return len(self.keys)

    def contains(self, keys: Keys) -> NDArray[np.bool_]:
        """Tell which of (M,) keys it has."""
        return self._find(keys)[1]

    def merge(
        self,
        keys: Keys,
        means: NDArray[np.floating],
        weights: NDArray[np.integer],
        scores: NDArray[np.integer],
    ) -> None:
        """Join voxels to those there are: means by weight, scores as sums between the clamps.

        Args:
            keys: (M,) ascending, as are those of the submap.
            means: (M, 3) in the owner's frame.
            weights: (M,) measurements in each mean.
            scores: (M,) what the voxel's score changes by; a new voxel starts from 0.
        """
        at, known = self._find(keys)
        old = at[known]
        total = self.weights[old].astype(np.int64) + weights[known]
        step = (means[known] - self.means[old]) * (weights[known] / total)[:, None]
        self.means[old] += step.astype(np.float32)
        self.weights[old] = np.minimum(total, _MAX_WEIGHT)
        self.scores[old] = _clamp(self.scores[old].astype(np.int64) + scores[known])
        new = ~known
        if np.any(new):
            self._insert(at[new], keys[new], means[new], weights[new], _clamp(scores[new]))

    def doubt(self) -> None:
        """Lower high scores: what stood when the place was left may have gone meanwhile.

        Hits raise them again; what is gone needs only `DOUBTED + 1` looks to leave the map.
        """
        np.minimum(self.scores, DOUBTED, out=self.scores)

    def weaken(self, looks: NDArray[np.integer]) -> None:
        """Take (N,) looks from the voxels' scores, and forget those that come down to `LOW`."""
        self.scores[:] = np.maximum(self.scores - looks, LOW)
        alive = np.flatnonzero(self.scores > LOW)
        if len(alive) < len(self):
            for part in self._parts:
                part.replace(part.rows.take(alive, axis=0))

    def _find(self, keys: Keys) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return where each of (M,) keys is or would be, and whether it is there."""
        at = np.searchsorted(self.keys, keys)
        if not len(self.keys):
            return at, np.zeros(len(keys), np.bool_)
        return at, np.asarray(self.keys[np.minimum(at, len(self.keys) - 1)] == keys)

    def _insert(
        self,
        at: NDArray[np.intp],
        keys: Keys,
        means: NDArray[np.floating],
        weights: NDArray[np.integer],
        scores: NDArray[np.integer],
    ) -> None:
        order = np.insert(np.arange(len(self)), at, len(self) + np.arange(len(at)))

        new = (keys, means, np.minimum(weights, _MAX_WEIGHT), scores)
        for part, more in zip(self._parts, new, strict=True):
            joined = np.concatenate([part.rows, more.astype(part.rows.dtype)])
            # `take` moves rows several times faster than indexing does.
            part.replace(joined.take(order, axis=0))
        bounds = _bounds(means)
        self.bounds = np.stack(
            [np.minimum(self.bounds[0], bounds[0]), np.maximum(self.bounds[1], bounds[1])]
        )


def _clamp(scores: NDArray[np.integer]) -> NDArray[np.integer]:
    """Return scores that a voxel which was just measured can have."""
    return np.clip(scores, LOW + 1, HIGH)


def _bounds(means: NDArray[np.floating]) -> Points:
    """Return the (2, 3) lower and upper corner of a box around (N, 3) points, inside out for none."""
    limits = [(c.min(), c.max()) if len(c) else (np.inf, -np.inf) for c in means.T]
    return np.array(limits, dtype=np.float32).T
