"""Judges evidence by metrics, and puts the verdicts together as sections of metrics.json."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from eval.alignment import Method
from eval.association import MAX_GAP
from eval.errors import EvalError, MetricError
from eval.evidence import Evidence
from eval.metrics.metric import Measurement, Metric, Section
from eval.plugins import check_value, find_metrics

_FIELDS = tuple(field.name for field in fields(Evidence))


@dataclass(frozen=True, slots=True)
class Settings:
    """How evidence is put together and judged (config group `eval`).

    Attributes:
        metrics: to judge by.
        alignment: how the estimate is moved onto the reference.
        max_gap: longest time in seconds between two reference poses to interpolate across.
    """

    metrics: tuple[Metric, ...]
    alignment: Method = "se3"
    max_gap: float = MAX_GAP


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a metric said.

    Attributes:
        metric: that was asked.
        measurement: its answer, or None.
        reason: why there is none.
    """

    metric: Metric
    measurement: Measurement | None
    reason: str | None


def make_settings(config: Mapping[str, Any]) -> Settings:
    """Make the settings that a config describes.

    Args:
        config: plain values; `metrics` holds a `_target_` and settings for each name. An entry that is
            null is left out.

    Raises:
        MetricError: a metric can't be made, or a setting is unknown or has a wrong value.
    """
    known = Settings.__annotations__
    if unknown := config.keys() - known.keys():
        raise MetricError(f"eval has no setting {', '.join(unknown)}; it has: {', '.join(known)}")
    rest = {
        key: check_value(f"eval.{key}", value, known[key])
        for key, value in config.items()
        if key != "metrics"
    }
    chosen = [settings for settings in config.get("metrics", {}).values() if settings is not None]
    return Settings(find_metrics(chosen), **rest)


def evaluate(evidence: Evidence, metrics: Iterable[Metric]) -> list[Verdict]:
    """Ask each metric; what can't be measured has a reason instead.

    Raises:
        MetricError: a metric breaks its contract.
    """
    return [_judge(evidence, metric) for metric in metrics]


def to_sections(verdicts: Sequence[Verdict]) -> dict[str, dict[str, Any]]:
    """Return the sections of metrics.json, all of them, whatever was measured.

    Each has the values of its metrics by their keys (null where there is no measurement), `reasons`
    by metric for those, `warnings`, and `headlines` by metric, for those who compare runs.

    Raises:
        MetricError: two metrics of a section share a key.
    """
    sections: dict[str, dict[str, Any]] = {}
    for section in Section:
        chosen = [v for v in verdicts if v.metric.section == section]
        answers = [v.measurement for v in chosen if v.measurement]
        sections[section.value] = {
            **_merged(chosen),
            "reasons": {v.metric.name: v.reason for v in chosen if v.reason is not None},
            "warnings": list(dict.fromkeys(text for answer in answers for text in answer.warnings)),
            "headlines": {v.metric.name: _headline(v) for v in chosen},
        }
    return sections


def _judge(evidence: Evidence, metric: Metric) -> Verdict:
    if unknown := sorted(set(metric.needs) - set(_FIELDS)):
        raise MetricError(
            f"metric {metric.name} needs {', '.join(unknown)}; there are: {', '.join(_FIELDS)}"
        )
    if reason := _lack(evidence, metric):
        return Verdict(metric, None, reason)
    try:
        measurement = metric.measure(evidence)
    except EvalError as error:
        return Verdict(metric, None, str(error))
    if set(measurement.values) != set(metric.keys):
        raise MetricError(
            f"metric {metric.name} promises {', '.join(metric.keys)} and returns"
            f" {', '.join(measurement.values)}"
        )
    return Verdict(metric, measurement, None)


def _lack(evidence: Evidence, metric: Metric) -> str | None:
    """Say what a metric needs and doesn't have."""
    absent = [need for need in metric.needs if _missing(getattr(evidence, need))]
    if not absent:
        return None
    known = [evidence.reasons[need] for need in absent if need in evidence.reasons]
    unknown = [need.replace("_", " ") for need in absent if need not in evidence.reasons]
    return "; ".join([*known, *([f"there is no {' and no '.join(unknown)}"] if unknown else [])])


def _missing(field: Any) -> bool:
    return field is None or (isinstance(field, Mapping) and not field)


def _headline(verdict: Verdict) -> dict[str, Any]:
    metric, measurement = verdict.metric, verdict.measurement
    return {
        "title": metric.title,
        "value": None if measurement is None else measurement.headline,
        "unit": metric.unit,
        "less_is_better": metric.less_is_better,
    }


def _merged(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for verdict in verdicts:
        metric, measurement = verdict.metric, verdict.measurement
        if twice := values.keys() & {*metric.keys}:
            raise MetricError(f"metric {metric.name} has keys of another: {', '.join(twice)}")
        found = measurement.values if measurement else dict.fromkeys(metric.keys)
        values.update({key: found[key] for key in metric.keys})
    return values
