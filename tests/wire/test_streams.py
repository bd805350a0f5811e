"""Ranges, keypoints and descriptors as bytes: what is packed comes back, whatever arrives is read or refused."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fcslam.errors import PacketError
from fcslam.features.detector import OnnxConfig, OnnxDetector
from fcslam.records import PLACE_CHANNELS, Channel
from fcslam.wire.limits import KEYPOINT_AXES
from fcslam.wire.prediction import PROBABILITIES, WEIGHT_UNIT, nearest_before, predictor_of
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

CHANNELS = pytest.mark.parametrize("channel", PLACE_CHANNELS)
POSITIONS = st.integers(-32767, 32767) | st.integers(-20, 20)


@st.composite
def keypoints(draw, axes):
    """In ascending order, sometimes on a grid."""
    grid = draw(st.sampled_from([1, 1, 10, 1000]))
    steps = draw(hnp.arrays(np.int16, (draw(st.integers(0, 40)), axes), elements=POSITIONS))
    points = (steps // grid * grid + draw(st.integers(0, grid - 1)) * (grid <= 10)).clip(-32767, 32767)
    return points[ascending(points)].astype(np.int16)


def scattered(rng, count, axes):
    """Keypoints within 12 m."""
    points = rng.integers(-1200, 1201, (count, axes)).astype(np.int16)
    return points[ascending(points)]


@given(codes())
def test_ranges_come_back(expected):
    packed = pack_ranges(expected)
    assert len(packed) <= 2 * len(expected)
    assert np.array_equal(unpack_ranges(packed, len(expected)), expected)


def test_smooth_ranges_cost_less_than_deflated_differences():
    walls = np.random.default_rng(0).normal(0.0, 7.5, 360) + 2000.0 + 800.0 * np.sin(np.arange(360) / 30.0)
    assert len(pack_ranges(walls.astype(np.uint16))) < 360


@pytest.mark.parametrize("value", [0, 1, 65535])
def test_the_longest_scan_of_one_range(value):
    expected = np.full(4096, value, np.uint16)
    packed = pack_ranges(expected)
    assert len(packed) < 100
    assert np.array_equal(unpack_ranges(packed, 4096), expected)


@pytest.mark.parametrize("axes", [2, 3])
@given(data=st.data())
def test_keypoints_come_back(axes, data):
    expected = data.draw(keypoints(axes))
    packed = pack_keypoints(expected)
    assert len(packed) <= 2 * expected.size
    again = unpack_keypoints(packed, len(expected), axes)
    assert again.dtype == np.int16
    assert np.array_equal(again, expected)


def test_a_grid_is_seen():
    """On a grid of 10 steps a coordinate takes log2(10) bits less."""
    points = np.random.default_rng(0).integers(-120, 121, (400, 2)).astype(np.int16)
    points = points[ascending(points)]
    fine, coarse = len(pack_keypoints(points)), len(pack_keypoints((10 * points + 5).astype(np.int16)))
    assert abs(coarse - fine) <= 6


@pytest.mark.slow
@CHANNELS
@given(data=st.data())
def test_any_descriptors_come_back(channel, data):
    points = data.draw(keypoints(KEYPOINT_AXES[channel]))
    expected = data.draw(hnp.arrays(np.uint8, (len(points), 32), elements=st.integers(0, 255)))
    packed = pack_descriptors(expected, points, channel)
    assert len(packed) <= 32 * len(points)
    assert np.array_equal(unpack_descriptors(packed, points, channel), expected)


@pytest.mark.slow
@CHANNELS
def test_likely_descriptors_come_back_from_less(channel):
    """Descriptors drawn by the predictor itself cost what its probabilities say."""
    rng = np.random.default_rng(0)
    points = scattered(rng, 100, KEYPOINT_AXES[channel])
    bits, worth = drawn(rng, points, channel)
    expected = np.packbits(bits, axis=1)
    packed = pack_descriptors(expected, points, channel)
    assert np.array_equal(unpack_descriptors(packed, points, channel), expected)
    assert abs(8 * len(packed) - worth) <= 16 + 0.002 * bits.size
    assert len(packed) < 32 * 100 * 0.8


def drawn(rng, points, channel):
    """Bits by the formula of the module's docstring in plain floats, and what they are worth."""
    bias, own, neighbour = (table * WEIGHT_UNIT for table in predictor_of(channel))
    bits, worth = np.zeros((len(points), 256), np.int64), 0.0
    for i in range(len(points)):
        distances = ((points[:i].astype(float) - points[i]) ** 2).sum(axis=1)
        z = bias + (2 * bits[np.argmin(distances)] - 1) @ neighbour if i else bias.copy()
        for b in range(256):
            probability = 1.0 / (1.0 + np.exp(-np.clip(z[b] + (2 * bits[i, :b] - 1) @ own[:b, b], -8.0, 8.0)))
            bits[i, b] = rng.random() < probability
            worth -= np.log2(probability if bits[i, b] else 1.0 - probability)
    return bits, worth


