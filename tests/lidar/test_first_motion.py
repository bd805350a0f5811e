"""The motion during the first scan of a robot without odometry, by the second scan."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.first_motion import first_sweep
from fcslam.lidar.odometry import PREDICTED
from fcslam.records import Sweep, frozen
from tests.robot import spinning


def pair(begin_s=0.0, scan_s=spinning.SCAN_S):
    return list(islice(spinning.drive(begin_s=begin_s, scan_s=scan_s), 2))


@pytest.mark.parametrize("scan_s", [0.1, 1.0 / 7.0, 0.25])
@pytest.mark.parametrize("begin_s", [1.0, 1.6, 5.5, 6.1])
def test_the_second_scan_shows_the_mean_velocity_during_the_first(begin_s, scan_s):
    sweep = first_sweep(*pair(begin_s, scan_s), PREDICTED)
    poses = spinning.pose_at(np.array((begin_s, begin_s + scan_s)))
    x, y, theta = se2.log(se2.between(*poses)) / scan_s
    assert abs(theta) > 0.5
    assert sweep.velocity == pytest.approx((x, y, theta), abs=0.08)


def test_a_robot_at_rest_has_no_velocity():
    first, _ = pair()
    second = replace(first, stamp=first.stamp + spinning.SCAN_S)
    assert first_sweep(first, second, PREDICTED) == first.sweep
    guess = first.sweep._replace(velocity=(0.3, 0.0, -1.0))
    assert first_sweep(replace(first, sweep=guess), second, PREDICTED) == first.sweep


def test_scans_that_say_nothing_about_each_other_change_nothing():
    first, second = pair(4.4)
    moving = replace(first, sweep=first.sweep._replace(velocity=(0.3, 0.0, -1.0)))
    other = replace(second.laser, T_base_laser=(0.5, 0.0, 0.0))
    for later in (
        replace(second, laser=other),
        replace(second, stamp=first.stamp),
        replace(second, stamp=first.stamp + 1.5),
        replace(second, sweep=None),
    ):
        assert first_sweep(moving, later, PREDICTED) is moving.sweep
    assert first_sweep(replace(first, sweep=None), second, PREDICTED) is None


def test_a_second_scan_of_another_place_shows_no_motion():
    first, second = pair(4.4)
    empty = replace(second, ranges_m=frozen(np.zeros_like(second.ranges_m), np.float32))
    assert first_sweep(first, empty, PREDICTED) == Sweep(first.sweep.first_s, first.sweep.last_s)
