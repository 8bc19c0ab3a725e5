"""Metrics of a map of points: paper 000, section 4.2, and those that maps are usually compared by."""

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from eval.errors import EvidenceError, MetricError
from eval.evidence import Evidence
from eval.metrics.metric import Array, Curve, Measurement, Plot, Section
from eval.metrics.percentiles import DEFAULT, checked, spread
from eval.nearest import mutual_distances

_TINY = 100  # points
_APART = 10.0  # metres between most points of either map and the other map
_SHARES: Array = np.linspace(0, 99, 199, dtype=np.float64)  # percent


class MapExtent:
    """How many points the map has and where they lie."""

    name = "map_extent"
    title = "Map size"
    section = Section.MAP
    keys: tuple[str, ...] = ("points", "min_m", "max_m", "extent_m")
    needs: tuple[str, ...] = ("map",)
    unit = "points"
    less_is_better: bool | None = None
    meaning = "Points of the map; more of them show more, or the same place more densely."

    def measure(self, evidence: Evidence) -> Measurement:
        """Count the points and find the smallest box around them.

        Raises:
            EvidenceError: there are NaN or infinite coordinates.
        """
        points = evidence.map
        assert points is not None
        if len(points) == 0:
            nothing = dict.fromkeys(self.keys) | {"points": 0}
            return Measurement(nothing, 0.0, warnings=("the map is empty",))
        low, high = (end.astype(np.float64) for end in (points.min(axis=0), points.max(axis=0)))
        if not np.isfinite(high - low).all():
            raise EvidenceError("the map has NaN or infinite coordinates")
        values = {
            "points": len(points),
            "min_m": low.tolist(),
            "max_m": high.tolist(),
            "extent_m": (high - low).tolist(),
        }
        return Measurement(values, float(len(points)))


class MapDistance:
    """Directional mean distances (4.2) and percentiles; the symmetric one is the mean of both."""

    name = "map_distance"
    title = "Map distance"
    section = Section.MAP
    keys: tuple[str, ...] = ("mean_distance_m", "distance_percentiles_m")
    needs: tuple[str, ...] = ("map", "reference_map")
    unit = "m"
    less_is_better: bool | None = True
    meaning = (
        "How far a point of the map is from the nearest one of the reference map, on average;"
        " never less than the spacing of the reference's points allows."
    )

    def __init__(self, percentiles: Sequence[float] = DEFAULT) -> None:
        """Choose the percentiles, from 0 to 100.

        Raises:
            MetricError: there are others.
        """
        self._percentiles = checked(percentiles)

    def measure(self, evidence: Evidence) -> Measurement:
        """Average the distances in each direction.

        Raises:
            EvidenceError: a map is empty or has NaN or infinite coordinates.
        """
        distances = map_distances(evidence)
        there, back = float(distances.there.mean()), float(distances.back.mean())
        values = {
            "mean_distance_m": _both_ways(there, back, (there + back) / 2),
            "distance_percentiles_m": {
                "map_to_reference": spread(distances.there, self._percentiles),
                "reference_to_map": spread(distances.back, self._percentiles),
            },
        }
        plot = Plot(
            "Share of points within a distance of the other map",
            "distance [m]",
            "share of points [%]",
            (
                cumulative("map to reference", distances.there),
                cumulative("reference to map", distances.back),
            ),
        )
        samples = {"distance_m": distances.there}
        return Measurement(values, there, samples, (plot,), distances.warnings)


class Hausdorff:
    """Directional Hausdorff distances, the largest in each direction (4.2), and the larger of both."""

    name = "hausdorff"
    title = "Hausdorff distance"
    section = Section.MAP
    keys: tuple[str, ...] = ("hausdorff_m",)
    needs: tuple[str, ...] = ("map", "reference_map")
    unit = "m"
    less_is_better: bool | None = True
    meaning = (
        "The farthest that any point of one map is from the other map; a single stray point, or a place"
        " that only one map covers, decides it."
    )

    def measure(self, evidence: Evidence) -> Measurement:
        """Find the largest distances.

        Raises:
            EvidenceError: a map is empty or has NaN or infinite coordinates.
        """
        distances = map_distances(evidence)
        there, back = float(distances.there.max()), float(distances.back.max())
        largest = max(there, back)
        values = {"hausdorff_m": _both_ways(there, back, largest)}
        return Measurement(values, largest, warnings=distances.warnings)


