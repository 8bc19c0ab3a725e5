"""Which edges of a pose graph are odometry, where nothing says so.

Odometry makes paths: it leads from each vertex of a trajectory to the next. So the kinds of edges follow
from the order of the vertices, whichever way round the edges are written and in whichever order:

1. Vertices that follow each other by id are a step, if an edge joins them and their ids aren't further
   apart than `_JUMP` times the usual (median) gap. Beyond that another trajectory begins: 99 and 1000,
   or GTSAM's symbols, which have the robot's letter in the highest byte.
2. If these steps lead to less than half of the vertices, ids aren't in the order of the drive. Steps are
   then between vertices that follow each other in the file, if an edge joins them;
3. or, if these lead to less than half as well, along the edges that lengthen a path by a new vertex, in
   the order of the file.

Of several edges between the ends of a step the first is odometry. All other edges are loop closures: a
second measurement between neighbours can be wrong where odometry isn't, for instance one of scan
matching, and as a closure it can be outvoted.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from lifelong_slam.result import EdgeKind

Pair = tuple[int, int]

_JUMP = 10  # times the median gap between ids


def edge_kinds(ends: Sequence[Pair], vertices: Sequence[int]) -> list[EdgeKind]:
    """Return the kinds of edges by the rule above: odometry or loop closure.

    Args:
        ends: source and target of each edge, in the order of the file.
        vertices: all there are, in the order of the file.
    """
    steps = _steps(ends, vertices)
    kinds: list[EdgeKind] = []
    for pair in map(_undirected, ends):
        kinds.append("odometry" if pair in steps else "loop")
        steps.discard(pair)
    return kinds


def _steps(ends: Sequence[Pair], vertices: Sequence[int]) -> set[Pair]:
    """Return the pairs of vertices, the lower first, that odometry joins."""
    joined = {_undirected(pair) for pair in ends}
    reached = {vertex for pair in joined for vertex in pair}
    by_id = _successive_ids(sorted(reached)) & joined
    by_file = {_undirected(pair) for pair in pairwise(v for v in vertices if v in reached)} & joined
    for steps in (by_id, by_file, _growth(ends)):
        if 2 * len(steps) >= len(reached) - 1:
            return steps
    return by_id


def _successive_ids(ids: list[int]) -> set[Pair]:
    """Return the pairs of sorted ids that follow each other without a jump."""
    pairs = list(pairwise(ids))
    gaps = [high - low for low, high in pairs]
    most = _JUMP * np.median(np.array(gaps, dtype=float)) if gaps else 0
    return {pair for pair, gap in zip(pairs, gaps, strict=True) if gap <= most}


def _growth(ends: Sequence[Pair]) -> set[Pair]:
    """Return the pairs that begin a path of two new vertices or lengthen one at its end by a new one."""
    steps: set[Pair] = set()
    neighbours: dict[int, int] = {}  # of each vertex that was seen, along its path
    for pair in ends:
        known = [vertex for vertex in pair if vertex in neighbours]
        if len(known) < 2 and all(neighbours[vertex] < 2 for vertex in known):
            steps.add(_undirected(pair))
            for vertex in pair:
                neighbours[vertex] = neighbours.get(vertex, 0) + 1
        for vertex in pair:
            neighbours.setdefault(vertex, 0)
    return steps


def _undirected(pair: Pair) -> Pair:
    return min(pair), max(pair)
