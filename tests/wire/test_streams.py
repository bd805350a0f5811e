"""Ranges, keypoints and descriptors as bytes: what is packed comes back, whatever arrives is read or refused."""

import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fcslam.errors import PacketError
from fcslam.wire.streams import (
    ascending,
    pack_descriptors,
    pack_keypoints,
    pack_ranges,
    unpack_descriptors,
    unpack_keypoints,
    unpack_ranges,
)
from tests.wire.strategies import codes

POSITIONS = st.integers(-32767, 32767) | st.integers(-20, 20)


@st.composite
def keypoints(draw, axes):
    """In ascending order, sometimes on a grid."""
    grid = draw(st.sampled_from([1, 1, 10, 1000]))
    steps = draw(hnp.arrays(np.int16, (draw(st.integers(0, 40)), axes), elements=POSITIONS))
    points = (steps // grid * grid + draw(st.integers(0, grid - 1)) * (grid <= 10)).clip(-32767, 32767)
    return points[ascending(points)].astype(np.int16)


@given(codes())
def test_ranges_come_back(expected):
    packed = pack_ranges(expected)
    assert len(packed) <= 2 * len(expected)
    assert np.array_equal(unpack_ranges(packed, len(expected)), expected)


@pytest.mark.parametrize("axes", [2, 3])
@given(data=st.data())
def test_keypoints_come_back(axes, data):
    expected = data.draw(keypoints(axes))
    packed = pack_keypoints(expected)
    assert len(packed) <= 2 * expected.size
    again = unpack_keypoints(packed, len(expected), axes)
    assert again.dtype == np.int16
    assert np.array_equal(again, expected)


@pytest.mark.parametrize("count", [0, 1, 8, 40, 300])
@given(seed=st.integers(0, 99))
def test_any_descriptors_come_back(count, seed):
    expected = np.random.default_rng(seed).integers(0, 256, (count, 32), np.uint8)
    packed = pack_descriptors(expected)
    assert len(packed) <= 32 * count
    assert np.array_equal(unpack_descriptors(packed, count), expected)


UNPACK = {
    "ranges": lambda data, count: pack_ranges(unpack_ranges(data, count)),
    "keypoints": lambda data, count: pack_keypoints(unpack_keypoints(data, count, 3)),
    "descriptors": lambda data, count: pack_descriptors(unpack_descriptors(data, count)),
}
PLAIN = {"ranges": 2, "keypoints": 6, "descriptors": 32}


@pytest.mark.parametrize("what", PLAIN)
@given(data=st.binary(max_size=60), count=st.integers(1, 12))
def test_any_bytes_are_a_stream_or_refused(what, data, count):
    try:
        again = UNPACK[what](data, count)
    except PacketError:
        return
    assert UNPACK[what](again, count) == again


@pytest.mark.parametrize("what", PLAIN)
def test_streams_that_end_early_or_go_on_are_refused(what):
    zeros = {
        "ranges": pack_ranges(np.zeros(50, np.uint16)),
        "keypoints": pack_keypoints(np.zeros((50, 3), np.int16)),
        "descriptors": pack_descriptors(np.zeros((50, 32), np.uint8)),
    }[what]
    assert UNPACK[what](zeros, 50) == zeros
    for broken in (zeros + b"\x00", zeros + bytes(3), zeros[:-1], b"", UNPACK[what](b"", 0) + b"\x03\x00"):
        with pytest.raises(PacketError, match=f"{what}: the stream ends early or has bytes"):
            UNPACK[what](broken, 50)
    with pytest.raises(PacketError, match=f"{what}: not a deflated stream"):
        UNPACK[what](b"\xff\xff", 50)
    with pytest.raises(PacketError, match=f"at most {50 * PLAIN[what]}"):
        UNPACK[what](bytes(50 * PLAIN[what] + 1), 50)


@pytest.mark.parametrize("what", PLAIN)
def test_a_stream_of_many_more_numbers_takes_no_memory(what):
    count = 2048
    bomb = zlib.compress(bytes(40_000_000), 9, -15)[: PLAIN[what] * count - 1]
    tracemalloc.start()
    with pytest.raises(PacketError):
        UNPACK[what](bomb, count)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 1_000_000
