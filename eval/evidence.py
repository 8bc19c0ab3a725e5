"""What a SLAM system is judged by."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray

from eval.files import GraphSketch, Timeline
from eval.grid import Grid
from eval.nearest import Points
from eval.relations import Relations
from eval.trajectory import TrajectoryComparison


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)  # one is equal to itself alone
class Evidence:
    """The files of a run, read; None where there is none.

    Attributes:
        estimate: the estimated trajectory, in its own frame.
        comparison: estimate and reference, paired and aligned.
        relations: true relative poses at some pairs of instants.
        map: (N, 3) estimated points in metres. Where there is a reference map or grid, in its frame.
        reference_map: (M, 3) points to trust, metres.
        grid: estimated occupancy grid.
        reference_grid: occupancy grid to trust, in the same frame.
        graph: the final pose graph.
        timeline: one row a scan.
        run: section `run` of metrics.json: what the run knows about itself.
        reasons: why a field is None, by its name, where there is more to say than that nothing was given.
    """

    estimate: PoseTrajectory3D | None = None
    comparison: TrajectoryComparison | None = None
    relations: Relations | None = None
    map: Points | None = None
    reference_map: Points | None = None
    grid: Grid | None = None
    reference_grid: Grid | None = None
    graph: GraphSketch | None = None
    timeline: Timeline | None = None
    run: Mapping[str, Any] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)

    @property
    def path_in_map(self) -> NDArray[np.float64] | None:
        """(N, 3) estimated positions in the frame of the map, None without an estimate."""
        if self.estimate is None:
            return None
        positions: NDArray[np.float64] = self.estimate.positions_xyz
        if self.comparison is None or self.reference_map is None:
            return positions
        return self.comparison.alignment.move(positions)
