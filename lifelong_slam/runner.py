"""Drive a SLAM system over a source, from the first scan to the last or until asked to stop.

Signals: after the first scan, SIGINT or SIGTERM asks the loop to end after the scan at hand, so
that what is mapped so far can be written; the second one aborts at once. Before the first scan
there is nothing to write and the first signal aborts.
"""

import logging
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import ConfigError
from lifelong_slam.resources import ResourceMonitor
from lifelong_slam.result import GraphSnapshot, SlamResult, StageTimes
from lifelong_slam.scan import Scan
from lifelong_slam.sources.cleaning import InputCounts, clean
from lifelong_slam.sources.source import Source
from lifelong_slam.sources.units import check_units
from lifelong_slam.systems.system import System
from lifelong_slam.timeline import Timeline, TimelineRow
from lifelong_slam.viewer import Viewer

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RunRecord:
    """A finished run, whatever the system.

    Attributes:
        result: what the system estimated.
        timeline: one row a scan.
        counts: what was seen, repaired and left out of the input.
        wall_seconds: from asking for the first scan to the system's result, reading included.
        peak_rss_mb: largest resident memory of the process and its children during the run.
        interrupted: the run was asked to stop before the last scan.
        cpu_percent: processor time over wall time, children included; 100 is one core in full use.
        mean_rss_mb: mean over time of the resident memory of the process and its children.
        info: versions, seed, machine and settings that make the run repeatable.
    """

    result: SlamResult
    timeline: Timeline
    counts: dict[str, int]
    wall_seconds: float
    peak_rss_mb: float
    interrupted: bool
    cpu_percent: float = 0.0
    mean_rss_mb: float = 0.0
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def scans_per_second(self) -> float:
        """Scans a second over the whole run, finishing included."""
        return len(self.timeline) / self.wall_seconds if self.wall_seconds > 0 else 0.0


class Observer(Protocol):
    """Whoever wants to know about every scan that was taken in, such as a progress bar."""

    def update(self, scan: Scan, times: StageTimes) -> None:
        """Hear of one more processed scan."""
        ...


@runtime_checkable
class Watchable(Protocol):
    """A system that can be looked into while it runs, for viewers."""

    def watch(self) -> tuple[NDArray[np.float64], GraphSnapshot | None]:
        """Return the latest T_map_sensor, and the graph if it changed since the last call."""
        ...


class ViewerObserver:
    """Shows every processed scan to a viewer."""

    def __init__(self, viewer: Viewer, system: System) -> None:
        """Connect the two.

        Raises:
            ConfigError: the system can't be looked into.
        """
        if not isinstance(system, Watchable):
            name = type(system).__name__
            raise ConfigError(f"{name} has no method watch(): run it with viewer=none")
        self._viewer = viewer
        self._system = system

    def update(self, scan: Scan, times: StageTimes) -> None:
        """Show the scan where the system believes it was taken."""
        T_map_sensor, graph = self._system.watch()
        self._viewer.update(scan.end_stamp, T_map_sensor, scan.points, graph)


class StopRequest:
    """Whether the run has begun, and whether someone asked for its end."""

    def __init__(self) -> None:
        self.running = False
        self.requested = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Take a signal: a polite one while scans flow, else (and the second time) an abort."""
        if not self.running or self.requested:
            raise KeyboardInterrupt
        self.requested = True
        _log.warning(
            "%s: stopping after this scan and writing what is mapped so far; once more aborts",
            signal.Signals(number).name,
        )


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn SIGINT and SIGTERM into a request to stop; other threads than the main one can't."""
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, stop.handle) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


def run(
    source: Source,
    system: System,
    observers: Sequence[Observer] = (),
    stop: StopRequest | None = None,
    info: dict[str, Any] | None = None,
    max_range: float | None = None,
) -> RunRecord:
    """Feed every usable scan of a source to a system.

    Args:
        source: where the scans come from.
        system: what to run on them.
        observers: told of every scan that was processed.
        stop: ends the run early when it is requested.
        info: facts about the run to keep in its record.
        max_range: metres from the sensor up to which the system uses points; None doesn't check
            the units of the scans by it.

    Raises:
        SourceError: the recording can't be read, holds no usable scan, or isn't in metres.
    """
    stop = stop or StopRequest()
    counts = InputCounts()
    scans = clean(source, counts)
    if max_range is not None:
        scans = check_units(scans, max_range)
    with ResourceMonitor() as monitor:
        timeline = _feed(scans, system, observers, stop, monitor)
        interrupted = stop.requested
        _log.info("input: %s", counts.summary())
        result = system.finish()
    return RunRecord(
        result=result,
        timeline=timeline,
        counts=_flat(counts),
        wall_seconds=monitor.wall_seconds,
        peak_rss_mb=monitor.peak_rss_mb,
        interrupted=interrupted,
        cpu_percent=monitor.cpu_percent,
        mean_rss_mb=monitor.mean_rss_mb,
        info=info or {},
    )


def _feed(
    scans: Iterator[Scan],
    system: System,
    observers: Sequence[Observer],
    stop: StopRequest,
    monitor: ResourceMonitor,
) -> Timeline:
    timeline = Timeline()
    for scan in scans:
        stop.running = True
        times = system.process(scan)
        timeline.append(_row(scan, times, monitor))
        for observer in observers:
            observer.update(scan, times)
        if stop.requested:
            break
    return timeline


def _row(scan: Scan, times: StageTimes, monitor: ResourceMonitor) -> TimelineRow:
    return TimelineRow(
        stamp=scan.end_stamp,
        odometry_ms=times.odometry_ms,
        loop_ms=times.loop_ms,
        optimise_ms=times.optimise_ms,
        prune_ms=times.prune_ms,
        vertices=times.vertices,
        edges=times.edges,
        rss_mb=monitor.rss_mb(),
        child_rss_mb=monitor.latest.child_rss_mb,
        cpu_percent=monitor.latest.cpu_percent,
    )


def _flat(counts: InputCounts) -> dict[str, int]:
    skipped = {f"skipped: {reason}": number for reason, number in sorted(counts.skipped.items())}
    return {
        "read": counts.read,
        "used": counts.used,
        **skipped,
        "dropped_points": counts.dropped_points,
        "gaps": counts.gaps,
        "reordered": counts.reordered,
    }
