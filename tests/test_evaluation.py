"""How metrics are found, asked, and put together."""

from importlib.metadata import EntryPoint
from types import SimpleNamespace

import numpy as np
import pytest
from eval_support import disturbed, make, winding
from scipy.spatial.transform import Rotation

from eval import plugins
from eval.errors import EvidenceError, FileError, MetricError
from eval.evaluation import evaluate, make_settings, to_sections
from eval.evidence import Evidence
from eval.evidence_files import EvidenceFiles, read_evidence
from eval.metrics.metric import Measurement, Section
from eval.plugins import find_metrics, make_metric

HERE = __name__


class Count:
    """Counts poses, or whatever it is told."""

    section = Section.TRAJECTORY
    unit = ""
    less_is_better = None
    meaning = "A number."

    def __init__(
        self,
        name: str = "count",
        keys: tuple[str, ...] = ("count",),
        needs: tuple[str, ...] = ("estimate",),
    ):
        self.name, self.keys, self.needs = name, keys, needs
        self.title = name.capitalize()

    def measure(self, evidence):
        return Measurement(dict.fromkeys(self.keys, 3), 3.0, warnings=("doubtful",))


class Namesake(Count):
    def __init__(self):
        super().__init__()
        self.name = "namesake"


class Refusing(Count):
    def measure(self, evidence):
        raise EvidenceError("not with these poses")


class Buggy(Count):
    def measure(self, evidence):
        raise ZeroDivisionError("a bug")


class Untrue(Count):
    def measure(self, evidence):
        return Measurement({"something": 1}, None)


class Scaled(Count):
    def __init__(self, factor: float, deltas: list[float] | None = None):
        super().__init__(name="scaled")
        self.factor, self.deltas = factor, deltas


class Unfinished:
    name = "unfinished"
    needs = ()

    def measure(self, evidence):
        return None


class Crashing(Count):
    def __init__(self):
        raise ZeroDivisionError("oh")


@pytest.fixture
def installed(monkeypatch):
    """Pretend that packages offer metrics by entry points."""

    def offer(**values):
        entries = [EntryPoint(name, value, plugins.GROUP) for name, value in values.items()]
        monkeypatch.setattr(plugins, "entry_points", lambda group: entries)

    return offer


EVIDENCE = Evidence(estimate=winding(5))


def test_verdicts_are_in_the_order_of_the_metrics():
    verdicts = evaluate(EVIDENCE, [Count("b"), Count("a")])
    assert [v.metric.name for v in verdicts] == ["b", "a"]
    assert [v.measurement.headline for v in verdicts] == [3.0, 3.0]


def test_what_cannot_be_measured_has_a_reason():
    evidence = Evidence(estimate=winding(5), reasons={"comparison": "no overlap in time"})
    verdicts = evaluate(
        evidence,
        [
            Count("a", needs=("comparison", "estimate")),
            Count("b", needs=("map", "reference_map")),
            Count("c", needs=("run",)),
            Count("d", needs=("comparison", "graph")),
            Refusing("e"),
        ],
    )
    assert [v.measurement for v in verdicts] == [None] * 5
    assert [v.reason for v in verdicts] == [
        "no overlap in time",
        "there is no map and no reference map",
        "there is no run",
        "no overlap in time; there is no graph",
        "not with these poses",
    ]


def test_an_empty_array_is_evidence():
    evidence = Evidence(map=np.zeros((0, 3), np.float32))
    assert evaluate(evidence, [Count(needs=("map",))])[0].measurement is not None


def test_bugs_are_not_reasons():
    with pytest.raises(ZeroDivisionError):
        evaluate(EVIDENCE, [Buggy()])


def test_metrics_that_break_their_promises_are_named():
    with pytest.raises(MetricError, match="metric untrue promises count and returns something"):
        evaluate(EVIDENCE, [Untrue("untrue")])
    with pytest.raises(MetricError, match="needs estimates; there are: estimate, comparison"):
        evaluate(EVIDENCE, [Count(needs=("estimates",))])


def test_sections_have_values_reasons_and_warnings():
    verdicts = evaluate(
        EVIDENCE,
        [Count("a", ("x", "y")), Refusing("b", ("z",)), Count("c", ("w",)), Count("d", ("v",))],
    )
    verdicts[3].metric.section = Section.GRAPH
    sections = to_sections(verdicts)
    assert list(sections) == ["trajectory", "map", "resources", "graph"]
    assert sections["trajectory"] == {
        "x": 3,
        "y": 3,
        "z": None,
        "w": 3,
        "reasons": {"b": "not with these poses"},
        "warnings": ["doubtful"],
        "headlines": {
            name: {"title": name.capitalize(), "value": value, "unit": "", "less_is_better": None}
            for name, value in (("a", 3.0), ("b", None), ("c", 3.0))
        },
    }
    assert sections["map"] == {"reasons": {}, "warnings": [], "headlines": {}}
    assert sections["graph"]["v"] == 3


