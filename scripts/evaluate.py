"""Judge the trajectory and the map of any SLAM system.

    python scripts/evaluate.py estimate=a.tum reference=b.tum
    python scripts/evaluate.py estimate=a.tum reference=b.tum map=x.ply reference_map=y.pcd out=report
    python scripts/evaluate.py estimate=drive.bag topic=/odom relations=true.relations alignment=none
    python scripts/evaluate.py grid=a.yaml reference_grid=b.yaml
    python scripts/evaluate.py run=outputs/my_run

Prints what was found; less or more is better as the table says. Settings, with their defaults in
conf/evaluate.yaml and conf/eval:

    estimate=FILE         estimated trajectory: TUM, KITTI, csv as EuRoC's or by its heading; bag or MCAP
    reference=FILE        trajectory to trust, of any of these kinds
    topic=T               of the estimate, where it is a bag with several topics of poses or odometry
    reference_topic=T     of the reference
    alignment=se3         of the estimate onto the reference: none, first_pose, se3 (Kabsch), yaw
                          (about z, and translation) or sim3 (with a scale)
    max_gap=0.25          s between two reference poses to interpolate across
    relations=FILE        true relative poses (Kuemmerle et al. 2009)
    map=FILE              estimated points: PLY, PCD, LAS or LAZ; in the frame of the estimate
    reference_map=FILE    points to trust, in the frame of the reference: where there are both
                          trajectories, their alignment moves the map there
    grid=FILE             estimated occupancy grid, map_server's YAML file beside its image
    reference_grid=FILE   occupancy grid to trust
    run=FOLDER            a run folder to evaluate again; the files above go before its own
    out=FOLDER            writes metrics.json, report.html, plots/ and evo_ape.zip (for evo_res) there;
                          a run folder itself if only run= is given
    eval.metrics.NAME.KEY=VALUE     changes a metric; eval.metrics.NAME=null leaves it out
    +eval.metrics.NAME._target_=C   adds the metric class C; see docs/metrics.md

Exit status: 0 done; 2 bad input or settings, said in one line; 130 stopped by Ctrl-C.
"""

import logging
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from command import CONF, plain, run_command
from eval.errors import EvalError
from eval.evaluation import Verdict, evaluate, make_settings
from eval.evidence import Evidence
from eval.evidence_files import EvidenceFiles, read_evidence
from eval.numbers import number
from eval.run import earlier_info, run_files, write_results
from lifelong_slam.config import check_value
from lifelong_slam.errors import ConfigError
from lifelong_slam.overrides import compose_checked

TOPICS = ("topic", "reference_topic")
ARCHIVE = "evo_ape.zip"


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge files and return the exit status."""
    return run_command(judge, arguments, __doc__, "Stopped.", logging.WARNING)


def judge(arguments: Sequence[str]) -> None:
    """Read the files, judge them, show and write what was found.

    Raises:
        ConfigError: an argument is no setting, or there is nothing to judge.
        EvalError: a file is missing or malformed, or the trajectories can't be compared.
    """
    config = compose_checked(CONF, arguments, "evaluate")
    settings = make_settings(plain(config.eval))
    run, out = (_path(config, key) for key in ("run", "out"))
    files = given_files(config, EvidenceFiles() if run is None else run_files(run))
    if files == EvidenceFiles():
        raise ConfigError(
            "there is nothing to judge: give estimate=, map=, grid= or run=; see --help"
        )
    info = {} if run is None else earlier_info(run)
    evidence = read_evidence(files, settings.alignment, settings.max_gap, info)
    if files.estimate and files.reference and evidence.comparison is None:
        raise EvalError(evidence.reasons["comparison"])
    verdicts = evaluate(evidence, settings.metrics)
    show(verdicts, evidence)
    if folder := out or run:
        write(folder, evidence, verdicts)


def given_files(config: DictConfig, files: EvidenceFiles) -> EvidenceFiles:
    """Return the files with those that the command line names in their places."""
    names = [field.name for field in fields(EvidenceFiles) if config.get(field.name) is not None]
    given: dict[str, Any] = {
        name: check_value(name, config[name], str) if name in TOPICS else _path(config, name)
        for name in names
    }
    return replace(files, **given)


def write(folder: Path, evidence: Evidence, verdicts: Sequence[Verdict]) -> None:
    """Write the results, and evo's archive of them where there is a reference."""
    write_results(folder, evidence, verdicts)
    if evidence.comparison is not None:
        from eval.evo_archive import write_evo_archive

        write_evo_archive(folder / ARCHIVE, evidence.comparison)
    print(f"Written: {folder}")


def show(verdicts: Sequence[Verdict], evidence: Evidence) -> None:
    """Print a table of what was found, what makes it doubtful, and what there is no telling of."""
    table = Table(box=None, pad_edge=False)
    for column in ("", "value", "unit", "better"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for verdict in verdicts:
        metric, found = verdict.metric, verdict.measurement
        if found and found.headline is not None:
            table.add_row(
                metric.title, number(found.headline), metric.unit, _BETTER[metric.less_is_better]
            )
    console = Console(markup=False)
    console.print(table)
    warnings = [w for v in verdicts if v.measurement for w in v.measurement.warnings]
    for warning in dict.fromkeys(warnings):
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True, markup=False)
    for verdict in verdicts:
        refused = all(getattr(evidence, need) is not None for need in verdict.metric.needs)
        if verdict.reason and refused:
            line = f"no {verdict.metric.name}: {verdict.reason}"
            console.print(line, style="dim", soft_wrap=True, markup=False)


_BETTER = {True: "less", False: "more", None: ""}


def _path(config: DictConfig, key: str) -> Path | None:
    name = check_value(key, config[key], str | None)
    return None if name is None else Path(name)


if __name__ == "__main__":
    sys.exit(main())
