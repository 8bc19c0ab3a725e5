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
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from itertools import islice, product
from pathlib import Path

import numpy as np
from campaign_tables import LOOP, LOOP_SENSOR, Cell, Outcome, report
from evo.core.trajectory import PoseTrajectory3D
from throughput import SYSTEMS, compose_config, portable, progress_bar, worker

from eval.comparison.published import SCENARIOS, SENSORS
from eval.errors import EvalError
from eval.evidence import Evidence
from eval.files import atomic_path, write_json
from eval.metrics.trajectory import PositionError
from eval.trajectory import compare_trajectories
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
    comparison = compare_trajectories(_to_evo(estimate), _to_evo(reference))
    errors = PositionError().measure(Evidence(comparison=comparison)).values
    return Outcome(
        cell,
        scans=comparison.reference.num_poses,
        length_m=comparison.reference.path_length,
        mae_m=errors["mae_m"],
        rmse_m=errors["rmse_m"],
        max_m=errors["max_m"],
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


if __name__ == "__main__":
    sys.exit(main())