def test_two_metrics_cannot_have_one_key():
    verdicts = evaluate(EVIDENCE, [Count("a", ("x",)), Count("b", ("x", "y"))])
    with pytest.raises(MetricError, match="metric b has keys of another: x"):
        to_sections(verdicts)


def test_settings_are_converted_by_their_type_hints():
    metric = make_metric({"_target_": f"{HERE}.Scaled", "factor": "2", "deltas": [1, "3"]})
    assert (metric.factor, metric.deltas) == (2.0, [1.0, 3.0])
    assert metric.name == "scaled"


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({}, "needs a _target_"),
        ({"_target_": "nowhere.Thing"}, "nowhere.Thing can't be loaded"),
        ({"_target_": "Thing"}, "Thing can't be loaded"),
        ({"_target_": f"{HERE}.Nothing"}, "Nothing can't be loaded"),
        ({"_target_": f"{HERE}.HERE"}, "no class"),
        ({"_target_": "eval.errors.EvalError"}, "no class of metrics"),
        ({"_target_": f"{HERE}.Unfinished"}, "it lacks title, section, keys"),
        ({"_target_": f"{HERE}.Crashing"}, "Crashing can't be made: ZeroDivisionError: oh"),
        ({"_target_": f"{HERE}.Scaled"}, "'factor'; it takes: factor, deltas"),
        ({"_target_": f"{HERE}.Scaled", "factor": "much"}, "factor: .*valid number.*'much'"),
        ({"_target_": f"{HERE}.Scaled", "factr": 1, "factor": 1}, "'factr'; it takes: factor"),
    ],
)
def test_wrong_configs_are_told_in_one_line(config, message):
    with pytest.raises(MetricError, match=message) as caught:
        make_metric(config)
    assert "\n" not in str(caught.value)


def test_installed_metrics_come_after_those_of_the_config(installed):
    installed(count=f"{HERE}:Count")
    metrics = find_metrics([{"_target_": f"{HERE}.Scaled", "factor": 1}])
    assert [type(metric) for metric in metrics] == [Scaled, Count]


def test_the_configs_settings_go_before_an_installed_metrics_defaults(installed):
    installed(scaled=f"{HERE}:Scaled")
    (metric,) = find_metrics([{"_target_": f"{HERE}.Scaled", "factor": 7}])
    assert metric.factor == 7.0


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (f"{HERE}:Nothing", "metric broken of .*:Nothing can't be loaded"),
        ("not_installed_at_all:X", "metric broken .* can't be loaded: No module named"),
        (f"{HERE}:Scaled", "metric broken .*'factor'"),
        (f"{HERE}:Crashing", "metric broken .* can't be made: ZeroDivisionError"),
        (f"{HERE}:EVIDENCE", "metric broken .* no class"),
    ],
)
def test_a_broken_plugin_is_named(installed, value, message):
    installed(broken=value)
    with pytest.raises(MetricError, match=message):
        find_metrics([])


def test_names_are_unique(installed):
    installed(count=f"{HERE}:Count")
    with pytest.raises(MetricError, match="more than one metric is called count"):
        find_metrics([{"_target_": f"{HERE}.Refusing"}])


def test_titles_are_unique(installed):
    installed(namesake=f"{HERE}:Namesake")
    with pytest.raises(MetricError, match="more than one metric is called Count"):
        find_metrics([{"_target_": f"{HERE}.Count"}])


def test_settings_of_the_group(installed):
    installed()
    config = {"alignment": "yaw", "max_gap": 1, "metrics": {"a": {"_target_": f"{HERE}.Count"}}}
    settings = make_settings(config)
    assert (settings.alignment, settings.max_gap) == ("yaw", 1.0)
    assert [metric.name for metric in settings.metrics] == ["count"]
    assert make_settings({"metrics": {"a": None}}).metrics == ()
    with pytest.raises(MetricError, match=r"eval.alignment: .*'se3'.*got 'se4'"):
        make_settings({"alignment": "se4"})
    with pytest.raises(MetricError, match="eval has no setting aligment; it has: metrics"):
        make_settings({"aligment": "se3"})


