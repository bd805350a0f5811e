"""Ranges on their grid and as bytes."""

import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from wire.strategies import codes

from fcslam.errors import PacketError
from fcslam.wire.quantisation import (
    MAXIMUM_RANGE_M,
    RANGE_STEP_M,
    dequantise,
    pack_ranges,
    quantise,
    unpack_ranges,
)

EVERY_CODE = np.arange(65536).astype(np.uint16)


def test_every_code_survives_metres():
    assert np.array_equal(quantise(dequantise(EVERY_CODE)), EVERY_CODE)


@given(hnp.arrays(np.float32, st.integers(0, 50), elements=st.floats(width=32)))
def test_quantising_twice_changes_nothing(ranges):
    once = dequantise(quantise(ranges))
    assert np.array_equal(dequantise(quantise(once)), once)


@given(hnp.arrays(np.float32, st.integers(0, 50), elements=st.floats(0, 131, width=32)))
def test_a_range_moves_by_half_a_step_at_most(ranges):
    assert np.abs(dequantise(quantise(ranges)) - ranges.astype(np.float64)).max(initial=0.0) <= 1.01 * RANGE_STEP_M / 2


@pytest.mark.parametrize("missing", [np.nan, np.inf, -np.inf, -1.0, 0.0, 131.08, 1e30])
def test_what_is_no_return_is_zero(missing):
    assert quantise([missing, 1.0]).tolist() == [0, 500]


def test_the_longest_range():
    assert quantise([MAXIMUM_RANGE_M]) == 65535


@given(codes())
def test_packed_ranges_come_back(expected):
    assert np.array_equal(unpack_ranges(pack_ranges(expected)), expected)


@given(codes())
def test_packed_ranges_are_zigzag_varints_of_differences(expected):
    """Read by a plain reader of the published rules."""
    values, value, shift = [], 0, 0
    for byte in zlib.decompress(pack_ranges(expected), wbits=-15):
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            values.append(value // 2 if value % 2 == 0 else -(value + 1) // 2)
            value = shift = 0
    assert np.array_equal(np.cumsum(values), expected)


def deflate(varints: bytes) -> bytes:
    compressor = zlib.compressobj(wbits=-15)
    return compressor.compress(varints) + compressor.flush()


@pytest.mark.parametrize(
    "varints",
    [
        b"\x01",  # -1
        b"\xfe\xff\x07\x02",  # 65535, then 65536
        b"\x80",  # cut off
        b"\x02\x80\x80",
        b"\x82\x00",  # 1 in two bytes
        b"\x80\x80\x80\x01",  # four bytes
        b"\xff\xff\x7f",  # a difference beyond 16 bits
        b"\x00" * 4097,
    ],
)
def test_varints_that_are_no_ranges_are_refused(varints):
    with pytest.raises(PacketError, match="no differences"):
        unpack_ranges(deflate(varints))


def test_varints_at_the_limits_are_read():
    assert unpack_ranges(deflate(b"\xfe\xff\x07\xfd\xff\x07")).tolist() == [65535, 0]
    assert len(unpack_ranges(deflate(b"\x00" * 4096))) == 4096


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "cut off"),
        (deflate(b"\x02" * 50)[:-1], "cut off"),
        (deflate(b"\x02" * 50) + b"x", "followed by more"),
        (b"\xff\xff\xff", "do not inflate"),
        (bytes(12289), "at most 12288"),
    ],
)
def test_broken_compression_is_refused(data, reason):
    with pytest.raises(PacketError, match=reason):
        unpack_ranges(data)


def test_a_decompression_bomb_costs_no_memory():
    bomb = deflate(bytes(10_000_000))
    assert len(bomb) < 12288
    unpack_ranges(pack_ranges(EVERY_CODE[:10]))
    tracemalloc.start()
    try:
        with pytest.raises(PacketError, match="inflate to over"):
            unpack_ranges(bomb)
        assert tracemalloc.get_traced_memory()[1] < 200_000
    finally:
        tracemalloc.stop()


@given(st.binary(max_size=60), st.booleans())
def test_any_bytes_are_ranges_or_refused(data, compress):
    try:
        ranges = unpack_ranges(deflate(data) if compress else data)
    except PacketError:
        return
    assert np.array_equal(unpack_ranges(pack_ranges(ranges)), ranges)
