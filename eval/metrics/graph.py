"""The size of the pose graph, and how it grew."""

import numpy as np

from eval.evidence import Evidence
from eval.files import Timeline
from eval.metrics.metric import Curve, Measurement, Plot, Section


class GraphSize:
    """Vertices and edges by kind; over the scans where there is a timeline."""

    name = "graph_size"
    title = "Pose graph"
    section = Section.GRAPH
    keys: tuple[str, ...] = ("vertices", "edges", "odometry_edges", "loop_edges", "composed_edges")
    needs: tuple[str, ...] = ("graph",)
    unit = "vertices"
    less_is_better: bool | None = None
    meaning = (
        "Vertices of the final pose graph; with pruning it grows with the size of the place, not with"
        " the time spent in it."
    )

    def measure(self, evidence: Evidence) -> Measurement:
        """Count."""
        graph = evidence.graph
        assert graph is not None
        loops, composed = int(graph.is_loop.sum()), int(graph.is_composed.sum())
        vertices, edges = len(graph.positions), len(graph.edges)
        values = {
            "vertices": vertices,
            "edges": edges,
            "odometry_edges": edges - loops - composed,
            "loop_edges": loops,
            "composed_edges": composed,
        }
        return Measurement(values, float(vertices), plots=_growth(evidence.timeline))


def _growth(timeline: Timeline | None) -> tuple[Plot, ...]:
    """Plot vertices and edges over the scans, where a timeline has them."""
    counted = {k: v for k, v in (timeline or {}).items() if k in ("vertices", "edges")}
    if not counted:
        return ()
    curves = tuple(
        Curve(k, np.arange(1, len(v) + 1, dtype=np.float64), v) for k, v in counted.items()
    )
    return (Plot("Growth of the pose graph", "scan", "count", curves),)
