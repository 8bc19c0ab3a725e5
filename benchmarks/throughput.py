"""Scans a second of our system, end to end, beside bare KISS-ICP and KISS-SLAM on the same scans.

    python benchmarks/throughput.py [--scenario loop] [--sensor vls128] [--laps 2] [--scans 600]
                                    [--repeats 5] [--threads 0] [key=value ...]

Further `key=value` arguments are overrides as `scripts/run.py` takes them. `--threads` is for the peers:
0, their own setting, takes all cores; with 1 all three run on one.

How it is made fair:

- Each system has a process of its own, which reads the scans into memory before the clock starts and
  is warmed up on a few of them. It has to be so: KISS-ICP's threads are set once in a process, by
  whoever comes first. The peers run with their packages' own settings, all cores included; ours as it
  always does, with one thread for registration, so that runs repeat. Voxel size and ranges are the
  sensor's, for all three.
- The systems take turns on otherwise idle cores, forwards in one repeat and backwards in the next,
  with a fresh instance each time. Ratios are taken within a repeat; the median of them is reported.
- Scans are handed over one by one, as in a run. Reading and cleaning them is not counted: it is the
  same for all.
- `finish` counts. Ours is the last optimisation and the whole map. Bare KISS-ICP has no map and
  nothing to finish; KISS-SLAM's is the closure of its last local map and its optimisation of every
  pose. The maps that `scripts/run.py` gathers for the two are not the packages' work: they are left
  out (map_voxel_size=null), which is to the peers' advantage.
"""

import argparse
import gc
import multiprocessing
import os
import shlex
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import fmean, median

from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from lifelong_slam.config import build
from lifelong_slam.errors import LifelongSlamError
from lifelong_slam.overrides import compose_checked
from lifelong_slam.provenance import describe_run, seed_everything
from lifelong_slam.result import StageTimes
from lifelong_slam.scan import Scan
from lifelong_slam.sources.cleaning import InputCounts, clean
from lifelong_slam.systems.system import System

CONF = Path(__file__).resolve().parents[1] / "conf"
OURS = "lifelong"
SYSTEMS = (OURS, "kiss_icp", "kiss_slam")
STAGES = ("odometry", "loop", "optimise", "prune")
_PACKAGES = ("kiss-icp", "kiss-slam", "gtsam", "small-gicp", "map-closures", "numpy")
_WARM_UP = 20

_scans: list[Scan] = []  # of a worker process


@dataclass(frozen=True, slots=True)
class Timing:
    """One system's way through all scans.

    Attributes:
        scans: how many there were.
        process_seconds: wall time from the first scan to the last.
        finish_seconds: wall time of the last optimisation and the map.
        cpu_seconds: processor time of both, all threads together.
        stages: seconds that the system itself counted by stage.
        loops: loop closures in the final graph.
    """

    scans: int
    process_seconds: float
    finish_seconds: float
    cpu_seconds: float
    stages: dict[str, float]
    loops: int

    @property
    def seconds(self) -> float:
        """Wall time from the first scan to the result."""
        return self.process_seconds + self.finish_seconds

    @property
    def rate(self) -> float:
        """Scans a second end to end."""
        return self.scans / self.seconds

    @property
    def process_rate(self) -> float:
        """Scans a second before `finish`."""
        return self.scans / self.process_seconds


