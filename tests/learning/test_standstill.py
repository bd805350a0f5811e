"""A live robot has time for other work while it stands, and only then."""

from types import SimpleNamespace

import numpy as np
import pytest

from fcslam.learning.federated.learning_process import MOVED_M, STANDS_AFTER_S, Standstill


def told(poses):
    """The calls for a robot on this way, each with the number of poses before it."""
    found, followed = [], []
    standstill = Standstill(
        lambda: found.append(("stop", len(followed))), lambda: found.append(("drive", len(followed)))
    )
    for stamp, T_odom_base in poses:
        standstill.follow(SimpleNamespace(stamp=stamp, T_map_base=np.zeros(3), T_odom_base=T_odom_base))
        followed.append(stamp)
    return found


def standing(begin_s, count, x=0.0, jitter_m=0.0):
    return [(begin_s + k, np.array((x + jitter_m * (k % 2), 0.0, 0.0))) for k in range(count)]


def test_it_stops_after_ten_seconds_and_drives_with_the_first_motion():
    way = [*standing(0.0, 15), *standing(15.0, 15, x=1.0)]
    assert told(way) == [("stop", 10), ("drive", 15), ("stop", 25)]


@pytest.mark.parametrize(
    ("way", "stops"),
    [
        (standing(0.0, 30, jitter_m=0.5 * MOVED_M), 1),
        (standing(0.0, 30, jitter_m=1.5 * MOVED_M), 0),
        ([(0.5 * k, np.array((0.006 * k, 0.0, 0.0))) for k in range(200)], 0),
        ([(float(k), np.array((0.0, 0.0, 0.1 * k))) for k in range(30)], 0),
    ],
    ids=["noise", "a little more", "slow", "turns"],
)
def test_noise_is_no_motion_but_a_slow_or_turning_robot_drives(way, stops):
    assert len(told(way)) == stops


def test_without_odometry_the_pose_in_the_map_counts():
    found = []
    standstill = Standstill(lambda: found.append("stop"), lambda: found.append("drive"))
    for stamp in np.arange(0.0, STANDS_AFTER_S + 1.0):
        standstill.follow(SimpleNamespace(stamp=stamp, T_map_base=np.zeros(3), T_odom_base=None))
    standstill.follow(SimpleNamespace(stamp=20.0, T_map_base=np.array((1.0, 0.0, 0.0)), T_odom_base=None))
    assert found == ["stop", "drive"]


def test_a_clock_that_goes_back_begins_again():
    assert told([*standing(100.0, 8), *standing(0.0, 8)]) == []
