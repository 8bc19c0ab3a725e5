"""Evaluates a run folder: metrics.json, plots/ and report.html from the files that a run left."""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from eval.errors import FileError, readable
from eval.evaluation import Settings, Verdict, evaluate, to_sections
from eval.evidence import Evidence
from eval.evidence_files import EvidenceFiles, read_evidence
from eval.files import read_json, write_json

_log = logging.getLogger(__name__)

REFERENCE_MAP = "reference_map.ply"


Judged = tuple[Evidence, list[Verdict]]


def evaluate_run(
    folder: Path, settings: Settings, run_info: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Judge the files of a run folder, write the results into it, return the metrics.

    See `judge_run` for arguments and errors.
    """
    return write_results(folder, *judge_run(folder, settings, run_info))


def judge_run(
    folder: Path,
    settings: Settings,
    run_info: Mapping[str, Any] | None = None,
    without: Collection[str] = (),
) -> Judged:
    """Read the files of a run folder and judge them.

    What can't be measured has a reason instead; everything else is still there.

    Args:
        folder: a run folder with trajectory.tum, map.ply, pose_graph.g2o and timeline.csv, and
            where there are some to trust, reference.tum and reference_map.ply.
        settings: what to judge by.
        run_info: section `run` of metrics.json, such as versions, seed and machine; without it,
            that of an earlier metrics.json is kept.
        without: names of files that the run couldn't write.

    Raises:
        FileError: a file of the run folder is missing or malformed; the references may be missing.
        MetricError: a metric breaks its contract.
    """
    run_info = earlier_info(folder) if run_info is None else run_info
    files = run_files(folder, without)
    evidence = read_evidence(files, settings.alignment, settings.max_gap, run_info)
    return evidence, evaluate(evidence, settings.metrics)


def run_files(folder: Path, without: Collection[str] = ()) -> EvidenceFiles:
    """Return where the evidence of a run folder lies, `without` files of some names."""
    reference, surface = folder / "reference.tum", folder / REFERENCE_MAP
    if surface.is_symlink() and not surface.exists():
        _log.warning("%s leads to a file that isn't there any more", surface)
    files = EvidenceFiles(
        estimate=folder / "trajectory.tum",
        reference=reference if reference.is_file() else None,
        map=folder / "map.ply",
        reference_map=surface if surface.is_file() else None,
        graph=folder / "pose_graph.g2o",
        timeline=folder / "timeline.csv",
    )
    paths = {field.name: getattr(files, field.name) for field in fields(files)}
    return replace(
        files, **{key: None for key, path in paths.items() if path and path.name in without}
    )


def earlier_info(folder: Path) -> dict[str, Any]:
    """Return section `run` of a folder's metrics.json, empty where there is none."""
    path = folder / "metrics.json"
    try:
        info = read_json(path).get("run") if path.is_file() else None
    except FileError as error:
        _log.warning("what an earlier evaluation knew of the run is left out: %s", error)
        return {}
    return info if isinstance(info, dict) else {}


def to_metrics(evidence: Evidence, verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Return the content of metrics.json."""
    return {**to_sections(verdicts), "run": dict(evidence.run)}


def write_results(folder: Path, evidence: Evidence, verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Write metrics.json, plots/ and report.html into a folder, and return the metrics."""
    write_metrics(folder, evidence, verdicts)
    write_plots(folder, evidence, verdicts)
    write_report(folder, evidence, verdicts)
    return to_metrics(evidence, verdicts)


def write_metrics(folder: Path, evidence: Evidence, verdicts: Sequence[Verdict]) -> None:
    """Write metrics.json into a folder."""
    write_json(folder / "metrics.json", to_metrics(evidence, verdicts))


def write_report(folder: Path, evidence: Evidence, verdicts: Sequence[Verdict]) -> None:
    """Write report.html into a folder, with the config that is there."""
    from eval.report.run_report import write_run_report  # takes a second, as does Matplotlib

    write_run_report(folder / "report.html", evidence, verdicts, _config_text(folder))


def write_plots(folder: Path, evidence: Evidence, verdicts: Sequence[Verdict]) -> None:
    """Write the plots of each metric under its name, and pictures of path and map, into plots/."""
    from eval import plots

    figures = {}
    for verdict in verdicts:
        drawn = verdict.measurement.plots if verdict.measurement else ()
        for i, plot in enumerate(drawn, 1):
            name = verdict.metric.name if len(drawn) == 1 else f"{verdict.metric.name}_{i}"
            figures[name] = plots.declared(plot)
    if evidence.estimate is not None:
        figures["trajectory"] = plots.trajectory(
            evidence.estimate, evidence.comparison, evidence.graph
        )
    if evidence.map is not None:
        path = evidence.path_in_map
        figures["map"] = plots.map_from_above(
            evidence.map, np.zeros((0, 3)) if path is None else path
        )
    for name, figure in figures.items():
        plots.save(figure, folder / "plots" / f"{name}.png")


def _config_text(folder: Path) -> str:
    """Return the config that Hydra left with a run, empty where there is none."""
    path = folder / ".hydra" / "config.yaml"
    if not path.is_file():
        return ""
    with readable(path, "config"):
        return path.read_text()
