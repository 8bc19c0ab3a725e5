"""Distances between the maps of two runs (paper 000, section 4.2)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eval.alignment import Alignment
from eval.comparison.runs import Run
from eval.map_alignment import map_alignment
from eval.map_files import read_map
from eval.nearest import mutual_distances
from eval.trajectory import compare_trajectories
from eval.trajectory_files import read_tum

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DistanceSummary:
    """How far the points of one map are from another map, in one direction.

    Attributes:
        mean_m: directional mean distance.
        hausdorff_m: directional Hausdorff distance, the largest.
    """

    mean_m: float
    hausdorff_m: float


@dataclass(frozen=True, slots=True)
class MapPair:
    """The maps of two runs, both ways.

    Attributes:
        there: from each point of the first map to the second.
        back: from each point of the second map to the first.
        aligned: whether both maps were moved into the reference's frame first.
    """

    there: DistanceSummary
    back: DistanceSummary
    aligned: bool


def compare_maps(first: Run, second: Run) -> MapPair:
    """Measure the distances between the maps of two runs, in the frame of the reference if both have one.

    Otherwise the maps are compared as they are, each in the frame of its first scan.

    Raises:
        EvalError: a map or trajectory is missing, unreadable or empty.
    """
    maps = [read_map(run.folder / "map.ply") for run in (first, second)]
    alignments = [found for run in (first, second) if (found := run_map_alignment(run)) is not None]
    aligned = len(alignments) == len(maps)
    if aligned:
        maps = [
            a.move(points.astype(np.float64)) for a, points in zip(alignments, maps, strict=True)
        ]
    there, back = mutual_distances(*maps)
    return MapPair(_summary(there), _summary(back), aligned)


def trajectory_alignment(run: Run) -> Alignment | None:
    """Return what moves the trajectory of a run onto its reference; None if it has none."""
    found = run.metrics.get("trajectory", {}).get("alignment")
    if found is None:
        return None
    R, t = np.array(found["rotation"]), np.array(found["translation_m"])
    return Alignment(found["method"], R, t, found["scale"])


def run_map_alignment(run: Run) -> Alignment | None:
    """Return what moves the map of a run into the reference's frame; None if there is no reference.

    See `eval.map_alignment`; a method other than `se3` holds for the map as it was found for the run.

    Raises:
        EvalError: estimate or reference are missing, malformed, or don't match.
    """
    alignment = trajectory_alignment(run)
    if alignment is None or alignment.method != "se3":
        return alignment
    estimate, reference = (
        read_tum(run.folder / f"{name}.tum") for name in ("trajectory", "reference")
    )
    return map_alignment(compare_trajectories(estimate, reference))


def _summary(distances: Array) -> DistanceSummary:
    return DistanceSummary(float(distances.mean()), float(distances.max()))
