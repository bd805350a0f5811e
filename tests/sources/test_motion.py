"""The times of the beams and the motion during a scan by odometry, and odometry that is updated too rarely."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.records import Sweep
from fcslam.sources.bags.messages import scan_of
from fcslam.sources.motion import OdometryUpdates, moving_sweep
from tests.ros.ros_messages import scan


@pytest.mark.parametrize(
    ("turn", "beam_s", "sweep"),
    [
        (1.0, 0.001, Sweep(0.0, 0.179)),
        (-1.0, 0.001, Sweep(0.179, 0.0)),  # of a clockwise scanner; beams count counter-clockwise
        *((1.0, nonsense, None) for nonsense in (0.0, -0.001, math.nan, math.inf, 1e-9, 0.1)),
    ],
)
def test_the_stamp_is_the_time_of_the_first_beam_of_the_message(turn, beam_s, sweep):
    message = scan(1.0, np.full(180, 5.0), angle_min=-turn * np.pi / 2, increment=turn * np.pi / 180, beam_s=beam_s)
    found = scan_of(message, 0).sweep
    assert (found and found[2:]) == (sweep and sweep[2:])
    assert (found or ())[:2] == pytest.approx((sweep or ())[:2])


class Reading(NamedTuple):
    stamp: float
    T_odom_base: tuple[float, float, float]


def turning(stamps, start=(1.0, 2.0, 3.0)):
    """A robot that accelerates its turn."""
    return [
        Reading(float(t), tuple(se2.compose(start, (0.4 * t, 0.0, 0.9 * t + 0.5 * 2.0 * t * t)).tolist()))
        for t in stamps
    ]


@pytest.mark.parametrize("times", [(0.0, 0.14), (-0.14, 0.0), (0.14, 0.0), (-0.07, 0.07)])
def test_the_sweep_has_the_motion_of_the_odometry(times):
    readings = turning(np.arange(0.0, 2.0, 0.01))
    sweep = moving_sweep(Sweep(*times), 1.0, readings)
    at = {round(reading.stamp, 3): reading.T_odom_base for reading in readings}
    for t in np.linspace(*sorted(times), 5):
        expected = se2.between(at[1.0], at[round(1.0 + round(float(t), 2), 3)])
        np.testing.assert_allclose(sweep.displacement(round(float(t), 2)), expected, atol=1e-3)


def test_odometry_that_ends_within_the_sweep_goes_on():
    readings = turning(np.arange(0.0, 1.05, 0.01))
    sweep = moving_sweep(Sweep(0.0, 0.2), 1.0, readings)
    assert sweep.displacement(0.2)[2] == pytest.approx(0.2 * 2.9 + 0.5 * 2.0 * 0.04, rel=0.1)


def test_without_readings_the_robot_stands():
    assert moving_sweep(Sweep(0.0, 0.14), 1.0, []) == Sweep(0.0, 0.14)


@pytest.mark.parametrize("period_s", [0.02, 0.05, 0.1])
def test_readings_that_repeat_are_no_updates(period_s):
    """Also those that differ by the rounding of a transform."""
    updates = OdometryUpdates()
    stamps = np.arange(0.0, 3.0, period_s)
    rounding = 1e-15 * np.sin(np.arange(len(stamps)))
    fresh = [
        t for t, e in zip(stamps, rounding, strict=True)
        if updates.is_fresh(float(t), (0.1 * ((t + 1e-9) // 0.2) + e, 0.0, 0.0))
    ]  # fmt: skip
    late = [t for t in fresh if t > 1.2]
    assert len(late) == pytest.approx((3.0 - 1.2) / 0.2, abs=2)


def test_readings_at_rest_and_at_every_update_are_fresh():
    updates = OdometryUpdates()
    moving = [(0.02 * k, (0.01 * k, 0.0, 0.0)) for k in range(50)]
    resting = [(1.0 + 0.02 * k, (0.5, 0.0, 0.0)) for k in range(100)]
    assert all(updates.is_fresh(*reading) for reading in moving + resting)
