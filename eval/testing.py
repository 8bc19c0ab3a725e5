"""The contract that a metric must keep, as a test that anybody can run on his own.

    from eval.testing import check_metric

    def test_my_metric():
        check_metric(MyMetric())

It asks the metric about small pieces of evidence: a drive with and without reference, one without
noise, along a line, of three poses, standing still, with an empty map, without scans.
"""

import copy
import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eval.errors import EvalError
from eval.evidence import Evidence
from eval.files import GraphSketch
from eval.grid import Grid
from eval.metrics.metric import Measurement, Metric, Plot, Section
from eval.relations import Relations
from eval.trajectory import compare_trajectories

Array = NDArray[np.float64]

_STAMPS: Array = np.arange(5, dtype=np.float64)
_FIELDS = {field.name for field in fields(Evidence)}


def check_metric(metric: Metric) -> None:
    """Check a metric against the contract of `eval.metrics.metric`.

    Raises:
        AssertionError: it breaks the contract, in words that say where.
        Exception: what the metric raises besides EvalError, as it is.
    """
    check_attributes(metric)
    answered = 0
    for name, evidence in examples().items():
        if any(_absent(getattr(evidence, need)) for need in metric.needs):
            continue
        before = copy.deepcopy(evidence)
        try:
            measurement = metric.measure(evidence)
        except EvalError as error:
            _check_line(str(error), f"{metric.name}, {name}: an error")
            continue
        answered += 1
        where = f"{metric.name}, {name}"
        assert _same(before, evidence), f"{where}: the evidence was changed"
        check_measurement(metric, measurement, where)
        again = metric.measure(evidence)
        assert _same(measurement, again), f"{where}: the same evidence gave another result"
    assert answered, f"{metric.name} measured nothing in any example"


def check_attributes(metric: Metric) -> None:
    """Check what a metric says of itself.

    Raises:
        AssertionError: an attribute is missing, empty or of a wrong type.
    """
    for key in ("name", "title", "meaning"):
        value = getattr(metric, key, None)
        assert isinstance(value, str), f"{metric!r}: {key} must be a string"
        assert value.strip(), f"{metric!r}: {key} must not be empty"
    name = metric.name
    assert re.fullmatch("[a-z][a-z0-9_]*", name), f"{name}: a name is in snake_case"
    assert metric.section in list(Section), f"{name}: section must be one of {[*Section]}"
    assert isinstance(metric.unit, str), f"{name}: unit must be a string"
    assert metric.less_is_better in (True, False, None), f"{name}: less_is_better: bool or None"
    assert metric.meaning[0].isupper(), f"{name}: meaning must be a sentence"
    assert metric.meaning.endswith("."), f"{name}: meaning must be a sentence, with a full stop"
    for key in ("keys", "needs"):
        value = getattr(metric, key)
        assert isinstance(value, tuple), f"{name}: {key} must be a tuple"
        assert all(isinstance(item, str) and item for item in value), f"{name}: {key}: strings"
        assert len(set(value)) == len(value), f"{name}: {key} must not repeat"
    assert metric.keys, f"{name}: there must be a key"
    assert not {"reasons", "warnings"} & {*metric.keys}, f"{name}: reasons and warnings are taken"
    unknown = {*metric.needs} - _FIELDS
    assert not unknown, f"{name}: needs {sorted(unknown)}, which Evidence doesn't have"


def check_measurement(metric: Metric, measurement: Measurement, where: str) -> None:
    """Check one answer of a metric.

    Raises:
        AssertionError: it breaks the contract, in words that begin with `where`.
    """
    assert isinstance(measurement, Measurement), f"{where}: no Measurement"
    keys, promised = sorted(measurement.values), sorted(metric.keys)
    assert keys == promised, f"{where}: keys {keys} instead of {promised}"
    _check_json(measurement.values, where)
    headline = measurement.headline
    assert headline is None or np.isfinite(headline), f"{where}: headline must be finite or None"
    for name, samples in measurement.samples.items():
        assert np.ndim(samples) == 1, f"{where}: samples {name} must be 1-D"
        assert np.isfinite(samples).all(), f"{where}: samples {name} must be finite"
    for plot in measurement.plots:
        _check_plot(plot, where)
    for warning in measurement.warnings:
        _check_line(warning, f"{where}: a warning")


def examples() -> dict[str, Evidence]:
    """Return small pieces of evidence by what is special about them; each call the same."""
    full = _drive(120)
    return {
        "everything": full,
        "nothing": Evidence(),
        "without references": replace(full, comparison=None, reference_map=None, relations=None,
                                      reference_grid=None, run={}),
        "no noise": _drive(120, noise=0.0),
        "a straight line": _drive(60, bend=0.0),
        "three poses": _drive(3),
        "standing still": _drive(20, step=0.0),
        "empty maps": replace(full, map=_cloud(0), reference_map=_cloud(0)),
        "an empty map": replace(full, map=_cloud(0)),
        "an empty reference map": replace(full, reference_map=_cloud(0)),
        "one point": replace(full, map=_cloud(1), reference_map=_cloud(1)),
        "nothing occupied": replace(full, grid=_grid(0), reference_grid=_grid(0)),
        "no scans": replace(full, timeline={k: v[:0] for k, v in (full.timeline or {}).items()}),
        "a timeline of stamps alone": replace(full, timeline={"stamp": _STAMPS}, run={}),
        "an empty graph": replace(full, graph=_graph(0)),
    }  # fmt: skip


