"""Announcements reach the compiled code, and change no result."""

import numpy as np
from numba import njit

from fcslam.places.prefetch import prefetch


@njit
def announce_all(table):
    for row in range(table.shape[0]):
        for column in range(table.shape[1]):
            prefetch(table, row, column)


def test_an_announcement_is_left_in_and_reads_and_writes_nothing():
    table = np.arange(12, dtype=np.uint64).reshape(4, 3)
    announce_all(table)
    announce_all(table[:0])
    np.testing.assert_array_equal(table, np.arange(12).reshape(4, 3))
    (code,) = announce_all.inspect_llvm().values()
    assert "call void @llvm.prefetch" in code
