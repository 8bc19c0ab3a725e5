"""One run of one pruning method over simulated driving, in a process of its own."""

import json
import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from eval.ablation import COLUMNS, Run, position_rmse
from eval.files import atomic_path, write_json
from lifelong_slam.config import build
from lifelong_slam.graph.ablation import Sample, drive
from lifelong_slam.provenance import seed_everything
from lifelong_slam.simulation.building_run import BuildingRun

_CELL = 4.0  # metres, as between the vertices that pruning leaves


@dataclass(frozen=True, slots=True)
class Job:
    """One run of one method; its fields are all that the outcome depends on.

    Attributes:
        method: of conf/pruning.
        pruning: the method's config.
        wrong: share of wrong loop closures.
        seed: of building, route and noise.
        hours: to drive.
        window: how many of the newest keyframes aren't settled.
        budget: seconds for which back-end time is measured; None for all.
        settle_every: keyframes that leave the window at a time.
        sample_minutes: simulated.
    """

    method: str
    pruning: dict[str, Any]
    wrong: float
    seed: int
    hours: float
    window: int
    budget: float | None
    settle_every: int
    sample_minutes: float

    def file(self, out: Path) -> Path:
        """Return where the run's curves are kept; its positions lie beside them, as .npy."""
        return out / "runs" / f"{self.method}_wrong{self.wrong:g}_seed{self.seed}.json"

    def is_done(self, out: Path) -> bool:
        """Tell whether a run with these settings has been finished, and left all curves there are now."""
        file = self.file(out)
        if not file.is_file():
            return False
        stored = json.loads(file.read_text())
        return bool(stored["job"] == asdict(self) and stored["curves"].keys() >= {*COLUMNS})

    def result(self, out: Path) -> Run:
        """Read what the finished run left."""
        file = self.file(out)
        stored = json.loads(file.read_text())["curves"]
        curves = {
            column: np.array(stored[column], dtype=float) for column in COLUMNS
        }  # null is NaN
        positions = np.load(file.with_suffix(".npy"), allow_pickle=False)
        return Run(self.method, self.wrong, self.seed, curves, positions)


def run_all(jobs: Sequence[Job], out: Path, workers: int) -> Iterator[Job]:
    """Do runs, each in a fresh process, whose memory is its own; yield each once it is done."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _ignore_interrupts, max_tasks_per_child=1) as pool:
        futures = {pool.submit(run_one, job, job.file(out)): job for job in jobs}
        try:
            for future in as_completed(futures):
                future.result()
                yield futures[future]
        except KeyboardInterrupt:
            for child in multiprocessing.active_children():
                child.terminate()
            raise


def _ignore_interrupts() -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def run_one(job: Job, file: Path) -> None:
    """Do one run and write its curves and final positions."""
    seed_everything(job.seed)
    run = BuildingRun(job.hours, job.seed, job.wrong)
    samples = drive(
        run,
        build(OmegaConf.create(job.pruning)),
        job.window,
        job.settle_every,
        60 * job.sample_minutes,
        float("inf") if job.budget is None else job.budget,
    )
    truth, table = run.truth[:, :3, 3], []
    cells = run.cells_entered(_CELL)
    for sample in samples:
        positions = sample.positions
        ape = position_rmse(positions, truth[: len(positions)])
        table.append(_row(sample, int(cells[len(positions) - 1]), ape))
    with atomic_path(file.with_suffix(".npy")) as path, path.open("wb") as stream:
        np.save(stream, positions, allow_pickle=False)
    curves = {column: [row[column] for row in table] for column in COLUMNS}
    write_json(file, {"job": asdict(job), "curves": curves})


def _row(sample: Sample, cells: int, ape: float) -> dict[str, float]:
    return {
        "hours": sample.seconds / 3600,
        "cells": cells,
        "vertices": sample.vertices,
        "edges": sample.edges,
        "back_end_s": sample.back_end_seconds,
        "prune_s": sample.prune_seconds,
        "optimise_ms": sample.optimise_ms,
        "memory_mb": sample.memory_mb,
        "ape_m": ape,
    }
