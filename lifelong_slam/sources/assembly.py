"""From decoded clouds to scans: the first few decide how the recording holds its point times."""

from collections.abc import Iterable, Iterator
from itertools import islice

from lifelong_slam.scan import Scan
from lifelong_slam.sources.point_times import PointTimes, Sweep
from lifelong_slam.sources.pointcloud2 import Cloud

_PROBES = 10


def assemble(clouds: Iterable[tuple[int, Cloud]], where: str) -> Iterator[Scan]:
    """Yield scans of stamps (ns) and clouds; `where` names the recording in the log."""
    clouds = iter(clouds)
    times = PointTimes(where)
    probes = list(islice(clouds, _PROBES))
    times.decide([Sweep(stamp, cloud.times, cloud.points) for stamp, cloud in probes])
    while probes:
        yield _scan(*probes.pop(0), times)
    for stamp, cloud in clouds:
        yield _scan(stamp, cloud, times)


def _scan(stamp: int, cloud: Cloud, times: PointTimes) -> Scan:
    return Scan(stamp, cloud.points, times.offsets(Sweep(stamp, cloud.times, cloud.points)))
