"""What each scan of a run cost."""

from collections.abc import Iterable, Iterator
from dataclasses import astuple, dataclass, fields

import numpy as np

from lifelong_slam.memory import GrowingArray


@dataclass(frozen=True, slots=True)
class TimelineRow:
    """Where the time of one scan went, and what the run held after it (a row of timeline.csv).

    Memory of the process itself is as after the scan; that of its children, and CPU (100 is one
    core), as sampled last, see `lifelong_slam.resources`.
    """

    stamp: int
    odometry_ms: float
    loop_ms: float
    optimise_ms: float
    prune_ms: float
    vertices: int
    edges: int
    rss_mb: float
    child_rss_mb: float
    cpu_percent: float


COLUMNS = tuple(field.name for field in fields(TimelineRow))
_ROW = np.dtype([(f.name, np.int64 if f.type is int else np.float64) for f in fields(TimelineRow)])


class Timeline:
    """One row a scan, for days if need be: 80 bytes each."""

    def __init__(self, rows: Iterable[TimelineRow] = ()) -> None:
        """Start with some rows."""
        self._rows = GrowingArray(np.zeros(0, _ROW))
        for row in rows:
            self.append(row)

    def append(self, row: TimelineRow) -> None:
        """Add the row of the next scan."""
        self._rows.append(np.array(astuple(row), _ROW))

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[TimelineRow]:
        return (TimelineRow(*row.item()) for row in self._rows.rows)
