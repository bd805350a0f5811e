"""Ranges and keypoints on their grids."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fcslam.wire.quantisation import (
    RANGE_STEP_M,
    dequantise,
    dequantise_keypoints,
    quantise,
    quantise_keypoints,
)

EVERY_CODE = np.arange(65536).astype(np.uint16)


def test_every_code_survives_metres():
    assert np.array_equal(quantise(dequantise(EVERY_CODE)), EVERY_CODE)


@given(hnp.arrays(np.float32, st.integers(0, 50), elements=st.floats(0, 131, width=32)))
def test_a_range_moves_by_half_a_step_at_most(ranges):
    assert np.abs(dequantise(quantise(ranges)) - ranges.astype(np.float64)).max(initial=0.0) <= 1.01 * RANGE_STEP_M / 2


def test_what_is_no_range_is_zero_and_differs_from_no_return():
    assert quantise([np.nan, -np.inf, -1.0, 0.0, 131.07, 1e30, 1.0]).tolist() == [0, 0, 0, 0, 0, 0, 500]
    assert dequantise(quantise([np.inf, np.nan, 1.0])).tolist() == [np.inf, 0.0, 1.0]


@given(hnp.arrays(np.int16, (20, 3), elements=st.integers(-32767, 32767)))
def test_every_keypoint_survives_metres(codes):
    assert np.array_equal(quantise_keypoints(dequantise_keypoints(codes)), codes)