@dataclass(frozen=True, slots=True)
class Input:
    """What every worker holds in memory."""

    scans: int
    mean_points: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark, print its figures as Markdown, return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parse(arguments)
    load_average = os.getloadavg()[0]
    try:
        given, timings = _benchmark(options)
    except (LifelongSlamError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    title = f"{options.scenario}, sensor {options.sensor}"
    print(f"## Throughput: {title}\n")
    print(
        f"{given.scans} scans of {given.mean_points:,.0f} points on average, held in memory;"
        f" {options.repeats} repeats in alternating order;"
        f" peers on {options.threads or 'all'} core(s).\n"
    )
    print(rates_table(timings), ratios_table(timings), stages_table(timings[OURS]), sep="\n\n")
    print()
    print(facts("throughput.py", arguments))
    print(f"- load average at the start: {load_average:.1f}")
    return 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenario", default="loop")
    parser.add_argument("--sensor", default="vls128")
    parser.add_argument("--laps", type=int, default=2, help="where the scenario has laps")
    parser.add_argument("--scans", type=int, default=600, help="at most, from the first one on")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=0, help="of the peers; 0: all cores")
    parser.add_argument("overrides", nargs="*", help="key=value, as scripts/run.py takes them")
    options = parser.parse_args(arguments)
    if options.scans < 1 or options.repeats < 1:
        parser.error("--scans and --repeats must be at least 1")
    return options


def compose_config(overrides: Sequence[str]) -> DictConfig:
    """Compose the config that `scripts/run.py` would run with.

    Raises:
        ConfigError: an override fits no setting.
    """
    return compose_checked(CONF, overrides)


def system_overrides(system: str, threads: int = 0) -> list[str]:
    """Choose a system; the peers without the map that is not their own work."""
    settings = ["system.map_voxel_size=null", f"system.threads={threads}"]
    return [f"system={system}", *([] if system == OURS else settings)]


def _benchmark(options: argparse.Namespace) -> tuple[Input, dict[str, list[Timing]]]:
    """Time every system in each repeat, each in a process of its own."""
    base = [f"scenario={options.scenario}", f"sensor={options.sensor}"]
    if "laps" in compose_config([*base, *options.overrides]).scenario:
        base.append(f"scenario.laps={options.laps}")
    base += options.overrides
    lines = {system: [*base, *system_overrides(system, options.threads)] for system in SYSTEMS}
    timings: dict[str, list[Timing]] = {system: [] for system in SYSTEMS}
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar())
        task = bar.add_task("", total=len(SYSTEMS) * (options.repeats + 1))
        workers = {system: stack.enter_context(worker()) for system in SYSTEMS}
        for system in SYSTEMS:
            bar.update(task, description=f"loading for {system}")
            given = workers[system].submit(load, lines[system], options.scans).result()
            bar.advance(task)
        for repeat in range(options.repeats):
            for system in turns(repeat):
                bar.update(task, description=f"repeat {repeat + 1}: {system}")
                timing = workers[system].submit(measure, lines[system]).result()
                timings[system].append(timing)
                bar.console.print(f"repeat {repeat + 1}: {system} {timing.rate:.1f} scans/s")
                bar.advance(task)
    return given, timings


def worker() -> ProcessPoolExecutor:
    """Return a pool of one process that shares nothing with this one, threads least of all."""
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def progress_bar() -> Progress:
    """Return a bar for stderr."""
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    text = TextColumn("{task.description}")
    return Progress(*columns, text, console=Console(stderr=True))


def turns(repeat: int) -> tuple[str, ...]:
    """Return the systems in the order of a repeat: forwards, then backwards."""
    return SYSTEMS if repeat % 2 == 0 else SYSTEMS[::-1]


def load(overrides: Sequence[str], count: int) -> Input:
    """Read this process's scans into memory, and run a few of them through the system."""
    config = compose_config(overrides)
    _scans[:] = islice(clean(build(config.scenario), InputCounts()), count)
    system = _fresh_system(config)
    for scan in _scans[:_WARM_UP]:
        system.process(scan)
    system.finish()
    return Input(len(_scans), fmean(len(scan.points) for scan in _scans))


def measure(overrides: Sequence[str]) -> Timing:
    """Run a fresh instance over this process's scans."""
    system = _fresh_system(compose_config(overrides))
    gc.collect()
    cpu, start = time.process_time(), time.perf_counter()
    rows = [system.process(scan) for scan in _scans]
    processed = time.perf_counter()
    result = system.finish()
    end, cpu_end = time.perf_counter(), time.process_time()
    return Timing(
        scans=len(rows),
        process_seconds=processed - start,
        finish_seconds=end - processed,
        cpu_seconds=cpu_end - cpu,
        stages={stage: _spent(rows, stage) for stage in STAGES},
        loops=sum(edge.kind == "loop" for edge in result.graph.edges),
    )


