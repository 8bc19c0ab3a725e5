"""The report of one run: what was measured, how sure it is, and what it looks like."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup
from numpy.typing import NDArray

from eval.evaluation import Verdict
from eval.evidence import Evidence
from eval.metrics.metric import Metric, Section
from eval.nearest import Points
from eval.report import charts, views
from eval.report.page import Page

Array = NDArray[np.float64]

_SECTIONS = {
    Section.TRAJECTORY: ("Trajectory", "Where the system thought it was, and where it should have been."),
    Section.MAP: ("Map", "What the system thinks the place looks like."),
    Section.GRAPH: ("Graph", "What is optimised; it should grow with the place, not with time."),
    Section.RESOURCES: ("Resources", "What the run cost in time, processor and memory."),
}  # fmt: skip
_MAP_DISTANCE = "distance_m"  # sample of a map metric: one distance for each point of the map
_CHOICES = ("scenario", "sensor", "system")


def write_run_report(
    path: Path, evidence: Evidence, verdicts: Sequence[Verdict], config_text: str = ""
) -> None:
    """Write the report of a run, one file that needs no network, replacing it as a whole.

    Args:
        path: of the HTML file.
        evidence: the files of the run.
        verdicts: of all metrics, also those that could not be measured.
        config_text: the composed config; empty if there is none.
    """
    page = Page(_title(path, evidence.run), _subtitle(evidence.run))
    alarm = _alarm(evidence.run, verdicts)
    page.add("At a glance", "", alarm, charts.figures(_cards(verdicts)), _missing(verdicts))
    for section, (heading, sentence) in _SECTIONS.items():
        blocks = [*_views(section, evidence, verdicts), *_groups(section, verdicts)]
        if blocks:
            page.add(heading, sentence, *blocks)
    page.add("The run", "What it takes to repeat it.", *_facts(evidence.run, config_text))
    page.write(path)


def _title(path: Path, run: Mapping[str, Any]) -> str:
    choices = run.get("choices", {})
    chosen = [str(choices[name]) for name in _CHOICES if choices.get(name)]
    if not chosen:
        return path.resolve().parent.name
    return " · ".join(
        [f"Scenario {chosen[0]}" if "scenario" in choices else chosen[0], *chosen[1:]]
    )


def _subtitle(run: Mapping[str, Any]) -> str:
    words = ["Evaluation of a SLAM run"]
    if "git_commit" in run:
        words.append(f"commit {str(run['git_commit'])[:10]}")
    if "seed" in run:
        words.append(f"seed {run['seed']}")
    return ", ".join(words)


def _cards(verdicts: Sequence[Verdict]) -> Iterator[charts.Card]:
    order = [*_SECTIONS]
    for verdict in sorted(verdicts, key=lambda verdict: order.index(verdict.metric.section)):
        metric, measurement = verdict.metric, verdict.measurement
        if measurement is not None and measurement.headline is not None:
            yield charts.Card(
                metric.title,
                measurement.headline,
                metric.unit,
                metric.meaning,
                metric.less_is_better,
            )


def _alarm(run: Mapping[str, Any], verdicts: Sequence[Verdict]) -> Markup:
    """Return what speaks against the run, and the warnings of all measurements, which may share one."""
    judged = run.get("verdict", {})
    sentences = [f"{judged['status']}: {reason}" for reason in judged.get("reasons", [])]
    sentences += [w for v in verdicts if v.measurement is not None for w in v.measurement.warnings]
    return charts.warnings("Read these figures with care", dict.fromkeys(sentences))


def _missing(verdicts: Sequence[Verdict]) -> Markup:
    """Say what was not measured, and why; metrics with the same reason together."""
    titles: dict[str, list[str]] = {}
    for verdict in verdicts:
        if verdict.measurement is None:
            titles.setdefault(verdict.reason or "no reason given", []).append(verdict.metric.title)
    sentences = (f"{', '.join(names)}: {reason}" for reason, names in titles.items())
    return charts.notes("Not measured", sentences)


def _views(section: Section, evidence: Evidence, verdicts: Sequence[Verdict]) -> Iterator[Markup]:
    if section is Section.TRAJECTORY and evidence.estimate is not None:
        yield from _trajectory_views(evidence)
    if section is Section.MAP and evidence.map is not None:
        yield _map_view(evidence.map, evidence.path_in_map, _distances(evidence.map, verdicts))


def _trajectory_views(evidence: Evidence) -> Iterator[Markup]:
    estimate, comparison = evidence.estimate, evidence.comparison
    assert estimate is not None
    over = "the closer to the grey reference the better" if comparison else "there is no reference"
    yield charts.group(
        "The paths",
        f"The estimated path from above; {over}. Loop closures tie places seen twice together.",
        views.trajectories(estimate, comparison, evidence.graph),
        views.height_profile(estimate, comparison),
    )
    if comparison is not None:
        yield charts.group(
            "Error along the path",
            "How far each estimated position is from the reference after alignment. Less is better; "
            "colour that comes and goes with places tells where the system has difficulties.",
            views.error_along_path(comparison),
        )


def _map_view(points: Points, path: Array | None, distances: Array | None) -> Markup:
    if distances is None:
        sentence = (
            "The map from above, coloured by height. There is no reference to compare it with."
        )
        return charts.group("The map", sentence, views.map_by_height(points, path))
    sentence = (
        "The map from above, coloured by how far its points are from the reference map. Less is better; "
        "what only one of the two maps has seen is far away without being wrong."
    )
    return charts.group("The map", sentence, views.map_by_distance(points, distances, path))


def _distances(points: Points, verdicts: Sequence[Verdict]) -> Array | None:
    """Return the (N,) distances of the map's points to the reference, if a metric has measured them."""
    for verdict in verdicts:
        if verdict.metric.section is Section.MAP and verdict.measurement is not None:
            distances = verdict.measurement.samples.get(_MAP_DISTANCE)
            if distances is not None and len(distances) == len(points):
                return distances
    return None


