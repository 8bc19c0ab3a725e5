"""What a scan costs lap after lap of the same block: time, memory and graph of a long run.

    python benchmarks/laps.py [--laps 20] [--systems lifelong,kiss_slam] [--azimuth-step 1.6]
                              [key=value ...]

Further `key=value` arguments are overrides as `scripts/run.py` takes them.

A machine that others share or that grows warm is slower at the end of a quarter of an hour than at its
beginning, by more than what is to be measured. So a yardstick runs along: every ten scans, bare small_gicp
registers the same two scans once again. Times are given as they were and as multiples of the yardstick's
median in the same lap.

Each system has a process of its own, one after the other. Memory is that of the process after each scan, as
in timeline.csv. The maps that `scripts/run.py` gathers for the peers are left out, as in throughput.py.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from statistics import fmean, median

import numpy as np
import small_gicp
from throughput import compose_config, facts, markdown, system_overrides, worker

from lifelong_slam.config import build
from lifelong_slam.errors import LifelongSlamError
from lifelong_slam.provenance import seed_everything
from lifelong_slam.result import StageTimes
from lifelong_slam.runner import run
from lifelong_slam.scan import Scan
from lifelong_slam.sources.cleaning import InputCounts, clean
from lifelong_slam.sources.source import Source

_EVERY = 10  # scans from one reading of the yardstick to the next
_APART = 5  # scans between the two that it registers
_VOXEL = 0.5  # metres, of the yardstick
_EARLY_TIME, _EARLY_MEMORY = 3, 5  # laps that the last one is compared with


@dataclass(frozen=True, slots=True)
class Lap:
    """Means over the scans of one lap.

    Attributes:
        number: from 1.
        scan_ms: time that the system takes for a scan.
        yardstick_ms: median time of the yardstick.
        memory_mb: resident memory.
        least_mb: its least value.
        vertices: in the graph.
    """

    number: int
    scan_ms: float
    yardstick_ms: float
    memory_mb: float
    least_mb: float
    vertices: float

    @property
    def yardsticks(self) -> float:
        """Time for a scan as a multiple of the yardstick."""
        return self.scan_ms / self.yardstick_ms


class Yardstick:
    """Does the same piece of work again and again, and notes how long it takes."""

    def __init__(self, source: Source) -> None:
        """Take two scans of a source to register."""
        first, *_, last = islice(clean(source, InputCounts()), _APART + 1)
        self._target, self._source = (scan.points.astype(np.float64) for scan in (first, last))
        self.readings: list[float] = []  # ms
        self._scans = 0
        self.read()

    def update(self, scan: Scan, times: StageTimes) -> None:
        """Count a scan, and take a reading where one is due. See runner.Observer."""
        self._scans += 1
        if self._scans % _EVERY == 0:
            self.readings.append(self.read())

    def read(self) -> float:
        """Return the time of one registration, ms."""
        start = time.perf_counter()
        small_gicp.align(self._target, self._source, downsampling_resolution=_VOXEL)
        return 1e3 * (time.perf_counter() - start)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark, print its figures as Markdown, return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parse(arguments)
    base = ["scenario=loop", "sensor=vls128", f"scenario.laps={options.laps}"]
    base += [f"scenario.azimuth_steps.vls128={options.azimuth_step}", *options.overrides]
    print(f"## {options.laps} laps\n")
    try:
        for system in options.systems:
            with worker() as process:
                lines = [*base, *system_overrides(system)]
                laps = process.submit(measure, lines, options.laps).result()
            print(f"### {system}\n\n{table(laps)}\n\n{growth(laps)}\n", flush=True)
    except (LifelongSlamError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(facts("laps.py", arguments))
    return 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--laps", type=int, default=20)
    parser.add_argument("--systems", type=lambda text: text.split(","), default=["lifelong"])
    parser.add_argument("--azimuth-step", type=float, default=1.6, help="degrees between columns")
    parser.add_argument("overrides", nargs="*", help="key=value, as scripts/run.py takes them")
    options = parser.parse_args(arguments)
    if options.laps < 1:
        parser.error("--laps must be at least 1")
    return options


def measure(overrides: Sequence[str], count: int) -> list[Lap]:
    """Run a system over all laps."""
    config = compose_config(overrides)
    seed_everything(config.seed)
    system, source = build(config.system), build(config.scenario)
    yardstick = Yardstick(source)
    timeline = list(run(source, system, [yardstick]).timeline)
    laps = []
    for number in range(count):
        rows = timeline[_part(len(timeline), number, count)]
        laps.append(
            Lap(
                number + 1,
                fmean(r.odometry_ms + r.loop_ms + r.optimise_ms + r.prune_ms for r in rows),
                median(yardstick.readings[_part(len(yardstick.readings), number, count)]),
                fmean(row.rss_mb for row in rows),
                min(row.rss_mb for row in rows),
                fmean(row.vertices for row in rows),
            )
        )
    return laps


def _part(length: int, number: int, count: int) -> slice:
    return slice(length * number // count, length * (number + 1) // count)


def table(laps: Sequence[Lap]) -> str:
    """Return a row for each lap."""
    header = ("Lap", "ms a scan", "yardstick, ms", "ratio", "memory, MB", "least, MB", "vertices")
    rows = [
        (
            str(lap.number),
            f"{lap.scan_ms:.1f}",
            f"{lap.yardstick_ms:.1f}",
            f"{lap.yardsticks:.3f}",
            f"{lap.memory_mb:.0f}",
            f"{lap.least_mb:.0f}",
            f"{lap.vertices:.0f}",
        )
        for lap in laps
    ]
    return markdown(header, rows)


def growth(laps: Sequence[Lap]) -> str:
    """Return by what the last lap takes more than an early one."""
    last = laps[-1]
    early, settled = (laps[min(n, len(laps)) - 1] for n in (_EARLY_TIME, _EARLY_MEMORY))
    rows = [
        ("time", f"{early.number}", f"{last.scan_ms / early.scan_ms:.3f}"),
        ("time by the yardstick", f"{early.number}", f"{last.yardsticks / early.yardsticks:.3f}"),
        ("memory", f"{settled.number}", f"{last.memory_mb / settled.memory_mb:.3f}"),
        ("least memory", f"{settled.number}", f"{last.least_mb / settled.least_mb:.3f}"),
    ]
    return markdown((f"Lap {last.number}", "over lap", "ratio"), rows)


if __name__ == "__main__":
    sys.exit(main())
