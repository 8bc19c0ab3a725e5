"""Compare pruning methods over days of simulated driving: what do they cost, what do they keep?

    python scripts/ablate_pruning.py hours=25 seeds=10
    python scripts/ablate_pruning.py hours=25 seeds=10 methods=geometry wrong=0,0.1

A robot drives through a building of corridors and rooms; there are no scans: odometry and loop closures are
drawn from the errors that our own pipeline shows (lifelong_slam/simulation/building_run.py). Settings:

    hours=25           to drive
    seeds=10           runs of each method: seeds 0, 1, ...
    methods=none,...   of conf/pruning
    wrong=0            shares of loop closures that are wrong, such as 0,0.1
    none_budget=3600   seconds of back-end time for which the unpruned run is measured. Beyond that its time
                       is fitted, and marked so; its graph goes on growing and is optimised at the samples
                       only, so that its error stays that of an optimised graph
    window=40          how many of the newest keyframes aren't settled
    settle_every=10    keyframes that leave the window at a time, after an optimisation (with all methods);
                       a closure that disagrees with the estimate calls for one besides
    sample_minutes=15  simulated, between two points of the curves
    jobs=1             runs at the same time, each in a process of its own; times are honest with 1 only
    out=outputs/ablation
    METHOD.KEY=VALUE   a setting of a method, as in conf/pruning/METHOD.yaml

Files in `out`: ablation.csv (every sample), ablation.json (settings, versions, and for each figure mean,
standard deviation and 95 % confidence interval over the seeds), PNG and SVG of each curve, and in `runs`
what each run left. Ctrl-C keeps the finished runs, and the next command goes on from there; the report
covers all runs in `out` that have the same settings. That the code has changed isn't noticed: take a new
folder then.

Exit status: 0 done; 2 bad settings, said in one line; 130 stopped by Ctrl-C.
"""

import csv
import json
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.box import MARKDOWN
from rich.console import Console
from rich.table import Table

from ablation_jobs import Job, run_all
from command import CONF, plain, run_command
from eval.ablation import LAW, UNPRUNED, Run, rows, summarise
from eval.ablation_plots import PANELS, overview, save, single
from eval.files import atomic_path, plain_cell, write_json
from lifelong_slam.errors import ConfigError
from lifelong_slam.overrides import compose_checked
from lifelong_slam.provenance import describe_run

_WIDTH = 240  # columns of what is printed, enough for no cell to be cut
# What is printed: heading, section and name in the summary, digits.
SHOWN: tuple[tuple[str, str, str, int], ...] = (
    ("vertices", "final", "vertices", 0),
    ("over 1/5", "compared", "vertices", 3),
    ("place over 1/5", "compared", "cells", 3),
    ("edges", "final", "edges", 0),
    ("time s", "final", "back_end_s", 1),
    ("speed-up", "compared", "speed_up", 1),
    ("memory MB", "final", "memory_mb", 0),
    ("APE m", "final", "ape_m", 4),
    ("APE ratio", "compared", "ape", 3),
    ("over right", "compared", "ape_of_wrong", 3),
    ("map error m", "compared", "map_error_m", 4),
)


@dataclass
class Settings:
    """What the command line can say; see the top of this file."""

    hours: float = 25.0
    seeds: int = 10
    methods: str = "none,geometry,decimate,random,chow_liu,dense"
    wrong: str = "0"
    none_budget: float = 3600.0
    window: int = 40
    settle_every: int = 10
    sample_minutes: float = 15.0
    jobs: int = 1
    out: str = "outputs/ablation"


def main(arguments: Sequence[str] | None = None) -> int:
    """Do the runs that aren't there yet, report on all, and return the exit status."""
    return run_command(ablate, arguments, __doc__, "Stopped: the runs that were done are kept.")


def ablate(arguments: Sequence[str]) -> None:
    """Do the runs that aren't there yet, and report on all."""
    plan = parse(arguments)
    todo = [job for job in plan.jobs() if not job.is_done(plan.out)]
    for job in run_all(todo, plan.out, plan.settings.jobs):
        print(f"{job.method}, {job.wrong:g} wrong, seed {job.seed}: done", file=sys.stderr)
        report(plan, arguments)
    show(report(plan, arguments))
    draw(plan)


def parse(arguments: Sequence[str]) -> "Plan":
    """Return what the command line asks for.

    Raises:
        ConfigError: an argument is no setting, or its value has the wrong type.
    """
    overrides = [argument for argument in arguments if "." in argument.partition("=")[0]]
    try:
        given = OmegaConf.from_dotlist([a for a in arguments if a not in overrides])
        settings = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Settings), given))
        assert isinstance(settings, Settings)
        wrong = [float(share) for share in settings.wrong.split(",")]
    except OmegaConfBaseException as error:
        key = getattr(error, "full_key", None) or "settings"
        raise ConfigError(f"{key}: {str(error).splitlines()[0]}; see --help") from error
    except ValueError as error:
        raise ConfigError(f"wrong: {error}; give shares such as wrong=0,0.1") from error
    methods = settings.methods.split(",")
    for override in overrides:
        if override.partition(".")[0] not in methods:
            raise ConfigError(f"{override}: settings go to one of the methods {settings.methods}")
    return Plan(settings, methods, wrong, overrides)


