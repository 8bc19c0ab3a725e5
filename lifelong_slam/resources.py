"""Samples what a run costs: processor time and memory, those of its child processes included.

As in paper 001, section 2, sampled with psutil: CPU in percent of one core, resident memory in MB.
"""

import threading
import time
from dataclasses import dataclass, replace

import psutil

_MEGABYTE = 1e6
_PERIOD = 0.5
_OVERHEAD = 0.01  # share of a core that sampling may take: it lists all processes of the machine


@dataclass(frozen=True, slots=True)
class ResourceSample:
    """What a run used at one instant.

    Attributes:
        cpu_seconds: processor time so far, of the process and its children.
        rss_mb: resident memory of the process itself.
        child_rss_mb: sum of the resident memories of its children, and theirs.
        cpu_percent: processor time over wall time since the sample before; 100 is one core.
    """

    cpu_seconds: float
    rss_mb: float
    child_rss_mb: float
    cpu_percent: float = 0.0


class ResourceMonitor:
    """Samples the process and its children twice a second in a thread of its own.

    A context manager; the totals are there after its end.

    Attributes:
        latest: the newest sample.
        wall_seconds: time from start to end.
        cpu_percent: processor time over wall time from start to end.
        mean_rss_mb: memory of the process and its children, a mean over time.
        peak_rss_mb: the most of it that was seen, by the samples or by `rss_mb`.
    """

    def __init__(self) -> None:
        self._process = psutil.Process()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._sample_on, daemon=True)
        self._count, self._total_mb = 0, 0.0
        self._start = self._last = time.perf_counter()
        self.peak_rss_mb = 0.0
        self.wall_seconds = 0.0
        self.cpu_percent = 0.0

    def __enter__(self) -> "ResourceMonitor":
        self._start = self._last = time.perf_counter()
        self._note(self._measure())
        self._cpu_seconds = self.latest.cpu_seconds
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._done.set()
        self._thread.join()
        self._sample()
        self.wall_seconds = self._last - self._start
        used = self.latest.cpu_seconds - self._cpu_seconds
        self.cpu_percent = 100.0 * used / self.wall_seconds

    @property
    def mean_rss_mb(self) -> float:  # noqa: D102 - see the class
        return self._total_mb / self._count

    def rss_mb(self) -> float:
        """Return the resident memory of the process now, and remember the peak with it."""
        rss = float(self._process.memory_info().rss) / _MEGABYTE
        self.peak_rss_mb = max(self.peak_rss_mb, rss + self.latest.child_rss_mb)
        return rss

    def _sample_on(self) -> None:
        spent = 0.0
        while not self._done.wait(max(_PERIOD, spent / _OVERHEAD)):
            start = time.thread_time()
            self._sample()
            spent = time.thread_time() - start

    def _sample(self) -> None:
        now, measured = time.perf_counter(), self._measure()
        used = measured.cpu_seconds - self.latest.cpu_seconds
        percent = 100.0 * max(used, 0.0) / (now - self._last)
        self._last = now
        self._note(replace(measured, cpu_percent=percent))

    def _note(self, sample: ResourceSample) -> None:
        self.latest = sample
        self._count += 1
        self._total_mb += sample.rss_mb + sample.child_rss_mb
        self.peak_rss_mb = max(self.peak_rss_mb, sample.rss_mb + sample.child_rss_mb)

    def _measure(self) -> ResourceSample:
        children = [_usage(child) for child in self._process.children(recursive=True)]
        finished = sum(self._process.cpu_times()[2:4])
        cpu = time.process_time() + finished + sum(seconds for seconds, _ in children)
        own = float(self._process.memory_info().rss) / _MEGABYTE
        return ResourceSample(cpu, own, sum((rss for _, rss in children), 0.0))


def _usage(process: psutil.Process) -> tuple[float, float]:
    """Return a child's CPU seconds, those of its own finished children included, and its memory."""
    try:
        return sum(process.cpu_times()[:4]), float(process.memory_info().rss) / _MEGABYTE
    except psutil.NoSuchProcess:  # it ended just now, and counts with its parent
        return 0.0, 0.0
