"""Metrics of an occupancy grid: the knn map error of paper 001."""

import numpy as np

from eval.errors import EvidenceError
from eval.evidence import Evidence
from eval.metrics.map import cumulative
from eval.metrics.metric import Array, Measurement, Plot, Section
from eval.nearest import nearest_distances

_CM = 100.0
_APART = 1000.0  # centimetres


class GridError:
    """Map error of paper 001, equation 1: from each true map point to the nearest estimated one.

    Map points are the centres of occupied cells.
    """

    name = "grid_error"
    title = "2D map error"
    section = Section.MAP
    keys: tuple[str, ...] = ("knn_mean_cm", "knn_std_cm", "knn_max_cm", "knn_points")
    needs: tuple[str, ...] = ("grid", "reference_grid")
    unit = "cm"
    less_is_better: bool | None = True
    meaning = (
        "How far an occupied cell of the true grid is from the nearest occupied one of the estimated"
        " grid, on average; obstacles that are only in the estimate don't count."
    )

    def measure(self, evidence: Evidence) -> Measurement:
        """Average over the occupied cells of the true grid.

        Raises:
            EvidenceError: a grid has no occupied cells.
        """
        estimated, true = evidence.grid, evidence.reference_grid
        assert estimated is not None
        assert true is not None
        for name, grid in (("grid", estimated), ("reference grid", true)):
            if not grid.occupied.any():
                raise EvidenceError(f"the {name} has no occupied cells")
        distances = _CM * nearest_distances(true.occupied_points(), estimated.occupied_points())
        mean = float(distances.mean())
        values = {
            "knn_mean_cm": mean,
            "knn_std_cm": float(distances.std()),
            "knn_max_cm": float(distances.max()),
            "knn_points": len(distances),
        }
        curve = cumulative("true to estimated", distances)
        title = "Share of true map points within a distance of the estimated grid"
        plot = Plot(title, "distance [cm]", "share of points [%]", (curve,))
        samples = {"grid_distance_cm": distances}
        return Measurement(values, mean, samples, (plot,), _warnings(distances))


def _warnings(distances: Array) -> tuple[str, ...]:
    apart = float(np.median(distances))
    if apart <= _APART:
        return ()
    return (
        f"most occupied cells of the true grid are more than {apart / _CM:.0f} m from the estimated"
        " grid: are both in one frame?",
    )
