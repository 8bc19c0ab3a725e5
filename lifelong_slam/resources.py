"""Samples what a run costs: processor time and memory, those of its child processes included.

As in paper 001, section 2, sampled with psutil: CPU in percent of one core, resident memory in MB.
"""

import ctypes
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import psutil

_MEGABYTE = 1e6
_PERIOD = 0.5
_HELD = 128.0  # MB; taking them again costs 60 ms
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
        self._samples: list[ResourceSample] = []
        self._start = self._last = time.perf_counter()
        self.peak_rss_mb = 0.0
        self.wall_seconds = 0.0
        self.cpu_percent = 0.0

    def __enter__(self) -> "ResourceMonitor":
        self._start = self._last = time.perf_counter()
        self._samples = [self._measure()]
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._done.set()
        self._thread.join()
        self._sample()
        self.wall_seconds = self._last - self._start
        used = self.latest.cpu_seconds - self._samples[0].cpu_seconds
        self.cpu_percent = 100.0 * used / self.wall_seconds

    @property
    def latest(self) -> ResourceSample:  # noqa: D102 - see the class
        return self._samples[-1]

    @property
    def mean_rss_mb(self) -> float:  # noqa: D102 - see the class
        return sum(s.rss_mb + s.child_rss_mb for s in self._samples) / len(self._samples)

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
        sample = ResourceSample(
            measured.cpu_seconds, measured.rss_mb, measured.child_rss_mb, percent
        )
        self._samples.append(sample)
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


class FreeMemory:
    """Gives back to the system what the C library holds for later use, whenever that has become much.

    A scan takes megabytes for a moment and leaves a few small objects behind, between which glibc keeps
    the free pages: the process would seem to grow for ever. Other C libraries see to it themselves.
    """

    def __init__(self, rss_mb: Callable[[], float]) -> None:
        """Watch resident memory, as `ResourceMonitor.rss_mb` measures it."""
        self._rss_mb = rss_mb
        self._least = math.inf

    def release(self) -> None:
        """Give free memory back if the process has grown by `_HELD` since it was least."""
        rss_mb = self._rss_mb()
        self._least = min(self._least, rss_mb)
        if rss_mb > self._least + _HELD:
            _trim()
            # Now, and not after the next scan, which may take much of it again at once.
            self._least = self._rss_mb()


def _trim() -> None:
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
