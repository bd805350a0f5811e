"""A budget thins places and nothing else, by the recording's own time."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.records import Place, frozen
from fcslam.robot.uplink import BURST_S, FEWEST_DESCRIPTORS, Budget
from fcslam.wire.packets import encode
from tests.robot.fake_cloud import said
from tests.wire.examples import CLOSURE, HELLO, KEYSCAN, LIDAR_PLACE


def place(count):
    rng = np.random.default_rng(count)
    keypoints = frozen(np.round(rng.uniform(-9.0, 9.0, (count, 2)), 2), np.float32)
    return replace(LIDAR_PLACE, keypoints=keypoints, descriptors=frozen(rng.integers(0, 256, (count, 32)), np.uint8))


PLACES = {count: place(count) for count in (10, 60, 200, 400)}


@pytest.fixture(scope="module")
def drive():
    """A minute: a keyscan and a closure every second, a place of 400 every other one."""
    bodies = [HELLO]
    times = [1042.5]
    for second in range(60):
        for body in (KEYSCAN, CLOSURE, *([PLACES[400]] if second % 2 else [])):
            bodies.append(body)
            times.append(1042.5 + second)
    return [said(k, body, time) for k, (body, time) in enumerate(zip(bodies, times, strict=True))]


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.sampled_from([KEYSCAN, CLOSURE, *PLACES.values()]), st.floats(0.0, 4.0)), max_size=30),
    st.floats(10.0, 20000.0),
)
def test_places_never_spend_more_than_there_is(steps, rate):
    budget, time, sent = Budget(rate), 1042.5, 0
    for ordinal, (body, pause) in enumerate(steps):
        time += pause
        packet = said(ordinal, body, time)
        kept = budget.fit([packet])
        sent += sum(len(encode(p)) for p in kept)
        if not isinstance(body, Place):
            assert kept == [packet]
        elif kept:
            first = steps[0][1]
            assert sent <= rate * (time - 1042.5 - first + BURST_S)
            few = kept[0].body
            count = len(few.descriptors)
            assert count == len(body.descriptors) or FEWEST_DESCRIPTORS <= count < len(body.descriptors)
            assert np.array_equal(few.descriptors, body.descriptors[:count])
            assert np.array_equal(few.keypoints, body.keypoints[:count])
            assert replace(kept[0], body=body) == packet


@pytest.mark.slow
def test_what_is_allowed_is_used(drive):
    """Within a descriptor or two of the whole budget, whatever it is, between the chain alone and everything."""
    sizes = {rate: sum(len(encode(p)) for p in Budget(rate).fit(drive)) for rate in (2000.0, 4000.0, 6000.0)}
    for rate, size in sizes.items():
        assert 0.9 * rate * (59.0 + BURST_S) < size <= rate * (59.0 + BURST_S) + 200
    assert Budget(float("inf")).fit(drive) == drive


def test_the_chain_travels_whatever_it_costs(drive):
    budget = Budget(1.0)
    kept = budget.fit(drive)
    assert kept == [packet for packet in drive if not isinstance(packet.body, Place)]
    assert budget.left_out == len(drive) - len(kept)


@pytest.mark.slow
def test_the_same_recording_sends_the_same(drive):
    in_one = Budget(3000.0).fit(drive)
    budget = Budget(3000.0)
    assert [encode(p) for packet in drive for p in budget.fit([packet])] == [encode(p) for p in in_one]
