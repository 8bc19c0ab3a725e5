"""Every metric keeps the contract that ships with eval, and the contract catches those that don't."""

import importlib.util
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from settings_support import default_settings

from eval import plugins
from eval.errors import EvidenceError
from eval.metrics.metric import Curve, Measurement, Plot, Section
from eval.plugins import GROUP, find_metrics
from eval.testing import check_metric, examples

ROOT = Path(__file__).resolve().parents[1]


def load_example():
    path = ROOT / "docs" / "example_metric" / "example_metric.py"
    spec = importlib.util.spec_from_file_location("example_metric", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


METRICS = default_settings().metrics
example_metric = load_example()


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: metric.name)
def test_default_metrics_keep_the_contract(metric):
    check_metric(metric)


@pytest.mark.parametrize("settings", [{}, {"percentile": 50.0}])
def test_the_documented_example_keeps_the_contract(settings):
    check_metric(example_metric.Acceleration(**settings))


def test_the_example_is_found_by_its_entry_point_once_it_is_installed(monkeypatch):
    folder = ROOT / "docs" / "example_metric"
    monkeypatch.syspath_prepend(folder)
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    entries = [EntryPoint(*item, GROUP) for item in project["entry-points"][GROUP].items()]
    monkeypatch.setattr(plugins, "entry_points", lambda group: entries if group == GROUP else [])
    (metric,) = find_metrics([])
    assert metric.name == "acceleration"


def test_the_example_knows_a_constant_acceleration():
    full = examples()["everything"]
    t = full.estimate.timestamps - full.estimate.timestamps[0]
    path = type(full.estimate)(
        np.column_stack([1.5 * t**2, 2.0 * t**2, 0 * t]),
        full.estimate.orientations_quat_wxyz,
        full.estimate.timestamps,
    )
    found = example_metric.Acceleration().measure(replace(full, estimate=path))
    assert found.headline == pytest.approx(5.0, rel=1e-3)


class Good:
    """A metric that keeps the contract; each test below breaks it in one place."""

    name = "good"
    title = "Good"
    section = Section.TRAJECTORY
    keys = ("poses_count",)
    needs = ("estimate",)
    unit = ""
    less_is_better = None
    meaning = "How many poses there are."

    values = {"poses_count": 3}  # noqa: RUF012
    headline = 3.0
    samples = {}  # noqa: RUF012
    plots = ()
    warnings = ()

    def measure(self, evidence):
        return Measurement(self.values, self.headline, self.samples, self.plots, self.warnings)


def line(x, y, **more):
    return (Plot("Title", "x", "y", (Curve("a", np.array(x), np.array(y)),), **more),)


def test_a_good_metric_passes():
    check_metric(Good())


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("name", "", "name must not be empty"),
        ("name", "Bad Name", "snake_case"),
        ("title", None, "title must be a string"),
        ("section", "poses", "section"),
        ("keys", ["poses_count"], "keys must be a tuple"),
        ("keys", ("poses_count", "poses_count"), "must not repeat"),
        ("keys", ("other",), r"keys \['poses_count'\] instead of \['other'\]"),
        ("keys", ("warnings",), "taken"),
        ("needs", ("estimates",), "Evidence doesn't have"),
        ("less_is_better", "yes", "bool or None"),
        ("meaning", "number of poses", "a sentence"),
        ("headline", float("nan"), "headline must be finite"),
        ("values", {"poses_count": float("inf")}, "poses_count is inf"),
        ("values", {"poses_count": {"deep": [1, np.zeros(3)]}}, "poses_count.deep.1 is a ndarray"),
        ("values", {"poses_count": {3: 1}}, "must be a string"),
        ("samples", {"e": np.zeros((2, 2))}, "samples e must be 1-D"),
        ("samples", {"e": np.array([np.nan])}, "samples e must be finite"),
        ("plots", line([1, 2], [1]), "lengths"),
        ("plots", line([np.nan], [1.0]), "not finite"),
        ("plots", (Plot("", "x", "y", line([1], [1])[0].curves),), "must say something"),
        ("plots", (Plot("Title", "x", "y", ()),), "needs a curve"),
        ("warnings", ("two\nlines",), "one line"),
    ],
)
def test_broken_metrics_are_told_what_is_wrong(attribute, value, message):
    metric = Good()
    setattr(metric, attribute, value)
    with pytest.raises(AssertionError, match=message):
        check_metric(metric)


class Vandal(Good):
    def measure(self, evidence):
        evidence.estimate.positions_xyz[0] += 1
        return super().measure(evidence)


class Moody(Good):
    count = 0

    def measure(self, evidence):
        self.count += 1
        return Measurement({"poses_count": self.count}, None)


class Silent(Good):
    def measure(self, evidence):
        raise EvidenceError("not today")


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        (Vandal(), "evidence was changed"),
        (Moody(), "another result"),
        (Silent(), "measured nothing"),
    ],
)
def test_broken_behaviour_is_told(metric, message):
    with pytest.raises(AssertionError, match=message):
        check_metric(metric)