def _groups(section: Section, verdicts: Sequence[Verdict]) -> Iterator[Markup]:
    """Show the plots of each metric of a section, then the values of all."""
    chosen = [(v.metric, v.measurement) for v in verdicts if v.metric.section == section]
    rows: dict[tuple[str, str], Any] = {}
    for metric, measurement in chosen:
        if measurement is None:
            continue
        rows.update({(metric.title, key): v for key, v in _flat(measurement.values)})
        if measurement.plots:
            plots = (charts.chart(plot) for plot in measurement.plots)
            yield charts.group(metric.title, _sentence(metric), *plots)
    if rows:
        yield charts.fold("All values", charts.table(_frame(rows, ("metric", "figure"))))


def _sentence(metric: Metric) -> str:
    if metric.less_is_better is None:
        return metric.meaning
    return f"{metric.meaning} {'Less' if metric.less_is_better else 'More'} is better."


def _facts(run: Mapping[str, Any], config_text: str) -> Iterator[Markup]:
    if run:
        yield charts.table(_frame(dict(_flat(run)), ("fact",)))
    if config_text:
        yield charts.fold("Config", charts.code(config_text))


def _frame(rows: Mapping[Any, Any], names: tuple[str, ...]) -> pd.DataFrame:
    keys = [key if isinstance(key, tuple) else (key,) for key in rows]
    index = pd.MultiIndex.from_tuples(keys, names=names)
    return pd.DataFrame({"value": pd.Series([*rows.values()], index=index, dtype=object)})


def _flat(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield what nested dictionaries hold, with the names on the way there."""
    for key, value in values.items():
        name = f"{above} / {key}" if above else str(key)
        if isinstance(value, Mapping):
            yield from _flat(value, name)
        else:
            yield name, value
