"""The back end alone on a simulated run of many hours: what does a pruning method cost and keep?

There are no scans: keyframes, odometry and loop closures come from `simulation/building_run.py`; the graph,
the optimiser and the pruner are those of the pipeline.
"""

import gc
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf, nan

import numpy as np
import psutil
from numpy.typing import NDArray

from lifelong_slam.graph.pose_graph import PoseGraph
from lifelong_slam.graph.pruning import Pruning
from lifelong_slam.graph.removal import Removal, recover
from lifelong_slam.result import Edge
from lifelong_slam.simulation.building_run import BuildingRun, Step

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Sample:
    """The state of a back end at one moment of a run.

    Attributes:
        seconds: since the start of the run, simulated.
        vertices: in the graph, without the few that have outgrown the window and wait to be settled.
        edges: in use.
        back_end_seconds: wall time spent on graph, optimisation and pruning so far; NaN where it isn't
            measured any more.
        prune_seconds: pruning's share of it.
        optimise_ms: mean wall time of an optimisation since the last sample; NaN likewise.
        memory_mb: by which the process has grown since the start of the run.
        positions: (K, 3) of all keyframes ever taken, in the map.
    """

    seconds: float
    vertices: int
    edges: int
    back_end_seconds: float
    prune_seconds: float
    optimise_ms: float
    memory_mb: float
    positions: Array


class BackEnd:
    """Pose graph and pruning with a stopwatch, and the pose of every keyframe ever taken.

    Attributes:
        spent: wall seconds so far by what they went into: graph, optimise, prune.
        optimisations: so far.
        graph: as it stands.
        removals: of all keyframes that are no longer in it, in the order in which they were made.
    """

    def __init__(self, pruning: Pruning, capacity: int) -> None:
        """Set up.

        Args:
            pruning: the method.
            capacity: keyframes that may come; their ids count from 0.
        """
        self.spent: Counter[str] = Counter()
        self.optimisations = 0
        self.graph = PoseGraph()
        self.removals: list[Removal] = []
        self._pruning = pruning
        self._is_vertex = np.zeros(capacity, dtype=bool)
        self._count = self._settled = 0  # keyframes taken, and those that have left the window

    @property
    def seconds(self) -> float:
        """Wall time spent so far."""
        return float(self.spent.total())

    @property
    def window(self) -> int:
        """Number of the newest keyframes, which haven't been settled."""
        return self._count - self._settled

    @property
    def survivors(self) -> Indices:
        """(V,) keyframes that are still vertices."""
        return np.flatnonzero(self._is_vertex)

    def add(self, step: Step, closures: list[Edge]) -> bool:
        """Take in a keyframe, and tell whether one of its closures is news to the estimate."""
        with self._clock("graph"):
            if step.odometry is None:
                self.graph.add_vertex(step.keyframe, np.eye(4))
            else:
                self.graph.add_odometry(step.odometry)
            news = [self.graph.is_news(edge) for edge in closures]
            for edge in closures:
                self.graph.add_edge(edge)
        self._is_vertex[step.keyframe] = True
        self._count += 1
        return any(news)

    def optimise(self, reconsider: bool = False) -> None:
        """Optimise the graph; see PoseGraph.optimise."""
        with self._clock("optimise"):
            self.graph.optimise(reconsider)
        self.optimisations += 1

    def settle(self, count: int) -> None:
        """Let the `count` oldest keyframes of the window leave it, and prune the graph."""
        with self._clock("prune"):
            leaving = range(self._settled, self._settled + count)
            removals = self._pruning.settle(self.graph, leaving)
        self._settled += count
        self.removals += removals
        self._is_vertex[[removal.vertex for removal in removals]] = False

    def positions(self) -> Array:
        """Return the (K, 3) positions of all keyframes ever taken, in the map."""
        poses = recover(self.graph.poses(), self.removals)
        return np.array([poses[keyframe][:3, 3] for keyframe in range(self._count)])

    @contextmanager
    def _clock(self, what: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.spent[what] += time.perf_counter() - start  # type: ignore[assignment]


def drive(
    run: BuildingRun,
    pruning: Pruning,
    window: int = 40,
    settle_every: int = 10,
    sample_every: float = 900.0,
    budget: float = inf,
) -> Iterator[Sample]:
    """Drive a run, and yield the back end's state now and then and at the end.

    As in the pipeline (slam.py), the graph is optimised when a closure is news to it and whenever a few
    keyframes leave the window, which are then settled; at the end with a vote of all closures.

    Args:
        run: the keyframes and closures.
        pruning: the method.
        window: how many of the newest keyframes aren't settled.
        settle_every: keyframes that leave the window at a time.
        sample_every: seconds of the run between two samples.
        budget: for an unpruned run, wall seconds of back end after which its time isn't measured any
            more, and the graph is optimised just before samples only. Its error is then still that of
            an optimised graph.
    """
    back_end = BackEnd(pruning, len(run))
    resident = _resident_mb()
    taken, optimisations, optimised = 0, 0, 0.0
    for step in run:
        measured = back_end.seconds < budget
        last = step.keyframe == len(run) - 1
        due = last or step.seconds >= (taken + 1) * sample_every
        news = back_end.add(step, run.loops(step, back_end.survivors))
        full = back_end.window >= window + settle_every
        if due or (measured and (news or full)):
            back_end.optimise(reconsider=last)
        if full:
            back_end.settle(settle_every)
        if not due:
            continue
        spent = back_end.spent["optimise"] - optimised
        yield Sample(
            seconds=step.seconds,
            vertices=len(back_end.graph) - max(back_end.window - window, 0),
            edges=back_end.graph.edge_count,
            back_end_seconds=back_end.seconds if measured else nan,
            prune_seconds=back_end.spent["prune"],
            optimise_ms=1e3 * spent / (back_end.optimisations - optimisations) if measured else nan,
            memory_mb=_resident_mb() - resident,
            positions=back_end.positions(),
        )
        taken += 1
        optimisations, optimised = back_end.optimisations, back_end.spent["optimise"]


def _resident_mb() -> float:
    """Return the process's resident memory once what nobody needs any more is given back."""
    gc.collect()
    return float(psutil.Process().memory_info().rss / 1e6)
