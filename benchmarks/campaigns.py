"""Trajectory errors on the simulated campaigns, beside the published ones and those of other systems.

    python benchmarks/campaigns.py --out DIR [--seeds 0,1,2] [--scenarios A,B,C,D,E,F]
                                   [--sensors bosch,velodyne] [--systems lifelong,kiss_icp,kiss_slam]
                                   [--loop LAPS] [--scans N] [key=value ...]

Further `key=value` arguments are overrides as `scripts/run.py` takes them. A seed is that of the world,
its traffic and the sensors' noise; campaigns that are not in the cache yet are recorded, which takes
about a minute each, and 5 GB for A to F of a seed. `--loop 3` adds three laps of `loop` with the
uncropped VLS-128, `--scenarios ""` leaves out the rest.

Every cell of the tables (scenario, sensor, system, seed) runs in a process of its own, scan by scan from
the bag, as `scripts/run.py` would run it; only the map that is gathered for the peers is left out, on
which no pose depends. Errors are those of eval: the base against the truth, at every scan, aligned by
Kabsch. DIR gets campaigns.md, campaigns.csv and campaigns.json, written anew after every cell.

The published figures are from Pereira, *A Methodology to Evaluate the Performance of LiDAR-based SLAM
Algorithms*, Table 5.1: another car, place and reference, so they say which size of error to expect.
"""

import argparse
import csv
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields
from itertools import islice, product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from throughput import (
    OURS,
    SYSTEMS,
    compose_config,
    facts,
    markdown,
    portable,
    progress_bar,
    system_overrides,
    worker,
)

from eval.errors import EvalError
from eval.files import atomic_path, write_json
from eval.trajectory import compare_trajectories, trajectory_metrics
from lifelong_slam.config import build
from lifelong_slam.errors import ConfigError, LifelongSlamError
from lifelong_slam.geometry import to_quaternion
from lifelong_slam.provenance import describe_run, seed_everything
from lifelong_slam.result import SlamResult
from lifelong_slam.run_folder import trajectory_to_base
from lifelong_slam.scan import NANOSECONDS
from lifelong_slam.sources.cleaning import InputCounts, clean
from lifelong_slam.sources.source import Source
from lifelong_slam.systems.system import System
from lifelong_slam.trajectory import Trajectory

SCENARIOS = ("A", "B", "C", "D", "E", "F")
SENSORS = ("velodyne", "bosch")
LOOP, LOOP_SENSOR = "loop", "vls128"
TITLES = {"mae_m": "MAE", "rmse_m": "RMSE", "max_m": "Maximum error"}
# Pereira, A Methodology to Evaluate the Performance of LiDAR-based SLAM Algorithms, Table 5.1; metres.
PUBLISHED: dict[str, dict[str, tuple[float, ...]]] = {
    "mae_m": {
        "velodyne": (0.25, 0.61, 0.10, 0.09, 1.22, 1.20),
        "bosch": (0.20, 1.25, 0.10, 0.11, 2.07, 0.88),
    },
    "max_m": {
        "velodyne": (0.56, 0.98, 0.31, 0.21, 3.04, 4.66),
        "bosch": (0.66, 2.68, 0.33, 0.22, 5.70, 4.35),
    },
}
_FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Cell:
    """One run: what is mapped, by which system.

    Attributes:
        scenario: a choice of conf/scenario that is simulated.
        sensor: a choice of conf/sensor.
        system: a choice of conf/system.
        seed: of the world.
        laps: of a closed route.
    """

    scenario: str
    sensor: str
    system: str
    seed: int
    laps: int = 1

    def overrides(self) -> list[str]:
        """Return what `scripts/run.py` would be called with."""
        laps = [f"scenario.laps={self.laps}"] if self.laps > 1 else []
        choices = [f"scenario={self.scenario}", f"sensor={self.sensor}"]
        return [*choices, *system_overrides(self.system), f"scenario.seed={self.seed}", *laps]


