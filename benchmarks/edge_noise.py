"""How far off are the edges that the pipeline measures, odometry and loop closures?

Maps a simulated scenario and compares every edge of the graph with the truth. The root mean squares are the
noise of the graph-level simulation (`lifelong_slam/simulation/building_run.py`). NEES of a consistent
covariance averages 6 (`benchmarks/covariance.py`).

    python benchmarks/edge_noise.py [scenario=loop scenario.laps=2 sensor=vls128 ...]
"""

import sys
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from covariance import ALL, ROTATION, TRANSLATION, EdgeErrors
from numpy.typing import NDArray
from throughput import compose_config, markdown

from lifelong_slam.config import build
from lifelong_slam.geometry import invert, log
from lifelong_slam.provenance import seed_everything
from lifelong_slam.result import EdgeKind
from lifelong_slam.sources.cleaning import InputCounts, clean

Array = NDArray[np.float64]
DEFAULTS = ("scenario=loop", "scenario.laps=2", "sensor=vls128", "pruning=none")


def measure(overrides: Sequence[str]) -> dict[EdgeKind, EdgeErrors]:
    """Return the errors of the edges of each kind."""
    config = compose_config([*DEFAULTS, *overrides])
    seed_everything(config.seed)
    system, source = build(config.system), build(config.scenario)
    vertices = np.array([system.process(scan).vertices for scan in clean(source, InputCounts())])
    result = system.finish()
    keyframes = np.flatnonzero(np.diff(vertices, prepend=0))  # the scans that became one
    reference = source.reference()
    stamps = np.clip(result.trajectory.stamps[keyframes], None, reference.stamps[-1])
    truth = reference.at(stamps) @ source.T_base_sensor
    errors: dict[EdgeKind, list[Array]] = defaultdict(list)
    covariances: dict[EdgeKind, list[Array]] = defaultdict(list)
    for edge in result.graph.edges:
        motion = invert(truth[edge.source]) @ truth[edge.target]
        errors[edge.kind].append(log(invert(motion) @ edge.T_source_target))
        covariances[edge.kind].append(edge.covariance)
    return {
        kind: EdgeErrors(np.array(errors[kind]), np.array(covariances[kind])) for kind in errors
    }


def main() -> None:
    """Print a Markdown table of root mean square errors by kind and component."""
    units = ["rx mrad", "ry mrad", "rz mrad", "x mm", "y mm", "z mm"]
    rows = []
    for kind, edges in measure(sys.argv[1:]).items():
        spread = 1e3 * np.sqrt(np.mean(edges.errors**2, axis=0))
        nees = [edges.nees(part) for part in (ALL, ROTATION, TRANSLATION)]
        figures = [*spread, nees[0].mean(), np.median(nees[0]), nees[1].mean(), nees[2].mean()]
        rows.append([kind, str(len(edges.errors)), *(f"{value:.2f}" for value in figures)])
    heads = ["NEES mean", "median", "rotation", "translation"]
    print(markdown(["kind", "edges", *units, *heads], rows))


if __name__ == "__main__":
    main()