@dataclass(frozen=True)
class Plan:
    """The runs that a command line asks for.

    Attributes:
        settings: of the command line.
        methods: of conf/pruning.
        wrong: shares of wrong loop closures.
        overrides: of the methods' configs, as METHOD.KEY=VALUE.
    """

    settings: Settings
    methods: list[str]
    wrong: list[float]
    overrides: list[str]

    @property
    def out(self) -> Path:
        """Folder for the results."""
        return Path(self.settings.out)

    def jobs(self) -> Iterator[Job]:
        """Yield all runs, seed by seed, so that what is there early can be compared.

        Raises:
            ConfigError: there is no such method, or it has no such setting.
        """
        for seed, wrong, method in product(range(self.settings.seeds), self.wrong, self.methods):
            yield self.job(method, wrong, seed)

    def job(self, method: str, wrong: float, seed: int) -> Job:
        """Return a run with these settings.

        Raises:
            ConfigError: there is no such method, or it has no such setting.
        """
        settings = self.settings
        return Job(
            method,
            pruning_config(
                method, seed, tuple(o for o in self.overrides if o.startswith(f"{method}."))
            ),
            wrong,
            seed,
            settings.hours,
            settings.window,
            settings.none_budget if method == UNPRUNED else None,
            settings.settle_every,
            settings.sample_minutes,
        )

    def finished(self) -> list[Run]:
        """Return all runs in the folder that these settings would repeat, whatever method or seed."""
        runs = []
        for file in sorted((self.out / "runs").glob("*.json")):
            stored = json.loads(file.read_text())["job"]
            job = self.job(stored["method"], stored["wrong"], stored["seed"])
            if job.is_done(self.out):
                runs.append(job.result(self.out))
        return sorted(runs, key=lambda run: (run.wrong, _order(run.method), run.seed))


@cache
def pruning_config(method: str, seed: int, overrides: tuple[str, ...]) -> dict[str, Any]:
    """Return a method's config.

    Raises:
        ConfigError: there is no such method, or it has no such setting.
    """
    # A sensor that sees all around, as the simulation takes it.
    lines = [
        "sensor=generic",
        f"pruning={method}",
        *(o.replace(method, "pruning", 1) for o in overrides),
    ]
    return plain(compose_checked(CONF, lines).pruning)


def report(plan: Plan, arguments: Sequence[str]) -> list[dict[str, Any]]:
    """Write table and summary of all finished runs, and return the summary."""
    runs = plan.finished()
    summary = summarise(runs)
    with atomic_path(plan.out / "ablation.csv") as path, path.open("w", newline="") as file:
        table = rows(runs)
        writer = csv.DictWriter(file, table[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: plain_cell(cell) for key, cell in row.items()} for row in table)
    write_json(
        plan.out / "ablation.json",
        {
            "run": describe_run(arguments, seed=0),
            "settings": asdict(plan.settings),
            "law": LAW,
            "summary": summary,
        },
    )
    return summary


def draw(plan: Plan) -> None:
    """Write the pictures of all finished runs."""
    runs = plan.finished()
    for wrong in {run.wrong for run in runs}:
        alike = [run for run in runs if run.wrong == wrong]
        name = f"wrong{wrong:g}"
        title = f"{plan.settings.hours:g} h in a building, {100 * wrong:g} % wrong loop closures"
        save(overview(alike, title), plan.out / f"{name}_overview")
        for panel in PANELS:
            save(single(alike, panel), plan.out / f"{name}_{panel.column}")


def show(summary: list[dict[str, Any]]) -> None:
    """Print the figures at the end of the runs, as mean and standard deviation over the seeds."""
    table = Table(box=MARKDOWN)
    for heading in ("method", "wrong", "seeds", *(heading for heading, *_ in SHOWN)):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for entry in summary:
        fitted = "*" if entry["fitted"] else ""
        cells = [_cell(entry[section].get(figure), digits) for _, section, figure, digits in SHOWN]
        seeds = str(len(entry["seeds"]))
        table.add_row(entry["method"] + fitted, f"{entry['wrong']:g}", seeds, *cells)
    Console(width=_WIDTH).print(table)
    print("Mean ± standard deviation over the seeds; * time fitted beyond its budget.")


def _cell(values: dict[str, Any] | None, digits: int) -> str:
    if values is None:
        return ""
    deviation = "" if values["std"] is None else f" ± {values['std']:.{digits}f}"
    return f"{values['mean']:.{digits}f}{deviation}"


def _order(method: str) -> int:
    known = Settings.methods.split(",")
    return known.index(method) if method in known else len(known)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())
