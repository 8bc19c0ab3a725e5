"""What a run costs: sampled while it runs, summed up afterwards."""

import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

from eval.errors import EvidenceError
from eval.evidence import Evidence
from eval.files import GraphSketch
from eval.metrics.graph import GraphSize
from eval.metrics.resources import Memory, Processor, Speed, StageTimes
from lifelong_slam import resources
from lifelong_slam.resources import ResourceMonitor

BUSY = "import time; t = time.process_time()\nwhile time.process_time() - t < {seconds}: pass"
HOLDING = "x = bytearray(150_000_000); print('held', flush=True); input()"


def burn(seconds):
    start = time.process_time()
    while time.process_time() - start < seconds:
        pass


def wait_until(condition):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_processor_time_is_this_process_and_its_finished_children():
    with ResourceMonitor() as monitor:
        start = psutil.Process().cpu_times()
        burn(0.2)
        subprocess.run([sys.executable, "-c", BUSY.format(seconds=0.4)], check=True)
        end = psutil.Process().cpu_times()
    used = monitor.cpu_percent * monitor.wall_seconds / 100
    expected = sum(end[:4]) - sum(start[:4])
    assert expected > 0.6
    assert used == pytest.approx(expected, abs=0.1)


def test_memory_counts_children_while_they_live(monkeypatch):
    monkeypatch.setattr(resources, "_PERIOD", 0.01)
    with ResourceMonitor() as monitor:
        alone, others = monitor.rss_mb(), monitor.latest.child_rss_mb
        child = subprocess.Popen(
            [sys.executable, "-c", HOLDING], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        child.stdout.readline()
        wait_until(lambda: monitor.latest.child_rss_mb > others + 150)
        assert monitor.peak_rss_mb > alone + 150
        child.communicate(b"\n")
        wait_until(lambda: monitor.latest.child_rss_mb < others + 150)
    assert alone < monitor.mean_rss_mb < monitor.peak_rss_mb


def test_a_peak_between_two_samples_counts_if_it_was_looked_at(monkeypatch):
    monkeypatch.setattr(resources, "_PERIOD", 1000.0)
    with ResourceMonitor() as monitor:
        held = np.ones(25_000_000)
        peak = monitor.rss_mb()
        assert peak > 200
        del held
    assert monitor.peak_rss_mb >= peak


def test_a_child_that_ends_while_it_is_looked_at_is_no_error(monkeypatch):
    class Gone:
        def cpu_times(self):
            raise psutil.NoSuchProcess(1)

    monitor = ResourceMonitor()
    monkeypatch.setattr(monitor._process, "children", lambda recursive: [Gone()])
    with monitor:
        pass
    assert monitor.latest.child_rss_mb == 0


def timeline(count=10, **more):
    ramp = np.arange(count, dtype=float)
    columns = {"stamp": ramp, "odometry_ms": 20 + ramp, "loop_ms": 0 * ramp + 5}
    return Evidence(timeline={**columns, **more})


def test_speed_is_over_wall_time_where_it_is_known():
    evidence = timeline()
    found = Speed().measure(evidence)
    seconds = (245 + 50) / 1000
    assert found.values == {
        "scans": 10,
        "scans_per_s": pytest.approx(10 / seconds),
        "wall_s": None,
        "processing_s": pytest.approx(seconds),
    }
    timed = Evidence(timeline=evidence.timeline, run={"wall_seconds": 2.5})
    assert Speed().measure(timed).headline == pytest.approx(4.0)


def test_time_per_stage_has_percentiles_and_a_total():
    found = StageTimes().measure(timeline())
    spreads = found.values["stages_ms"]
    assert list(spreads) == ["odometry", "loop", "total"]
    assert spreads["odometry"] == {
        "mean": pytest.approx(24.5),
        "p50": pytest.approx(24.5),
        "p95": pytest.approx(28.55),
        "p99": pytest.approx(28.91),
        "max": 29.0,
        "sum": 245.0,
    }
    assert found.headline == pytest.approx(29.5)
    (plot,) = found.plots
    assert plot.stacked
    total = sum(curve.y for curve in plot.curves)
    np.testing.assert_allclose(total, found.samples["total_ms"])


def test_memory_adds_up_the_run_and_its_children():
    own, children = np.arange(10.0) + 100, np.r_[np.zeros(5), np.full(5, 50.0)]
    found = Memory().measure(timeline(rss_mb=own, child_rss_mb=children))
    assert found.values == {
        "peak_rss_mb": 159.0,
        "mean_rss_mb": pytest.approx(129.5),
        "peak_child_rss_mb": 50.0,
    }
    assert [curve.name for curve in found.plots[0].curves] == ["run", "child processes"]


def test_what_the_run_sampled_goes_before_its_rows():
    evidence = timeline(rss_mb=np.full(10, 100.0), cpu_percent=np.full(10, 50.0))
    run = {"peak_rss_mb": 300.0, "mean_rss_mb": 120.0, "cpu_percent": 130.0}
    whole = Evidence(timeline=evidence.timeline, run=run)
    assert Memory().measure(whole).values["peak_rss_mb"] == 300.0
    assert Memory().measure(whole).values["mean_rss_mb"] == 120.0
    assert Processor().measure(whole).headline == 130.0
    assert Processor().measure(evidence).headline == 50.0


@pytest.mark.parametrize("metric", [Memory(), Processor()])
def test_what_was_not_sampled_has_a_reason(metric):
    with pytest.raises(EvidenceError, match=r"no column rss_mb|not sampled"):
        metric.measure(timeline())


def test_the_graph_is_counted_by_kind_and_plotted_as_it_grew():
    edges = np.zeros((5, 2), np.int64)
    graph = GraphSketch(np.zeros((4, 3)), edges, np.arange(5) == 3, np.arange(5) == 4)
    rows = {"stamp": np.arange(3.0), "vertices": np.array([1.0, 2, 4])}
    found = GraphSize().measure(Evidence(graph=graph, timeline=rows))
    kinds = {"odometry_edges": 3, "loop_edges": 1, "composed_edges": 1}
    assert found.values == {"vertices": 4, "edges": 5, **kinds}
    (curve,) = found.plots[0].curves
    assert curve.y.tolist() == [1, 2, 4]
    assert GraphSize().measure(Evidence(graph=graph)).plots == ()
