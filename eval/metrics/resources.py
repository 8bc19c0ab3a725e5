"""What a run costs: its speed, the time of its stages, processor and memory (paper 001, section 2).

Read from timeline.csv, a row a scan, with columns `*_ms` for the stages and, where they were sampled,
`rss_mb`, `child_rss_mb` and `cpu_percent`; and from what the run measured of itself as a whole:
`wall_seconds`, `cpu_percent`, `peak_rss_mb` and `mean_rss_mb` of section `run`.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eval.errors import EvidenceError
from eval.evidence import Evidence
from eval.files import Timeline
from eval.metrics.metric import Curve, Measurement, Plot, Section

Array = NDArray[np.float64]

_STAGE = "_ms"


class Speed:
    """Scans a second, over the wall time of the run where it is known, else over the stages' time."""

    name = "speed"
    title = "Speed"
    section = Section.RESOURCES
    keys: tuple[str, ...] = ("scans", "scans_per_s", "wall_s", "processing_s")
    needs: tuple[str, ...] = ("timeline",)
    unit = "scans/s"
    less_is_better: bool | None = False
    meaning = "How many scans a second were processed; live use needs as many as the sensor takes."

    def measure(self, evidence: Evidence) -> Measurement:
        """Count the scans and divide by the time they took."""
        timeline = _timeline(evidence)
        scans = _scans(timeline)
        processing = float(sum(stage.sum() for stage in _stages(timeline).values())) / 1000
        wall = _number(evidence.run, "wall_seconds")
        seconds = processing if wall is None else wall
        rate = scans / seconds if scans and seconds > 0 else None
        values = {
            "scans": scans,
            "scans_per_s": rate,
            "wall_s": wall,
            "processing_s": processing,
        }
        return Measurement(values, rate)


class StageTimes:
    """Time per stage and scan, with percentiles."""

    name = "stage_times"
    title = "Time per scan"
    section = Section.RESOURCES
    keys: tuple[str, ...] = ("stages_ms",)
    needs: tuple[str, ...] = ("timeline",)
    unit = "ms"
    less_is_better: bool | None = True
    meaning = (
        "Mean processing time of a scan; its percentiles tell whether some scans take far longer."
    )

    def measure(self, evidence: Evidence) -> Measurement:
        """Sum up each stage and their total.

        Raises:
            EvidenceError: the timeline has no stages.
        """
        timeline = _timeline(evidence)
        stages = _stages(timeline)
        if not stages:
            raise EvidenceError("the timeline has no column of a stage, whose name ends with _ms")
        total = np.sum([*stages.values()], axis=0)
        spreads = {name: _spread(values) for name, values in {**stages, "total": total}.items()}
        scan = _numbers(total)
        plot = Plot(
            "Time per stage",
            "scan",
            "time [ms]",
            tuple(Curve(name, scan, values) for name, values in stages.items()),
            stacked=True,
        )
        mean = spreads["total"]["mean"] if spreads["total"] else None
        return Measurement({"stages_ms": spreads}, mean, {"total_ms": total}, (plot,))


class Memory:
    """Resident memory of the run and its child processes."""

    name = "memory"
    title = "Peak memory"
    section = Section.RESOURCES
    keys: tuple[str, ...] = ("peak_rss_mb", "mean_rss_mb", "peak_child_rss_mb")
    needs: tuple[str, ...] = ("timeline",)
    unit = "MB"
    less_is_better: bool | None = True
    meaning = "Largest resident memory of the run, its child processes included."

    def measure(self, evidence: Evidence) -> Measurement:
        """Take the run's own figures where it has them, else those of the timeline.

        Raises:
            EvidenceError: memory was not sampled.
        """
        timeline = _timeline(evidence)
        if "rss_mb" not in timeline:
            raise EvidenceError("the timeline has no column rss_mb")
        own = timeline["rss_mb"]
        children = timeline.get("child_rss_mb", np.zeros_like(own))
        both = own + children
        scan = _numbers(own)
        curves = [Curve("run", scan, both)]
        if children.any():
            curves.append(Curve("child processes", scan, children))
        plot = Plot("Resident memory", "scan", "memory [MB]", tuple(curves))
        peak = _number(evidence.run, "peak_rss_mb", _or_none(both, np.max))
        values = {
            "peak_rss_mb": peak,
            "mean_rss_mb": _number(evidence.run, "mean_rss_mb", _or_none(both, np.mean)),
            "peak_child_rss_mb": _or_none(children, np.max),
        }
        return Measurement(values, peak, {"rss_mb": both}, (plot,))


class Processor:
    """Processor time over wall time, of the run and its child processes."""

    name = "processor"
    title = "CPU"
    section = Section.RESOURCES
    keys: tuple[str, ...] = ("cpu_percent",)
    needs: tuple[str, ...] = ("timeline",)
    unit = "%"
    less_is_better: bool | None = True
    meaning = (
        "Processor time over wall time, child processes included; 100 is one core in full use."
    )

    def measure(self, evidence: Evidence) -> Measurement:
        """Take the run's own figure where it has one, else the mean of the timeline.

        Raises:
            EvidenceError: CPU use was not sampled.
        """
        sampled = _timeline(evidence).get("cpu_percent", np.zeros(0))
        percent = _number(evidence.run, "cpu_percent", _or_none(sampled, np.mean))
        if percent is None:
            raise EvidenceError(
                "CPU use was not sampled: neither the run nor the timeline has cpu_percent"
            )
        if not len(sampled):
            return Measurement({"cpu_percent": percent}, percent)
        curve = Curve("run", _numbers(sampled), sampled)
        plot = Plot("CPU", "scan", "CPU [% of a core]", (curve,))
        return Measurement({"cpu_percent": percent}, percent, {"cpu_percent": sampled}, (plot,))


def _timeline(evidence: Evidence) -> Timeline:
    assert evidence.timeline is not None  # as every metric of this module needs it
    return evidence.timeline


def _scans(timeline: Timeline) -> int:
    return len(next(iter(timeline.values())))


def _numbers(values: Array) -> Array:
    """Number (N,) values of scans from one."""
    return np.arange(1, len(values) + 1, dtype=np.float64)


def _stages(timeline: Timeline) -> dict[str, Array]:
    """Return the (N,) milliseconds of each stage by its name."""
    return {k.removesuffix(_STAGE): v for k, v in timeline.items() if k.endswith(_STAGE)}


def _spread(values: Array) -> dict[str, float] | None:
    """Return mean, percentiles, maximum and sum of (N,) values."""
    if len(values) == 0:
        return None
    p50, p95, p99 = np.percentile(values, (50, 95, 99)).tolist()
    return {
        "mean": float(values.mean()),
        "p50": p50,
        "p95": p95,
        "p99": p99,
        "max": float(values.max()),
        "sum": float(values.sum()),
    }


def _or_none(values: Array, statistic: Callable[[Array], Any]) -> float | None:
    return float(statistic(values)) if len(values) else None


def _number(run: Mapping[str, Any], key: str, otherwise: float | None = None) -> float | None:
    """Return a positive figure that the run measured of itself."""
    value = run.get(key)
    return float(value) if isinstance(value, int | float) and value > 0 else otherwise
