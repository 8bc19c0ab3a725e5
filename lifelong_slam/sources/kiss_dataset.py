"""Any data set that `kiss_icp.datasets` has a loader for: MulRan, NCLT, Newer College, Boreas."""

import io
import logging
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.errors import SourceError, did_you_mean
from lifelong_slam.scan import NANOSECONDS, Scan
from lifelong_slam.sources.references import ordered_trajectory
from lifelong_slam.sources.units import check_scale
from lifelong_slam.trajectory import Trajectory, parse_seconds

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

NOMINAL_PERIOD = 0.1


class KissDatasetSource:
    """Scans of a kiss_icp data set; the sensor's frame is the base.

    These loaders print, exit and normalise: what they print goes to the log, what they exit with
    becomes a `SourceError`, and point times from 0 to 1 become seconds by the frame period, with
    the stamp taken as the sweep's start.
    """

    def __init__(
        self,
        loader: str,
        path: str,
        sequence: str | int | None = None,
        topic: str | None = None,
        scale: float = 1.0,
    ) -> None:
        """Open the data set.

        Args:
            loader: name of the loader, a module of `kiss_icp.datasets`.
            path: the data set's folder or file.
            sequence: for loaders of several sequences.
            topic: for loaders of recordings.
            scale: metres in one unit of the loader's coordinates.

        Raises:
            SourceError: no such loader or path, a package it needs is missing, or it refuses.
        """
        self.path = Path(path)
        self.loader = loader
        self._scale = check_scale(scale)
        options = {"sequence": None if sequence is None else str(sequence), "topic": topic}
        self._dataset = self._open({n: v for n, v in options.items() if v is not None})
        self._count = self._guarded(lambda: len(self._dataset))
        self._stamps: dict[int, int] = {}
        self.unreadable = 0

    def __len__(self) -> int:
        """Return the number of scans that the loader announces."""
        return int(self._count)

    def __iter__(self) -> Iterator[Scan]:
        """Yield the scans; those the loader fails on are logged, counted and left out.

        Raises:
            SourceError: the loader failed on every scan.
        """
        self.unreadable = 0
        if self._stamps and hasattr(self._dataset, "reset"):
            self._dataset.reset()
        for index in range(self._count):
            try:
                points, times = self._guarded(lambda i=index: self._dataset[i])  # type: ignore[misc]
            except SourceError as error:
                self.unreadable += 1
                if self.unreadable == 1:
                    _log.warning("scan %d left out: %s", index, error)
                continue
            self._stamps[index] = self._stamp(index)
            points = self._scale * np.asarray(points, dtype=np.float64)
            yield self._scan(index, points, np.asarray(times))
        if self.unreadable:
            _log.warning("%s: %d unreadable scans left out", self.path, self.unreadable)
        if self.unreadable == self._count > 0:
            raise SourceError(f"{self.path}: its loader '{self.loader}' failed on every scan")

    def reference(self) -> Trajectory | None:
        """Return the loader's ground truth, one pose a scan; None without, or if counts differ.

        Loaders that learn their stamps by reading have one only after a pass.
        """
        poses = getattr(self._dataset, "gt_poses", None)
        if poses is None or len(poses) == 0:
            return None
        if len(poses) != self._count:
            _log.warning("%d true poses for %d scans: no reference", len(poses), self._count)
            return None
        stamps = [self._stamps.get(i, self._stamp(i)) for i in range(self._count)]
        return ordered_trajectory(stamps, np.asarray(poses, dtype=np.float64), str(self.path))

    @property
    def T_base_sensor(self) -> NDArray[np.float64]:
        """The (4, 4) identity: loaders don't say where the sensor sits."""
        return np.eye(4)

    def _open(self, options: dict[str, str]) -> Any:
        from kiss_icp.datasets import available_dataloaders, dataset_factory

        known = available_dataloaders()
        if self.loader not in known:
            raise SourceError(
                f"kiss_icp has no loader '{self.loader}'.{did_you_mean(self.loader, known)} "
                f"It has: {', '.join(known)}"
            )
        if not self.path.exists():
            raise SourceError(f"no such file or folder: {self.path}")
        return self._guarded(
            lambda: dataset_factory(dataloader=self.loader, data_dir=self.path, **options)
        )

    def _scan(self, index: int, points: NDArray[np.float64], times: NDArray[Any]) -> Scan:
        times = times.ravel().astype(np.float64)
        if len(times) != len(points) or len(times) == 0:
            if index == 0:
                _log.warning("%s: no point times: sweeps can't be deskewed", self.path)
            return Scan(self._stamps[index], points)
        low, high = float(np.nanmin(times)), float(np.nanmax(times))
        if low < 0.0 or high > 1.0:  # not normalised: kiss_icp does so itself, by their range
            times = (times - low) / max(high - low, np.finfo(float).tiny)
        return Scan(self._stamps[index], points, times * self._period(index))

    def _stamp(self, index: int) -> int:
        """Return a scan's stamp in ns: the loader's, else a nominal one."""
        if hasattr(self._dataset, "get_frames_timestamps"):
            stamps = np.ravel(self._guarded(self._dataset.get_frames_timestamps))
            if index < len(stamps):
                return _nanoseconds(stamps[index])
        file_stamps = getattr(self._dataset, "scan_timestamps", ())  # integer nanoseconds
        if index < len(file_stamps):
            return int(file_stamps[index])
        return round(index * NOMINAL_PERIOD * NANOSECONDS)

    def _period(self, index: int) -> float:
        """Return the seconds from the scan before, if they are plausible for a sweep."""
        before = self._stamps.get(index - 1, None)
        if before is None and index + 1 < self._count:
            return self._plausible(self._stamp(index + 1) - self._stamps[index])
        return self._plausible(self._stamps[index] - (before or 0))

    def _plausible(self, interval: int) -> float:
        seconds = interval / NANOSECONDS
        return seconds if 0.5 * NOMINAL_PERIOD <= seconds <= 2 * NOMINAL_PERIOD else NOMINAL_PERIOD

    def _guarded(self, action: Callable[[], _T]) -> _T:
        """Run a loader's code; what it prints is logged, how it fails becomes a SourceError."""
        printed = io.StringIO()
        try:
            with redirect_stdout(printed):
                return action()
        except ImportError as error:
            raise SourceError(f"loader '{self.loader}' needs a package: {error}") from error
        except (SystemExit, Exception) as error:  # loaders fail in any way
            reason = " ".join(f"{printed.getvalue()} {error}".split()) or type(error).__name__
            raise SourceError(f"loader '{self.loader}' on {self.path}: {reason}") from error
        finally:
            for line in printed.getvalue().splitlines():
                _log.info("%s: %s", self.loader, line)


def _nanoseconds(stamp: Any) -> int:
    if isinstance(stamp, str):
        return parse_seconds(stamp)
    return round(float(stamp) * NANOSECONDS)