@dataclass(frozen=True, slots=True)
class Outcome:
    """The errors of a cell in metres, or why there are none.

    Attributes:
        cell: what was run.
        scans: poses that were compared.
        length_m: length of the true path along them.
        mae_m: mean position error.
        rmse_m: root of the mean squared position error.
        max_m: largest position error.
        loops: loop closures in the final graph.
        error: why the cell failed, or nothing.
    """

    cell: Cell
    scans: int = 0
    length_m: float = float("nan")
    mae_m: float = float("nan")
    rmse_m: float = float("nan")
    max_m: float = float("nan")
    loops: int = 0
    error: str = ""

    def row(self) -> dict[str, Any]:
        """Return one flat row for CSV and JSON."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "cell"}
        return asdict(self.cell) | values


class Table:
    """Outcomes by what was run."""

    def __init__(self, outcomes: Sequence[Outcome]) -> None:
        """Index the outcomes."""
        self.outcomes = list(outcomes)
        cells = [outcome.cell for outcome in outcomes]
        self.scenarios = _distinct(cell.scenario for cell in cells)
        self.sensors = _distinct(cell.sensor for cell in cells)
        self.systems = _distinct(cell.system for cell in cells)
        self.seeds = _distinct(cell.seed for cell in cells)
        self._by_cell = {(c.scenario, c.sensor, c.system, c.seed): o for c, o in self._pairs()}

    def values(self, metric: str, scenario: str, sensor: str, system: str) -> list[float]:
        """Return a metric for every seed that there is an outcome for; NaN where it failed."""
        keys = [(scenario, sensor, system, seed) for seed in self.seeds]
        return [getattr(self._by_cell[key], metric) for key in keys if key in self._by_cell]

    def only(self, keep: Callable[[Cell], bool]) -> "Table":
        """Return the table of some of the cells."""
        return Table([outcome for cell, outcome in self._pairs() if keep(cell)])

    def _pairs(self) -> Iterator[tuple[Cell, Outcome]]:
        return ((outcome.cell, outcome) for outcome in self.outcomes)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all cells, print and write the tables, return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parse(arguments)
    try:
        cells = list(_cells(options))
        for overrides in {(*cell.overrides(), *options.overrides) for cell in cells}:
            compose_config(overrides)  # a misspelt choice is said at once, not after hours
        outcomes = _run_all(cells, options, arguments)
    except (LifelongSlamError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"Stopped: {options.out} holds the cells that were done.", file=sys.stderr)
        return 130
    print(report(outcomes, arguments, options.scans))
    return 1 if any(outcome.error for outcome in outcomes) else 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the tables")
    parser.add_argument("--seeds", type=_numbers, default=[0], help="of the worlds: 0,1,2")
    parser.add_argument("--scenarios", type=_names, default=list(SCENARIOS))
    parser.add_argument("--sensors", type=_names, default=list(SENSORS))
    parser.add_argument("--systems", type=_names, default=list(SYSTEMS))
    parser.add_argument("--loop", type=int, default=0, metavar="LAPS", help="add laps of loop")
    parser.add_argument("--scans", type=int, default=None, help="at most, for a quick look")
    parser.add_argument("overrides", nargs="*", help="key=value, as scripts/run.py takes them")
    return parser.parse_args(arguments)


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


def _numbers(text: str) -> list[int]:
    return [int(number) for number in _names(text)]


def _cells(options: argparse.Namespace) -> Iterator[Cell]:
    """Yield the cells in an order that fills the tables row by row, seed by seed."""
    for seed in options.seeds:
        for names in product(options.scenarios, options.sensors, options.systems):
            yield Cell(*names, seed)
        for system in options.systems if options.loop else ():
            yield Cell(LOOP, LOOP_SENSOR, system, seed, options.loop)


def _run_all(
    cells: list[Cell], options: argparse.Namespace, arguments: Sequence[str]
) -> list[Outcome]:
    if not cells:
        raise ConfigError("there is nothing to run: name scenarios, sensors, systems and seeds")
    outcomes: list[Outcome] = []
    with progress_bar() as bar:
        task = bar.add_task("", total=len(cells))
        for cell in cells:
            name = f"{cell.scenario} {cell.sensor} {cell.system}, seed {cell.seed}"
            bar.update(task, description=name)
            outcomes.append(_in_process(cell, options.overrides, options.scans))
            bar.console.print(f"{name}: {_said(outcomes[-1])}", highlight=False)
            bar.advance(task)
            _write(options.out, outcomes, report(outcomes, arguments, options.scans), arguments)
    return outcomes


def _said(outcome: Outcome) -> str:
    return outcome.error or f"MAE {outcome.mae_m:.3f} m, max {outcome.max_m:.3f} m"


def _in_process(cell: Cell, overrides: Sequence[str], count: int | None) -> Outcome:
    """Run a cell in a fresh process, which gives back all its memory."""
    try:
        with worker() as pool:
            return pool.submit(run_cell, cell, overrides, count).result()
    except BrokenProcessPool:
        return Outcome(cell, error="the process died")


def run_cell(cell: Cell, overrides: Sequence[str] = (), count: int | None = None) -> Outcome:
    """Run SLAM on a campaign, recording it if need be, and judge the trajectory.

    Args:
        cell: what to run.
        overrides: more settings.
        count: number of scans to stop after; None takes all.
    """
    os.environ["TERM"] = "dumb"  # recording has a bar of its own, and two don't go together
    try:
        config = compose_config([*cell.overrides(), *overrides])
        seed_everything(config.seed)
        system: System = build(config.system)
        source: Source = build(config.scenario)
        for scan in islice(clean(source, InputCounts()), count):
            system.process(scan)
        return judge(cell, system.finish(), source)
    except (LifelongSlamError, EvalError) as error:
        return Outcome(cell, error=str(error))


def judge(cell: Cell, result: SlamResult, source: Source) -> Outcome:
    """Compare a result with the source's reference.

    Raises:
        ConfigError: the source has no reference.
        EvalError: the two don't match.
    """
    reference = source.reference()
    if reference is None:
        raise ConfigError(f"scenario={cell.scenario} has no reference to compare with")
    estimate = trajectory_to_base(result.trajectory, source.T_base_sensor)
    metrics = trajectory_metrics(compare_trajectories(_to_evo(estimate), _to_evo(reference)))
    return Outcome(
        cell,
        scans=metrics["poses"]["matched"],
        length_m=metrics["reference_path_length_m"],
        mae_m=metrics["mae_m"],
        rmse_m=metrics["rmse_m"],
        max_m=metrics["max_m"],
        loops=sum(edge.kind == "loop" for edge in result.graph.edges),
    )


def _to_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    wxyz = np.roll(to_quaternion(trajectory.poses), 1, axis=1)
    return PoseTrajectory3D(trajectory.positions, wxyz, trajectory.stamps / NANOSECONDS)


def _write(folder: Path, outcomes: list[Outcome], text: str, arguments: Sequence[str]) -> None:
    """Write what there is so far, each file as a whole."""
    rows = [outcome.row() for outcome in outcomes]
    write_json(
        folder / "campaigns.json", {"run": describe_run(portable(arguments), 0), "cells": rows}
    )
    with atomic_path(folder / "campaigns.csv") as path, path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    with atomic_path(folder / "campaigns.md") as path:
        path.write_text(text + "\n")


def report(outcomes: Sequence[Outcome], arguments: Sequence[str], limit: int | None = None) -> str:
    """Return all tables in Markdown, with what they depend on."""
    table = Table(outcomes)
    campaigns = table.only(lambda cell: cell.scenario in SCENARIOS)
    loop = table.only(lambda cell: cell.scenario not in SCENARIOS)
    parts = ["# Trajectory errors on the simulated campaigns", facts("campaigns.py", arguments)]
    if limit is not None:
        parts += [
            f"Only the first {limit} scans of each: not to be held against what is published."
        ]
    if campaigns.outcomes:
        first = campaigns.only(lambda cell: cell.seed == campaigns.seeds[0])
        for metric in PUBLISHED:
            title = f"## {TITLES[metric]} in metres, world seed {first.seeds[0]}"
            parts += [title, published_table(first, metric)]
        parts += [summary(campaigns)]
    if len(campaigns.seeds) > 1:
        seeds = ", ".join(map(str, campaigns.seeds))
        parts += [f"## MAE in metres over world seeds {seeds}: mean (min .. max)"]
        parts += [spread_table(campaigns, "mae_m")]
    if loop.outcomes:
        laps = loop.outcomes[0].cell.laps
        parts += [f"## Errors in metres on {laps} laps of loop, {LOOP_SENSOR}", loop_table(loop)]
    return "\n\n".join(parts)


def published_table(table: Table, metric: str) -> str:
    """Return a table of Table 5.1's shape: a row a scenario, and for each sensor all systems."""
    header = ["Scenario"]
    for sensor in table.sensors:
        header += [f"{sensor}: published", *table.systems]
    rows = []
    for scenario in table.scenarios:
        row = [scenario]
        for sensor in table.sensors:
            row.append(_metres(published(metric, scenario, sensor), digits=2))
            row += [_metres(table.values(metric, scenario, sensor, s)) for s in table.systems]
        rows.append(row)
    return markdown(header, rows)


