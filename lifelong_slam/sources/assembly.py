"""From decoded clouds to scans: the first few decide how the recording holds its point times."""

from collections.abc import Iterable, Iterator
from itertools import islice

from lifelong_slam.scan import Scan
from lifelong_slam.sources.point_times import PointTimes, Sweep
from lifelong_slam.sources.pointcloud2 import Cloud

_PROBES = 10  # sweeps with returns to decide from
_MOST = 100  # sweeps to hold meanwhile


def assemble(clouds: Iterable[tuple[int, Cloud]], where: str) -> Iterator[Scan]:
    """Yield scans of stamps (ns) and clouds; `where` names the recording in the log.

    Drivers may start with clouds that are empty or have no usable times. Where the first few don't tell
    the encoding, they are passed on without times, and the next few are asked.
    """
    times = PointTimes(where)
    sweeps = (Sweep(stamp, cloud.times, cloud.points) for stamp, cloud in clouds)
    while times.encoding is None and (probes := _probes(sweeps)):
        times.decide(probes)
        while probes:
            yield _scan(probes.pop(0), times)
    for sweep in sweeps:
        yield _scan(sweep, times)


def _probes(sweeps: Iterator[Sweep]) -> list[Sweep]:
    """Take the next sweeps, until enough of them have returns."""
    probes, telling = [], 0
    for sweep in islice(sweeps, _MOST):
        probes.append(sweep)
        telling += bool(sweep.returns.any())
        if telling == _PROBES:
            break
    return probes


def _scan(sweep: Sweep, times: PointTimes) -> Scan:
    return Scan(sweep.stamp, sweep.points, times.offsets(sweep))
