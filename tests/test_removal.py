"""What is kept of removed vertices."""

import numpy as np
from map_support import removal

from lifelong_slam.graph.removal import RemovalLog


def test_removals_come_back_as_they_were_made():
    made = [removal(9, 8, 10), removal(8, 7), removal(3, 2, 4, 5, 6, 7, 10), removal(7, 10, 6)]
    log = RemovalLog()
    log.extend(made[:1])
    log.extend([])
    log.extend(made[1:])
    assert len(log) == 4
    for one, kept in zip(made, log, strict=True):
        assert kept.vertex == one.vertex
        np.testing.assert_array_equal(kept.neighbours, one.neighbours)
        np.testing.assert_array_equal(kept.T_neighbour_vertex, one.T_neighbour_vertex)
        np.testing.assert_allclose(kept.gains, one.gains, rtol=1e-7)


def test_a_log_without_removals():
    log = RemovalLog()
    log.extend([])
    assert len(log) == 0
    assert list(log) == []
