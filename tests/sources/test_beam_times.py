"""Times of the beams in bags: by time_increment, clockwise scanners, drivers that state nonsense."""

import numpy as np
import pytest

from fcslam.sources.bags.messages import scan_of
from tests.ros.ros_messages import scan

RANGES = np.full(180, 5.0)


def sweep_of(beam_s=0.0, increment=np.pi / 180):
    first = -np.pi / 2 if increment > 0.0 else np.pi / 2
    message = scan(1.0, RANGES, angle_min=first, increment=increment, beam_s=beam_s)
    return scan_of(message, 0).sweep


def test_the_stamp_is_the_time_of_the_first_beam():
    first_s, last_s, *motion = sweep_of(0.001)
    assert (first_s, last_s) == pytest.approx((0.0, 0.179))
    assert motion == [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]


def test_the_first_beam_of_a_clockwise_scanner_is_the_last_one_counter_clockwise():
    first_s, last_s, *_ = sweep_of(0.001, increment=-np.pi / 180)
    assert (first_s, last_s) == pytest.approx((0.179, 0.0))


@pytest.mark.parametrize("beam_s", [0.0, -0.001, float("nan"), float("inf"), 1e-9, 0.1])
def test_nonsense_is_no_beam_time(beam_s):
    message = scan(1.0, RANGES)
    message.time_increment = beam_s
    assert scan_of(message, 0).sweep is None