def _fresh_system(config: DictConfig) -> System:
    seed_everything(config.seed)
    system: System = build(config.system)
    return system


def _spent(rows: list[StageTimes], stage: str) -> float:
    return sum(float(getattr(row, f"{stage}_ms")) for row in rows) / 1e3


def rates_table(timings: dict[str, list[Timing]]) -> str:
    """Return medians over the repeats for each system."""
    header = (
        "System", "Scans/s end to end", "Scans/s before finish", "Finish, s", "Cores busy",
        "Loop closures",
    )  # fmt: skip
    rows = [
        (
            system,
            f"{median(t.rate for t in runs):.1f}",
            f"{median(t.process_rate for t in runs):.1f}",
            f"{median(t.finish_seconds for t in runs):.2f}",
            f"{median(t.cpu_seconds / t.seconds for t in runs):.2f}",
            f"{median(t.loops for t in runs):.0f}",
        )
        for system, runs in timings.items()
    ]
    return markdown(header, rows)


def ratios_table(timings: dict[str, list[Timing]]) -> str:
    """Return the ratios of rates within each repeat: their median and their spread."""
    pairs = ((OURS, "kiss_icp"), (OURS, "kiss_slam"), ("kiss_slam", "kiss_icp"))
    rows = []
    for first, second in pairs:
        both = list(zip(timings[first], timings[second], strict=True))
        ratios = [a.rate / b.rate for a, b in both]
        before = median(a.process_rate / b.process_rate for a, b in both)
        spread = f"{min(ratios):.2f} .. {max(ratios):.2f}"
        rows.append((f"{first} / {second}", f"{median(ratios):.2f}", spread, f"{before:.2f}"))
    header = ("Ratio of scans/s", "End to end, median", "Min .. max", "Before finish, median")
    return markdown(header, rows)


def stages_table(runs: list[Timing]) -> str:
    """Return where our own time goes, in milliseconds a scan, as the mean of all repeats."""
    scans = sum(t.scans for t in runs)
    spent = {stage: sum(t.stages[stage] for t in runs) for stage in STAGES}
    spent["between the stages"] = sum(t.process_seconds for t in runs) - sum(spent.values())
    spent["finish"] = sum(t.finish_seconds for t in runs)
    whole = sum(spent.values())
    rows = [
        (name, f"{1e3 * seconds / scans:.2f}", f"{100 * seconds / whole:.1f} %")
        for name, seconds in [*spent.items(), ("all", whole)]
    ]
    return markdown((f"Stage of {OURS}", "ms a scan", "Share"), rows)


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose columns line up; all but the first are right-aligned."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]

    def line(cells: Sequence[str]) -> str:
        first, *others = zip(cells, widths, strict=True)
        return f"| {' | '.join([first[0].ljust(first[1]), *(c.rjust(w) for c, w in others)])} |"

    return "\n".join(map(line, (header, rule, *rows)))


def facts(script: str, arguments: Sequence[str]) -> str:
    """Return a list of what the figures depend on: command, machine, versions."""
    run = describe_run(portable(arguments), 0)
    machine, packages = run["machine"], run["packages"]
    versions = ", ".join(f"{name} {packages[name]}" for name in _PACKAGES if name in packages)
    lines = (
        f"command: `python benchmarks/{script} {shlex.join(run['command_line'])}`",
        f"machine: {machine['cpu']}, {machine['cores']} cores, {machine['memory_gb']} GB",
        f"versions: Python {run['python']}, {versions}",
        f"commit: {run['git_commit'] or 'unknown'}",
    )
    return "\n".join(f"- {line}" for line in lines)


def portable(arguments: Sequence[str]) -> list[str]:
    """Return a command line without the places where this machine keeps its files."""
    return [Path(a).name if Path(a).is_absolute() else a for a in arguments]


if __name__ == "__main__":
    sys.exit(main())