def _drive(count: int, noise: float = 0.05, bend: float = 0.02, step: float = 2.0) -> Evidence:
    rng = np.random.default_rng(0)
    number = np.arange(count, dtype=np.float64)
    stamps, yaw = 1_700_000_000 + number * 0.1, number * bend
    steps = step * np.column_stack([np.cos(yaw), np.sin(yaw), 0.2 * np.sin(2 * yaw)])
    true = _trajectory(np.cumsum(steps, axis=0), yaw, stamps)
    positions = true.positions_xyz + noise * rng.normal(size=(count, 3)) + [5.0, -3.0, 1.0]
    estimate = _trajectory(positions, yaw + noise * 0.1 * rng.normal(size=count), stamps)
    ends = np.column_stack([stamps[:-1], stamps[1:]])
    poses = np.array(true.poses_se3)
    return Evidence(
        estimate=estimate,
        comparison=compare_trajectories(estimate, true),
        relations=Relations(ends, np.linalg.inv(poses[:-1]) @ poses[1:]),
        map=_cloud(2000, noise),
        reference_map=_cloud(2000),
        grid=_grid(30),
        reference_grid=_grid(31),
        graph=_graph(count),
        timeline=_timeline(stamps),
        run={"wall_seconds": 2.0, "cpu_percent": 90.0, "peak_rss_mb": 400.0, "mean_rss_mb": 350.0},
    )


def _trajectory(positions: Array, yaw: Array, stamps: Array) -> PoseTrajectory3D:
    rotations = Rotation.from_rotvec(np.column_stack([0 * yaw, 0 * yaw, yaw]))
    return PoseTrajectory3D(positions, np.roll(rotations.as_quat(), 1, axis=1), stamps)


def _cloud(count: int, noise: float = 0.0) -> NDArray[np.float32]:
    """Return points on a floor and a wall."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 10, size=(count, 3))
    points[: count // 2, 2] = 0.0
    points[count // 2 :, 1] = 10.0
    return np.asarray(points + noise * rng.normal(size=(count, 3)), dtype=np.float32)


def _grid(wall: int) -> Grid:
    """Return a grid of 40 x 50 cells with a wall of so many."""
    occupied = np.zeros((40, 50), dtype=bool)
    occupied[20, :wall] = True
    return Grid(occupied, np.ones_like(occupied), 0.05, np.zeros(3))


def _graph(count: int) -> GraphSketch:
    chain = np.column_stack([np.arange(count - 1), np.arange(1, count)]).astype(np.int64)
    edges = np.vstack([chain, [[0, count - 1]]]) if count > 2 else np.zeros((0, 2), dtype=np.int64)
    positions = np.arange(3 * count, dtype=np.float64).reshape(count, 3)
    is_loop = np.arange(len(edges)) == len(edges) - 1
    return GraphSketch(positions, edges, is_loop, np.zeros_like(is_loop))


def _timeline(stamps: Array) -> dict[str, Array]:
    ramp = np.arange(len(stamps), dtype=np.float64)
    return {
        "stamp": stamps,
        "odometry_ms": 20.0 + ramp % 3,
        "loop_ms": ramp % 5,
        "vertices": ramp,
        "edges": 1.2 * ramp,
        "rss_mb": 300.0 + ramp,
        "child_rss_mb": 10.0 + 0 * ramp,
        "cpu_percent": 90.0 + ramp % 7,
    }


def _check_line(text: str, what: str) -> None:
    assert isinstance(text, str), f"{what} must be a string"
    assert text.strip(), f"{what} must say something"
    assert "\n" not in text, f"{what} must be one line"


def _check_json(values: Mapping[str, Any], where: str) -> None:
    """Check that values are numbers, texts, None, and dictionaries and lists of those."""
    for path, value in _leaves(values, ()):
        place = f"{where}: {'.'.join(path)}"
        assert value is None or isinstance(value, str | bool | int | float | np.generic), (
            f"{place} is a {type(value).__name__}"
        )
        finite = not isinstance(value, float | np.floating) or np.isfinite(value)
        assert finite, f"{place} is {value}; None says that there is no value"


def _leaves(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            assert isinstance(key, str), f"{'.'.join(path)}: key {key!r} must be a string"
            yield from _leaves(item, (*path, key))
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _leaves(item, (*path, str(i)))
    else:
        yield path, value


def _check_plot(plot: Plot, where: str) -> None:
    where = f"{where}: plot {plot.title!r}"
    for text in (plot.title, plot.x_label, plot.y_label):
        _check_line(text, f"{where}: a title or label")
    assert plot.curves, f"{where} needs a curve"
    for curve in plot.curves:
        shapes = np.shape(curve.x), np.shape(curve.y)
        assert shapes[0] == shapes[1], f"{where}: {curve.name} has lengths {shapes}"
        assert len(shapes[0]) == 1, f"{where}: {curve.name} must be 1-D"
        assert np.isfinite(curve.x).all(), f"{where}: {curve.name} has an x that is not finite"
        alike = not plot.stacked or np.array_equal(curve.x, plot.curves[0].x)
        assert alike, f"{where}: stacked curves share their x"


def _absent(field: Any) -> bool:
    return field is None or (isinstance(field, Mapping) and not field)


def _same(first: Any, second: Any) -> bool:
    """Tell whether two values are equal throughout, arrays and trajectories included."""
    if type(first) is not type(second):
        return False
    if isinstance(first, np.ndarray):
        return np.array_equal(first, second, equal_nan=first.dtype.kind == "f")
    if isinstance(first, PoseTrajectory3D):
        return all(
            np.array_equal(getattr(first, key), getattr(second, key))
            for key in ("positions_xyz", "orientations_quat_wxyz", "timestamps")
        )
    if is_dataclass(first):
        return all(_same(getattr(first, f.name), getattr(second, f.name)) for f in fields(first))
    if isinstance(first, Mapping):
        return first.keys() == second.keys() and all(_same(first[k], second[k]) for k in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(_same, first, second))
    return bool(first == second)
