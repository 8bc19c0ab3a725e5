"""The protocol of a source of scans."""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lifelong_slam.scan import Scan
from lifelong_slam.trajectory import Trajectory


class Source(Protocol):
    """A recording that can be read once from start to end.

    A source yields what the recording holds, NaN points and repeated stamps included;
    `lifelong_slam.sources.cleaning.clean` makes that safe for SLAM, in one place for all sources.
    What it can't read at all it leaves out and logs; a source may count that in an attribute
    `unreadable`, which `clean` adds to its own counts.
    """

    def __len__(self) -> int:
        """Return how many scans to expect (an upper bound, for progress bars)."""
        ...

    def __iter__(self) -> Iterator[Scan]:
        """Yield the scans in recorded order.

        Raises:
            SourceError: the recording can't be read as scans.
        """
        ...

    def reference(self) -> Trajectory | None:
        """Return T_reference_base where the recording comes with one, for evaluation only."""
        ...

    @property
    def T_base_sensor(self) -> NDArray[np.float64]:
        """(4, 4) pose of the sensor on the vehicle; the identity where nothing is known."""
        ...


@runtime_checkable
class Surveyed(Protocol):
    """A source that knows the place itself, for evaluation only."""

    @property
    def surface_path(self) -> Path:
        """File of points on the true static surface, in the frame of the reference."""
        ...
