"""Whether a run can be trusted: good, doubtful, or lost. The one place that judges, whatever the system."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from lifelong_slam.graph.initialisation import connected
from lifelong_slam.odometry.tracking import Outage, TrackingLog
from lifelong_slam.result import SlamResult
from lifelong_slam.runner import RunRecord
from lifelong_slam.scan import NANOSECONDS

_LEAST_USED = 0.5  # share of the scans read
_LEAST_IN_RANGE = 0.1  # share of the points
_MOST_PREDICTED = 0.5  # share of the scans
_LONGEST_OUTAGE = 1.0  # s; constant velocity is off by about half a metre then
_MOST_REFUSED = 0.5  # share of the scans


class Status(Enum):
    """How far to trust a run."""

    GOOD = "good"
    DOUBTFUL = "doubtful"  # what was put out may be wrong in parts
    LOST = "lost"  # what was put out doesn't hang together, or is of no use


@dataclass(frozen=True, slots=True)
class Assessment:
    """The verdict on a run.

    Attributes:
        status: the worst that any reason stands for; good without any.
        reasons: what speaks against the run, a sentence each.
    """

    status: Status
    reasons: tuple[str, ...]


def assess(record: RunRecord) -> Assessment:
    """Judge a finished run by its input, what its poses rest on, and what came out."""
    findings = [*_input(record.counts), *_tracking(record.result), *_outcome(record.result)]
    statuses = {status for status, _ in findings}
    status = next((s for s in (Status.LOST, Status.DOUBTFUL) if s in statuses), Status.GOOD)
    return Assessment(status, tuple(reason for _, reason in findings))


def _input(counts: dict[str, int]) -> Iterator[tuple[Status, str]]:
    used, read = counts["used"], counts["read"]
    if used < _LEAST_USED * read:
        yield Status.DOUBTFUL, f"only {used} of {read} scans could be used"


def _tracking(result: SlamResult) -> Iterator[tuple[Status, str]]:
    log = result.tracking
    if log is None:
        return
    yield from _range(log)
    predicted = sum(outage.scans for outage in log.outages)
    if predicted > _MOST_PREDICTED * log.scans:
        yield (
            Status.LOST,
            f"{predicted} of {log.scans} scans could not be registered: most of the path is extrapolated",
        )
    refused = result.counts.get("refinements_refused", 0)
    if refused > _MOST_REFUSED * log.scans:
        yield (
            Status.DOUBTFUL,
            f"point matches and surfaces disagree in {refused} of {log.scans} scans",
        )
    joined = len(connected(result.graph)) == 1
    for outage in log.outages:
        yield from _outage(outage, joined)


def _range(log: TrackingLog) -> Iterator[tuple[Status, str]]:
    if log.points_in_range < _LEAST_IN_RANGE * log.points:
        share = 100 * log.points_in_range / log.points
        yield (
            Status.DOUBTFUL,
            f"only {share:.1f} % of the points are within the sensor's range: see sensor.min_range,"
            " sensor.max_range, and whether coordinates are in metres",
        )


def _outage(outage: Outage, joined: bool) -> Iterator[tuple[Status, str]]:
    at = f"at {outage.begin / NANOSECONDS:.3f} s"
    if outage.parted and not joined:
        yield (
            Status.LOST,
            f"lost {at}: what was driven after that isn't connected with what was before",
        )
    elif outage.parted:
        yield Status.DOUBTFUL, f"lost {at}, and found again by loop closures"
    elif outage.seconds >= _LONGEST_OUTAGE:
        yield (
            Status.DOUBTFUL,
            f"no scan could be registered for {outage.seconds:.1f} s {at}: the motion is extrapolated",
        )


def _outcome(result: SlamResult) -> Iterator[tuple[Status, str]]:
    if len(result.map_points) == 0:
        yield Status.LOST, "the map is empty"
    for doubt in result.doubts:
        yield Status.DOUBTFUL, doubt