def test_the_weights_of_the_camera_fit_the_bundled_network():
    # Weights that were fitted to another network need 26 bytes here; without any it is 32.
    rng = np.random.default_rng(1)
    image = np.full((480, 640), 120, np.uint8)
    for _ in range(60):
        middle, size = (rng.uniform(low, high, 2) for low, high in ((0.0, 560.0), (15.0, 120.0)))
        corners = cv2.boxPoints((middle.tolist(), size.tolist(), float(rng.uniform(0.0, 180.0))))
        cv2.fillPoly(image, [corners.astype(np.int32)], int(rng.integers(20, 236)))
    found = OnnxDetector(OnnxConfig()).detect(image)
    u, v = np.rint(found.keypoints_px).astype(np.int16).T
    points = np.stack((np.full_like(u, 300), -u, -v), axis=1)
    order = ascending(points)
    packed = pack_descriptors(found.descriptors[order], points[order], Channel.CAMERA)
    assert len(packed) < 18 * len(order)


@CHANNELS
def test_a_bit_is_expected_by_earlier_ones_alone(channel):
    predictor = predictor_of(channel)
    assert not np.tril(predictor.own).any()
    assert [table.shape for table in predictor] == [(256,), (256, 256), (256, 256)]
    assert sum(np.abs(table).sum(axis=0 if table.ndim == 2 else None).max() for table in predictor) < 2**15
    assert predictor.neighbour.diagonal().mean() > 0, "neighbours look alike"


def test_probabilities_are_the_same_on_every_machine():
    """None is so near the middle between two whole numbers that another library's exp could round it otherwise."""
    exact = 65536.0 / (1.0 + np.exp(-WEIGHT_UNIT * np.arange(-512, 513)))
    assert np.abs(exact % 1.0 - 0.5).min() > 1e-6
    assert np.array_equal(np.rint(exact), PROBABILITIES)
    assert 1 <= PROBABILITIES.min() <= PROBABILITIES.max() <= 65535


@given(hnp.arrays(np.int64, st.tuples(st.integers(2, 20), st.just(3)), elements=POSITIONS))
def test_the_nearest_keypoint_before(points):
    points, last = points[ascending(points)], len(points) - 1
    distances = ((points[:last] - points[last]) ** 2).sum(axis=1)
    assert nearest_before(points, last) == int(np.argmin(distances))


def unpack_any(what, data, count):
    if what == "ranges":
        return pack_ranges(unpack_ranges(data, count))
    if what == "keypoints":
        return pack_keypoints(unpack_keypoints(data, count, 3))
    points = np.zeros((count, 3), np.int16)
    return pack_descriptors(unpack_descriptors(data, points, Channel.CAMERA), points, Channel.CAMERA)


PLAIN = {"ranges": 2, "keypoints": 6, "descriptors": 32}


@pytest.mark.parametrize("what", PLAIN)
@given(data=st.binary(max_size=60), count=st.integers(1, 12))
def test_any_bytes_are_the_one_stream_of_something_or_refused(what, data, count):
    try:
        again = unpack_any(what, data, count)
    except PacketError:
        return
    assert again == data or len(data) == PLAIN[what] * count


@pytest.mark.parametrize("what", PLAIN)
def test_streams_that_go_on_after_their_end_are_refused(what):
    rng = np.random.default_rng(1)
    points, nowhere = scattered(rng, 50, 3), np.zeros((50, 3), np.int16)
    likely = np.packbits(drawn(rng, nowhere, Channel.CAMERA)[0], axis=1)
    packed = {
        "ranges": pack_ranges(np.arange(1000, 1050).astype(np.uint16)),
        "keypoints": pack_keypoints(points),
        "descriptors": pack_descriptors(likely, nowhere, Channel.CAMERA),
    }[what]
    assert len(packed) < 50 * PLAIN[what] - 3
    for broken in (packed + b"\x00", packed + b"\x00\x00\x01", packed + bytes(3)):
        with pytest.raises(PacketError, match=f"{what}: the stream ends early or has bytes"):
            unpack_any(what, broken, 50)
    with pytest.raises(PacketError, match=f"at most {50 * PLAIN[what]}"):
        unpack_any(what, bytes(50 * PLAIN[what] + 1), 50)


def test_keypoints_in_steps_of_another_grid_are_refused():
    with pytest.raises(PacketError, match="in steps of their grid"):
        unpack_keypoints(b"\x00\x20\x06", 1, 3)


def test_keypoints_out_of_order_are_refused():
    with pytest.raises(PacketError, match="ascending"):
        unpack_keypoints(np.array([[1, 0], [0, 0]], "<i2").tobytes(), 2, 2)


def test_the_smallest_16_bit_number_is_no_keypoint():
    with pytest.raises(PacketError, match="is not a 16-bit number of steps"):
        unpack_keypoints(np.array([[-32768, 0]], "<i2").tobytes(), 1, 2)
