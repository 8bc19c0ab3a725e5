"""From decoded clouds to scans: the first few decide how the recording holds its point times."""

import logging
from collections.abc import Iterable, Iterator
from itertools import islice

from lifelong_slam.scan import Scan
from lifelong_slam.sources.point_times import PointTimes, Sweep
from lifelong_slam.sources.pointcloud2 import Cloud

_log = logging.getLogger(__name__)

_PROBES = 10  # sweeps with returns to decide from
_MOST = 100  # sweeps to look for them among


def assemble(clouds: Iterable[tuple[int, Cloud]], where: str, scale: float = 1.0) -> Iterator[Scan]:
    """Yield scans of stamps (ns) and clouds; `where` names the recording in the log.

    `scale` is the length in metres of one unit of the clouds' coordinates.

    Drivers may start with clouds that are empty or have no usable times. Where the first few don't tell
    the encoding, they are passed on without times, and the next few are asked.
    """
    times = PointTimes(where)
    sweeps = _sweeps(clouds, where, scale)
    while times.encoding is None and (probes := _probes(sweeps)):
        times.decide(probes)
        while probes:
            yield _scan(probes.pop(0), times)
    for sweep in sweeps:
        yield _scan(sweep, times)


def _sweeps(clouds: Iterable[tuple[int, Cloud]], where: str, scale: float) -> Iterator[Sweep]:
    said = False
    for stamp, cloud in clouds:
        if cloud.swapped and not said:
            said = True
            _log.warning(
                "%s: points aren't in the byte order that is stated: read in the other", where
            )
        yield Sweep(stamp, cloud.times, cloud.points if scale == 1 else scale * cloud.points)


def _probes(sweeps: Iterator[Sweep]) -> list[Sweep]:
    """Take the next sweeps, until there are enough with returns from the first that tells on."""
    probes, told, count = [], False, 0
    for sweep in islice(sweeps, _MOST):
        probes.append(sweep)
        if sweep.tells and not told:
            told, count = True, 0
        count += bool(sweep.returns.any())
        if count == _PROBES:
            break
    return probes


def _scan(sweep: Sweep, times: PointTimes) -> Scan:
    return Scan(sweep.stamp, sweep.points, times.offsets(sweep))
