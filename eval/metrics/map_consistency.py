"""How crisp a map is, without a reference.

J. Razlaw, D. Droeschel, D. Holz and S. Behnke, *Evaluation of registration methods for sparse 3D laser
scans*, ECMR 2015.
"""

import numpy as np
from scipy.spatial import cKDTree

from eval.errors import EvidenceError, MetricError
from eval.evidence import Evidence
from eval.metrics.metric import Array, Measurement, Section
from eval.nearest import Points

_MOST_SAMPLES = 10_000
_MOST_NEIGHBOURS = 2_000_000  # of all the samples that are worked on at once
_LEAST_VARIANCE = 1e-8  # m^2: a tenth of a millimetre, finer than any LiDAR measures


class MapConsistency:
    """Mean map entropy, mean plane variance and the thickness of surfaces.

    Around a point q lie the points within a radius, with covariance C(q). Mean map entropy is the mean
    of h(q) = ln det(2 pi e C(q)) / 2, in nats (Razlaw et al. 2015); mean plane variance that
    of the smallest eigenvalue of C(q), the variance across the plane that fits best. Thickness is
    twice the median standard deviation across that plane: what walls and ground are smeared to.

    Every k-th point of the map is judged, so that there are at most 10,000; all points are neighbours.
    Points with too few neighbours are left out. Eigenvalues count as (0.1 mm)^2 at least. Entropies
    compare only with one radius and maps of about the same density.
    """

    name = "map_consistency"
    title = "Surface thickness"
    section = Section.MAP
    keys: tuple[str, ...] = (
        "thickness_m",
        "mean_map_entropy_nats",
        "mean_plane_variance_m2",
        "consistency_samples",
    )
    needs: tuple[str, ...] = ("map",)
    unit = "m"
    less_is_better: bool | None = True
    meaning = (
        "How thick walls and ground are in the map, as two standard deviations; noise and poses that"
        " don't fit each other thicken them."
    )

    def __init__(self, radius: float = 0.5, min_neighbours: int = 15) -> None:
        """Choose what counts as the surroundings of a point.

        Args:
            radius: metres.
            min_neighbours: points within the radius, the point itself included.

        Raises:
            MetricError: the radius isn't positive, or there are less than 4 neighbours.
        """
        if radius <= 0 or min_neighbours < 4:
            raise MetricError(
                f"the radius must be above 0 m and min_neighbours at least 4, not {radius} and"
                f" {min_neighbours}"
            )
        self._radius, self._min_neighbours = radius, min_neighbours

    def measure(self, evidence: Evidence) -> Measurement:
        """Judge the surroundings of the samples.

        Raises:
            EvidenceError: no point has enough neighbours, or there are NaN or infinite coordinates.
        """
        points = evidence.map
        assert points is not None
        if len(points) == 0:
            raise EvidenceError("the map is empty")
        if not np.isfinite(points).all():
            raise EvidenceError("the map has NaN or infinite coordinates")
        chosen = points[:: -(-len(points) // _MOST_SAMPLES)]
        variances = surrounding_variances(chosen, points, self._radius, self._min_neighbours)
        if len(variances) == 0:
            raise EvidenceError(
                f"no point of the map has {self._min_neighbours} neighbours within {self._radius:g} m"
            )
        entropies = np.log(2 * np.pi * np.e * variances).sum(axis=1) / 2
        deviations = np.sqrt(variances[:, 0])
        thickness = 2 * float(np.median(deviations))
        values = {
            "thickness_m": thickness,
            "mean_map_entropy_nats": float(entropies.mean()),
            "mean_plane_variance_m2": float(variances[:, 0].mean()),
            "consistency_samples": len(variances),
        }
        samples = {"entropy_nats": entropies, "deviation_m": deviations}
        return Measurement(
            values, thickness, samples, warnings=self._warnings(len(chosen), len(variances))
        )

    def _warnings(self, chosen: int, used: int) -> tuple[str, ...]:
        if 2 * used >= chosen:
            return ()
        return (
            f"only {used} of {chosen} points have {self._min_neighbours} neighbours within"
            f" {self._radius:g} m: most of the map is too sparse to be judged",
        )


def surrounding_variances(
    samples: Points, points: Points, radius: float, min_neighbours: int
) -> Array:
    """Return the principal variances of the points around each sample.

    Args:
        samples: (K, 3) metres; those with fewer neighbours than asked for are left out.
        points: (N, 3) metres, among which neighbours are looked for.
        radius: metres.
        min_neighbours: at least 1.

    Returns:
        (L, 3) in square metres, in ascending order, for L of the K samples.
    """
    tree = cKDTree(points, balanced_tree=False)
    counts = tree.query_ball_point(samples, radius, workers=-1, return_length=True)
    enough = counts >= min_neighbours
    judged: Array = samples[enough].astype(np.float64)
    if len(judged) == 0:
        return judged
    ends = np.flatnonzero(np.diff(np.cumsum(counts[enough]) // _MOST_NEIGHBOURS)) + 1
    variances = [_variances(tree, block, radius) for block in np.split(judged, ends)]
    return np.maximum(np.vstack(variances), _LEAST_VARIANCE)


def _variances(tree: cKDTree, samples: Array, radius: float) -> Array:
    """Return the eigenvalues of the covariances around (K, 3) points: (K, 3), ascending."""
    neighbours = tree.query_ball_point(samples, radius, workers=-1, return_sorted=False)
    counts = np.array([len(around) for around in neighbours])
    starts = np.cumsum(counts) - counts
    offsets = tree.data[np.concatenate(neighbours).astype(np.intp)]
    offsets = offsets - np.repeat(samples, counts, axis=0)
    means = np.add.reduceat(offsets, starts) / counts[:, None]
    squares = np.empty((len(samples), 3, 3))
    for i, j in np.ndindex(3, 3):
        squares[:, i, j] = np.add.reduceat(offsets[:, i] * offsets[:, j], starts) / counts
    covariances = squares - means[:, :, None] * means[:, None, :]
    return np.asarray(np.linalg.eigvalsh(covariances), dtype=np.float64)