class Chamfer:
    """Chamfer distance of Fan et al. (2017): mean squared distances, the sum of both directions."""

    name = "chamfer"
    title = "Chamfer distance"
    section = Section.MAP
    keys: tuple[str, ...] = ("chamfer_m2",)
    needs: tuple[str, ...] = ("map", "reference_map")
    unit = "m²"
    less_is_better: bool | None = True
    meaning = (
        "Mean squared distance from map to reference plus that from reference to map; what is missing"
        " counts as much as what is wrong."
    )

    def measure(self, evidence: Evidence) -> Measurement:
        """Add up the mean squares.

        Raises:
            EvidenceError: a map is empty or has NaN or infinite coordinates.
        """
        distances = map_distances(evidence)
        there, back = (float(np.square(d).mean()) for d in (distances.there, distances.back))
        return Measurement({"chamfer_m2": there + back}, there + back, warnings=distances.warnings)


class FScore:
    """Accuracy, completeness and their harmonic mean (Knapitsch et al. 2017, Tanks and Temples).

    Accuracy is the share of the map's points within a threshold of the reference, completeness the
    share of the reference's points within the threshold of the map.
    """

    name = "f_score"
    title = "F-score"
    section = Section.MAP
    keys: tuple[str, ...] = ("accuracy_percent", "completeness_percent", "f_score_percent")
    needs: tuple[str, ...] = ("map", "reference_map")
    unit = "%"
    less_is_better: bool | None = False

    def __init__(self, thresholds: Sequence[float] = (0.05, 0.10, 0.20)) -> None:
        """Choose thresholds in metres; the middle one is that of the headline.

        Raises:
            MetricError: there is none, or one isn't positive.
        """
        if not thresholds or min(thresholds) <= 0:
            raise MetricError(f"thresholds are lengths above 0 m, not {[*thresholds]}")
        self._thresholds = tuple(sorted(thresholds))
        self._middle = self._thresholds[len(thresholds) // 2]
        self.meaning = (
            f"How well map and reference cover each other within {self._middle:g} m: the harmonic mean"
            " of the shares of right and of found points."
        )

    def measure(self, evidence: Evidence) -> Measurement:
        """Count the points within each threshold.

        Raises:
            EvidenceError: a map is empty or has NaN or infinite coordinates.
        """
        distances = map_distances(evidence)
        accuracy, completeness, f_score = {}, {}, {}
        for threshold in self._thresholds:
            right = 100 * float((distances.there <= threshold).mean())
            found = 100 * float((distances.back <= threshold).mean())
            key = f"{threshold:g}_m"
            accuracy[key], completeness[key] = right, found
            f_score[key] = 2 * right * found / (right + found) if right and found else 0.0
        values = {
            "accuracy_percent": accuracy,
            "completeness_percent": completeness,
            "f_score_percent": f_score,
        }
        return Measurement(values, f_score[f"{self._middle:g}_m"], warnings=distances.warnings)


@dataclass(frozen=True, slots=True)
class MapDistances:
    """Distances between a map of N points and a reference map of M points.

    Attributes:
        there: (N,) metres from each point of the map to the nearest one of the reference.
        back: (M,) metres from each point of the reference to the nearest one of the map.
    """

    there: Array
    back: Array

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the distances doubtful."""
        sizes = {"map": len(self.there), "reference map": len(self.back)}
        found = [f"the {name} has only {n} points" for name, n in sizes.items() if n < _TINY]
        apart = float(min(np.median(self.there), np.median(self.back)))
        if apart > _APART:
            found.append(
                f"the maps hardly overlap, most points are more than {apart:.0f} m from the other map:"
                " are both in one frame?"
            )
        return tuple(found)


_known: WeakKeyDictionary[Evidence, MapDistances] = WeakKeyDictionary()


def map_distances(evidence: Evidence) -> MapDistances:
    """Return the distances between map and reference map, computed once for all metrics.

    Raises:
        EvidenceError: a map is empty or has NaN or infinite coordinates.
    """
    if evidence not in _known:
        estimated, reference = evidence.map, evidence.reference_map
        assert estimated is not None
        assert reference is not None
        for name, points in (("map", estimated), ("reference map", reference)):
            if len(points) == 0:
                raise EvidenceError(f"the {name} is empty")
        _known[evidence] = MapDistances(*mutual_distances(estimated, reference))
    return _known[evidence]


def cumulative(name: str, distances: Array) -> Curve:
    """Plot the share of (N,) distances up to each, in percent, without the farthest hundredth."""
    quantiles: Array = np.percentile(distances, _SHARES).astype(np.float64)
    return Curve(name, quantiles, _SHARES)


def _both_ways(there: float, back: float, symmetric: float) -> dict[str, float]:
    return {"map_to_reference": there, "reference_to_map": back, "symmetric": symmetric}
