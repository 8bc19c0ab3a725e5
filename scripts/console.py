"""What the scripts show at the terminal: progress, results, and errors of one line."""

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from lifelong_slam.result import StageTimes
    from lifelong_slam.runner import Observer, RunRecord
    from lifelong_slam.scan import Scan

_log = logging.getLogger("run")
_SECONDS_BETWEEN_LINES = 15.0


def fail(error: BaseException) -> None:
    """Say on stderr, in one line, what went wrong."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}"
    print(f"error: {text}", file=sys.stderr)
    _log.debug("where it came from", exc_info=error)


@contextmanager
def scan_progress(total: int) -> Iterator["Observer"]:
    """Yield an observer that shows a bar on a terminal, and now and then a line elsewhere."""
    if not Console(stderr=True).is_interactive:
        yield _Lines(total)
        return
    columns = (TextColumn("Mapping"), BarColumn(), MofNCompleteColumn(), _Rate())
    bar = Progress(
        *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True)
    )
    with bar, _logging_above(bar):
        yield _Bar(bar, total)


class _Bar:
    def __init__(self, bar: Progress, total: int) -> None:
        self._bar = bar
        self._task = bar.add_task("", total=total)

    def update(self, scan: "Scan", times: "StageTimes") -> None:
        """Count one scan."""
        self._bar.advance(self._task)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        """Show scans per second."""
        return Text(f"{task.finished_speed or task.speed or 0.0:.1f} scans/s")


class _Lines:
    def __init__(self, total: int) -> None:
        self._total = total
        self._done = 0
        self._start = self._last = time.monotonic()

    def update(self, scan: "Scan", times: "StageTimes") -> None:
        """Count one scan, and log a line when the last one is a while ago."""
        self._done += 1
        now = time.monotonic()
        if now - self._last > _SECONDS_BETWEEN_LINES:
            rate = self._done / (now - self._start)
            _log.info("%d of %d scans, %.1f scans/s", self._done, self._total, rate)
            self._last = now


@contextmanager
def _logging_above(bar: Progress) -> Iterator[None]:
    """Send log lines through the bar's console, which keeps them apart from the bar."""
    handlers = [
        h
        for h in logging.getLogger().handlers
        if isinstance(h, logging.StreamHandler) and not isinstance(h, logging.FileHandler)
    ]
    streams = [handler.setStream(sys.stderr) for handler in handlers]
    try:
        yield
    finally:
        for handler, stream in zip(handlers, streams, strict=True):
            if stream is not None:
                handler.setStream(stream)


def show_results(record: "RunRecord", metrics: dict[str, Any], folder: Path) -> None:
    """Print a short table of what came out, and where it is."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value in _rows(record, metrics):
        table.add_row(name, value)
    Console(markup=False).print(table)
    print(f"Run folder: {folder}")
    verdict = metrics["run"]["verdict"]
    if verdict["reasons"]:
        print(f"This run is {verdict['status']}:", *verdict["reasons"], sep="\n  ", file=sys.stderr)


def _rows(record: "RunRecord", metrics: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield a line for each figure that there is; the config may have left metrics out."""
    trajectory, points, graph = metrics["trajectory"], metrics["map"], metrics["graph"]
    scans, rate = len(record.timeline), record.scans_per_second
    yield "Scans", f"{scans} in {record.wall_seconds:.1f} s ({rate:.1f} scans/s)"
    if trajectory.get("path_length_m") is not None:
        yield "Path", f"{trajectory['path_length_m']:.1f} m"
    if trajectory.get("mae_m") is not None:
        yield (
            "Trajectory error",
            f"MAE {trajectory['mae_m']:.3f} m, RMSE {trajectory['rmse_m']:.3f} m,"
            f" max {trajectory['max_m']:.3f} m (after alignment)",
        )
    elif "position_error" in trajectory["reasons"]:
        yield "Trajectory error", trajectory["reasons"]["position_error"]
    if graph.get("vertices") is not None:
        yield (
            "Pose graph",
            f"{graph['vertices']} vertices, {graph['edges']} edges: {graph['loop_edges']} loop closures,"
            f" {graph['composed_edges']} composed of several measurements",
        )
    if points.get("points") is not None:
        yield "Map", f"{points['points']:,} points"
    if points.get("mean_distance_m") is not None:
        mean = points["mean_distance_m"]["map_to_reference"]
        yield "Map error", f"{mean:.3f} m mean distance from the true surface"
    yield "Verdict", metrics["run"]["verdict"]["status"]
    yield "Peak memory", f"{record.peak_rss_mb:.0f} MB"
