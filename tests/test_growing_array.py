"""Rows that are appended for as long as a run goes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifelong_slam.growing_array import GrowingArray


@given(st.lists(st.integers(0, 3000), max_size=8))
def test_rows_come_back_as_they_went_in(counts):
    rows = np.random.default_rng(0).normal(size=(sum(counts), 2, 3))
    growing = GrowingArray((2, 3), np.float64)
    for part in np.split(rows, np.cumsum(counts)[:-1]) if counts else []:
        growing.extend(part)
    assert len(growing) == len(rows)
    np.testing.assert_array_equal(growing.rows, rows)


def test_one_by_one_is_the_same():
    growing = GrowingArray((), np.int64)
    for i in range(5000):
        growing.append(10**18 + i)
    assert growing.rows.dtype == np.int64
    assert growing.rows.tolist() == [10**18 + i for i in range(5000)]


def test_what_was_appended_may_change_afterwards():
    growing, row = GrowingArray((3,), np.float64), np.ones(3)
    growing.append(row)
    row[:] = 2
    assert growing.rows.tolist() == [[1, 1, 1]]


def test_a_row_of_another_shape_is_refused():
    growing = GrowingArray((3,), np.float64)
    with pytest.raises(ValueError, match="shape"):
        growing.append(np.ones(4))
    assert len(growing) == 0