def published(metric: str, scenario: str, sensor: str) -> list[float]:
    """Return the figure of Table 5.1, if it has one for the sensor."""
    figures = PUBLISHED[metric].get(sensor)
    return [figures[SCENARIOS.index(scenario)]] if figures else []


def spread_table(table: Table, metric: str) -> str:
    """Return a row for each scenario and sensor: mean, least and greatest over the seeds."""
    rows = [
        [scenario, sensor]
        + [_spread(table.values(metric, scenario, sensor, system)) for system in table.systems]
        for scenario, sensor in product(table.scenarios, table.sensors)
    ]
    return markdown(["Scenario", "Sensor", *table.systems], rows)


def loop_table(table: Table) -> str:
    """Return a row for each seed and system, with the number of loop closures."""
    rows = [
        [str(o.cell.seed), o.cell.system, f"{o.length_m:.0f}"]
        + [_metres([getattr(o, metric)]) for metric in TITLES]
        + [str(o.loops)]
        for o in table.outcomes
    ]
    return markdown(["Seed", "System", "Path", *TITLES.values(), "Loop closures"], rows)


def summary(table: Table) -> str:
    """Count the cells, of all seeds, in which our MAE is below what it is measured by."""
    lines = []
    for name, others, factor in (
        ("below the published figure", _published_values, 1.0),
        ("at most half the published figure", _published_values, 0.5),
        *((f"no worse than {s}", _values_of(s), 1.0) for s in table.systems if s != OURS),
    ):
        pairs = list(_beside(table, others))
        if pairs:
            count = sum(ours <= factor * other for ours, other in pairs if ours < np.inf)
            lines.append(f"- MAE of {OURS} {name}: {count} of {len(pairs)} cells")
    return "\n".join(lines)


