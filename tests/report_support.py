"""Evidence and metrics for the tests of the report."""

import base64
import gzip
import json
import re

import numpy as np
from eval_support import disturbed, winding

from eval.errors import EvalError
from eval.evaluation import evaluate
from eval.evidence import Evidence
from eval.files import GraphSketch
from eval.metrics.metric import Curve, Measurement, Plot, Section
from eval.trajectory import compare_trajectories

RUN = {
    "seed": 7,
    "git_commit": "0123456789abcdef",
    "choices": {"scenario": "E", "sensor": "bosch", "system": "lifelong"},
    "packages": {"numpy": "2.2.6"},
    "machine": {"cpu": "a processor", "cores": 2},
}


class Metric:
    """A metric whose attributes and answer are given."""

    less_is_better = True
    unit = "m"
    needs = ()

    def __init__(self, name, section, measurement=None, error=None, **attributes):
        self.name, self.section = name, section
        self.title, self.meaning = name.replace("_", " ").capitalize(), f"What {name} tells."
        self.keys = tuple(measurement.values) if measurement else ("value",)
        self.measurement, self.error = measurement, error
        vars(self).update(attributes)

    def measure(self, evidence):
        if self.error:
            raise EvalError(self.error)
        return self.measurement


def some_graph(positions):
    """A chain over the positions, a closure from the last to the first, a composed edge half-way."""
    count = len(positions)
    chain = [(i, i + 1) for i in range(count - 1)]
    edges = np.array([*chain, (count - 1, 0), (0, count // 2)])
    is_loop, is_composed = np.arange(count + 1) == count - 1, np.arange(count + 1) == count
    return GraphSketch(positions, edges, is_loop, is_composed)


def some_evidence(reference=True, points=3000, **changes):
    true = winding(300)
    estimate = disturbed(true)
    rng = np.random.default_rng(2)
    cloud = rng.normal(size=(points, 3)).astype(np.float32) * [40, 20, 2]
    fields = {
        "estimate": estimate,
        "comparison": compare_trajectories(estimate, true) if reference else None,
        "map": cloud.astype(np.float32),
        "graph": some_graph(estimate.positions_xyz[::10]),
        "run": RUN,
    }
    return Evidence(**{**fields, **changes})


def some_metrics(evidence):
    """A metric of each kind: with warnings, with a gap, stacked, of the map, and one that fails."""
    x = np.linspace(0, 30, 300)
    y = np.abs(np.sin(x))
    y[50:80] = np.nan
    curves = (Curve("error", x, y), Curve("reference", x, 0.5 * y))
    stages = tuple(Curve(name, x, 10 + np.cos(x)) for name in ("odometry", "loop", "optimise"))
    distances = np.linspace(0, 0.3, len(evidence.map))
    return [
        Metric(
            "position_error",
            Section.TRAJECTORY,
            Measurement(
                {"mae_m": 0.12345, "percentiles_m": {"50": 0.1, "95": float("nan")}},
                0.12345,
                plots=(Plot("Position error over time", "time [s]", "error [m]", curves),),
                warnings=("the path is nearly a straight line",),
            ),
        ),
        Metric(
            "map_distance",
            Section.MAP,
            Measurement({"mean_m": 0.15}, 0.15, {"distance_m": distances}),
        ),
        Metric("f_score", Section.MAP, error="the reference map is empty", less_is_better=False),
        Metric(
            "time_per_scan",
            Section.RESOURCES,
            Measurement(
                {"mean_ms": 31.5},
                31.5,
                plots=(Plot("Time per stage", "scan", "time [ms]", stages, stacked=True),),
            ),
            unit="ms",
        ),
    ]


def some_verdicts(evidence):
    return evaluate(evidence, some_metrics(evidence))


def unpacked(html):
    """Return what the charts of a page carry, as plotly.js gets it."""
    packed = re.findall(r'<script type="application/gzip">([^<]*)</script>', html)
    return [json.loads(gzip.decompress(base64.b64decode(text))) for text in packed]


def array(typed):
    values = np.frombuffer(base64.b64decode(typed["bdata"]), dtype=typed["dtype"])
    return values.reshape([int(size) for size in typed["shape"].split(",")])