def write_tum(path, trajectory):
    quaternions = np.roll(trajectory.orientations_quat_wxyz, -1, axis=1)
    rows = np.column_stack([trajectory.timestamps, trajectory.positions_xyz, quaternions])
    np.savetxt(path, rows, fmt="%.9f")
    return path


def write_ply(path, points):
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    path.write_bytes(header.encode() + points.astype("<f4").tobytes())
    return path


@pytest.fixture
def drive(tmp_path):
    reference = winding()
    estimate = disturbed(reference, size=0.0)
    return SimpleNamespace(
        estimate=write_tum(tmp_path / "a.tum", estimate),
        reference=write_tum(tmp_path / "b.tum", reference),
        folder=tmp_path,
    )


def test_the_map_goes_where_the_alignment_takes_the_path(drive, monkeypatch):
    monkeypatch.setattr("eval.evidence_files._BLOCK", 7)
    points = winding().positions_xyz[:50]
    moved = disturbed(winding(), size=0.0).positions_xyz[:50]
    files = EvidenceFiles(
        estimate=drive.estimate,
        reference=drive.reference,
        map=write_ply(drive.folder / "a.ply", moved),
        reference_map=write_ply(drive.folder / "b.ply", points),
    )
    evidence = read_evidence(files)
    np.testing.assert_allclose(evidence.map, points, atol=1e-4)
    stays = read_evidence(files, alignment="none")
    np.testing.assert_allclose(stays.map, moved, atol=1e-4)


@pytest.mark.parametrize("same_body", [True, False])
def test_a_straight_path_does_not_roll_the_map(drive, same_body):
    """Positions 5 cm off a line would let it roll by whole degrees; orientations hold it."""
    rng = np.random.default_rng(3)
    path = np.column_stack([np.arange(200.0), np.zeros(200), np.zeros(200)])
    noise = 0.05 * rng.normal(size=(200, 3))
    other = Rotation.identity() if same_body else Rotation.from_euler("xyz", [0.5, 0.4, 1.0])
    reference = make(path)
    estimate = make(path + noise, Rotation.identity(200) * other)
    points = np.column_stack([200 * rng.random(500), rng.uniform(-40, 40, 500), rng.random(500)])
    evidence = read_evidence(
        EvidenceFiles(
            estimate=write_tum(drive.folder / "line.tum", estimate),
            reference=write_tum(drive.folder / "true.tum", reference),
            map=write_ply(drive.folder / "a.ply", points),
            reference_map=write_ply(drive.folder / "b.ply", points),
        )
    )
    distances = np.linalg.norm(evidence.map - points, axis=1)
    if same_body:
        assert distances.max() < 0.05
    else:
        positions = evidence.comparison.alignment.move(points)
        np.testing.assert_allclose(evidence.map, positions, atol=1e-3)
        assert distances.max() > 0.5  # what the positions leave open


def test_the_map_stays_where_nothing_tells_where_it_belongs(drive):
    points = np.arange(30.0).reshape(10, 3)
    path = write_ply(drive.folder / "a.ply", points)
    alone = read_evidence(
        EvidenceFiles(estimate=drive.estimate, reference=drive.reference, map=path)
    )
    np.testing.assert_allclose(alone.map, points)
    maps = read_evidence(EvidenceFiles(map=path, reference_map=path))
    np.testing.assert_allclose(maps.map, points)


def test_trajectories_that_do_not_meet_are_a_reason(drive):
    late = winding()
    late.timestamps = late.timestamps + 1000.0
    path = write_tum(drive.folder / "late.tum", late)
    evidence = read_evidence(EvidenceFiles(estimate=drive.estimate, reference=path))
    assert evidence.comparison is None
    assert "within the reference's time" in evidence.reasons["comparison"]
    alone = read_evidence(EvidenceFiles(estimate=drive.estimate))
    assert alone.reasons["comparison"] == "there is no reference trajectory"


def test_poses_without_stamps_are_counted(tmp_path):
    rows = [" ".join(map(str, T[:3].ravel())) for T in winding(20).poses_se3]
    (tmp_path / "a.txt").write_text("\n".join(rows) + "\n")
    path = tmp_path / "a.txt"
    evidence = read_evidence(EvidenceFiles(estimate=path, reference=path))
    assert evidence.estimate.timestamps.tolist() == list(range(20))
    assert not evidence.comparison.pairs.stamped
    assert evidence.comparison.errors.max() < 1e-9


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileError, match=r"nowhere.tum"):
        read_evidence(EvidenceFiles(estimate=tmp_path / "nowhere.tum"))