_Others = Callable[[Table, str, str], list[float]]


def _published_values(table: Table, scenario: str, sensor: str) -> list[float]:
    return published("mae_m", scenario, sensor) * len(table.seeds)


def _values_of(system: str) -> _Others:
    return lambda table, scenario, sensor: table.values("mae_m", scenario, sensor, system)


def _beside(table: Table, others: _Others) -> Iterator[tuple[float, float]]:
    """Yield our MAE beside another in each cell; a cell that failed counts as the worst."""
    for scenario, sensor in product(table.scenarios, table.sensors):
        ours = table.values("mae_m", scenario, sensor, OURS)
        theirs = others(table, scenario, sensor)
        for pair in zip(ours, theirs, strict=False):  # a system that is still to run has none
            mine, other = (np.inf if np.isnan(value) else value for value in pair)
            yield mine, other


def _metres(values: list[float], digits: int = 3) -> str:
    if not values:
        return ""
    return _FAILED if np.isnan(values[0]) else f"{values[0]:.{digits}f}"


def _spread(values: list[float]) -> str:
    """Return mean and range, and how many failed."""
    good = [value for value in values if not np.isnan(value)]
    failed = f" {len(values) - len(good)} {_FAILED}" if len(good) < len(values) else ""
    if not good:
        return failed.strip()
    return f"{fmean(good):.3f} ({min(good):.3f} .. {max(good):.3f}){failed}"


def _distinct(values: Iterator[Any]) -> list[Any]:
    return list(dict.fromkeys(values))


if __name__ == "__main__":
    sys.exit(main())
