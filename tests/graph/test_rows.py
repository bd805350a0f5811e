"""An array that grows by rows."""

import numpy as np

from fcslam.graph.rows import Rows


def test_rows_keep_what_was_appended_and_waste_little() -> None:
    given = np.random.default_rng(0).normal(size=(1000, 3))
    rows = Rows(given[:7])
    assert [rows.append(row) for row in given[7:]] == list(range(7, 1000))
    assert np.array_equal(rows.values, given)
    assert len(rows) == 1000
    assert rows.values.base is not None
    assert rows.values.base.nbytes <= 1.13 * given.nbytes


def test_rows_are_a_copy_and_keep_their_type() -> None:
    given = np.array([True, False])
    rows = Rows(given)
    given[:] = False
    rows.append(True)
    assert rows.values.tolist() == [True, False, True]
    assert rows.values.dtype == bool


def test_rows_can_be_replaced() -> None:
    rows = Rows(np.zeros((2, 2)))
    rows.values[1] = 5.0
    rows.append((1.0, 2.0))
    assert rows.values.tolist() == [[0.0, 0.0], [5.0, 5.0], [1.0, 2.0]]
