"""Which edges count as odometry where a file doesn't say so."""

from itertools import pairwise

import numpy as np
import pytest

from lifelong_slam.graph.topology import edge_kinds

LAP = 20
SYMBOLS = (ord("a") << 56, ord("b") << 56)


def drive(first=0, count=60, spacing=1):
    """Odometry and closures, each to the lap before, of a robot whose ids begin somewhere."""
    ids = [first + spacing * i for i in range(count)]
    odometry = list(pairwise(ids))
    return ids, odometry, [(ids[i], ids[i - LAP]) for i in range(LAP, count, 3)]


def odometry_of(edges, vertices):
    kinds = edge_kinds(edges, vertices)
    assert set(kinds) <= {"odometry", "loop"}
    return [edge for edge, kind in zip(edges, kinds, strict=True) if kind == "odometry"]


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("spacing", [1, 7])
def test_neither_direction_nor_order_nor_spacing_matters(turned, shuffled, spacing):
    ids, odometry, loops = drive(spacing=spacing)
    if turned:
        odometry = [(j, i) for i, j in odometry]
    edges = [*loops, *odometry]
    if shuffled:
        np.random.default_rng(0).shuffle(edges)
        edges = [(int(i), int(j)) for i, j in edges]
    assert sorted(odometry_of(edges, ids)) == sorted(odometry)


@pytest.mark.parametrize("starts", [(0, 1000), (0, 100), SYMBOLS])
def test_a_jump_of_ids_begins_another_trajectory(starts):
    (ids, odometry, loops), (others, more, closures) = (drive(start) for start in starts)
    between = [(ids[-1], others[0]), (ids[0], others[0]), (ids[5], others[7])]
    edges = [*between, *odometry, *more, *loops, *closures]
    assert odometry_of(edges, ids + others) == odometry + more


def test_ids_that_follow_each_other_but_are_not_joined_begin_another_trajectory():
    (ids, odometry, loops), (others, more, closures) = drive(), drive(60)
    edges = [*odometry, *more, (3, 63), *loops, *closures]
    assert odometry_of(edges, ids + others) == odometry + more


def test_of_parallel_edges_the_first_is_odometry():
    ids, odometry, loops = drive()
    edges = [*odometry, *loops, (4, 5), (9, 8)]
    assert odometry_of(edges, ids) == odometry
    assert edge_kinds(edges, ids)[-2:] == ["loop", "loop"]


def test_gaps_that_pruning_leaves_are_no_jumps():
    kept = sorted(np.random.default_rng(1).choice(300, 100, replace=False).tolist())
    chain = list(pairwise(kept))
    missing = [chain.pop(k) for k in (70, 30)]  # ends that pruning joined to others only
    closures = [(kept[i], kept[i - 33]) for i in range(33, 100, 5)]
    found = odometry_of([*chain, *closures], kept)
    assert found == chain
    assert not set(missing) & set(found)


def renamed(seed, *edges):
    """Give the vertices ids that say nothing, and return the renaming with renamed edges."""
    names = np.random.default_rng(seed).permutation(10_000).tolist()
    return names, *([(names[i], names[j]) for i, j in some] for some in edges)


def test_where_ids_say_nothing_the_order_of_the_vertices_does():
    ids, odometry, loops = drive()
    names, odometry, loops = renamed(2, odometry, loops)
    edges = [*loops, *reversed(odometry)]
    assert odometry_of(edges, [names[i] for i in ids]) == odometry[::-1]


def test_where_vertices_say_nothing_either_paths_grow_along_the_edges():
    """Two robots drive at the same time, and each vertex comes with its edges."""
    (ids, odometry, loops), (others, more, closures) = drive(0), drive(100)
    every = sorted([*odometry, *more, *loops, *closures, (103, 3)], key=lambda e: max(e) % 100)
    names, every, odometry, more = renamed(3, every, odometry, more)
    mixed = [names[v] for pair in zip(ids, others, strict=True) for v in pair]
    assert sorted(odometry_of(every, mixed)) == sorted(odometry + more)


def test_a_star_is_no_trajectory():
    edges = [(0, i) for i in range(5, 30, 5)]
    assert odometry_of(edges, [0, *range(5, 30, 5)]) == [(0, 5)]


def test_no_edges_have_no_kinds():
    assert edge_kinds([], []) == []
    assert edge_kinds([], [3, 4]) == []
