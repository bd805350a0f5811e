"""A robot that leaves a closed cabin on another floor begins another session; on the same floor it goes on."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.lidar.lifts import Cabin
from fcslam.records import Channel, LaserModel, LaserScan, frozen
from fcslam.robot.frontend import RobotConfig
from tests import small_fleet
from tests.lidar.worlds import LASER, box, ranges
from tests.robot.lifting import CABIN, DOOR, INSIDE, errors_m, ride

pytestmark = pytest.mark.slow

ROBOT = RobotConfig(channels=(Channel.LIDAR,))
SHORT = LaserModel(240, -np.pi, np.deg2rad(1.5), 8.0, T_base_laser=(0.1, 0.0, 0.0))
NOT_ALL_AROUND = LaserModel(271, -np.deg2rad(135.0), np.deg2rad(1.0), 25.0)
AHEAD = LaserModel(181, -np.deg2rad(90.0), np.deg2rad(1.0), 25.0)


def driven(scans):
    return small_fleet.driven(scans, ROBOT)[0].tracks


@pytest.mark.parametrize(
    ("seeds", "options"),
    [
        ((3, 4), {"laser": SHORT, "closed_s": 5.0}),
        ((7, 8), {"laser": NOT_ALL_AROUND}),
        ((15, 16), {"odometry": False, "closed_s": 20.0}),
        ((11, 12, 11), {}),
    ],
)
def test_each_floor_has_a_session_from_the_opening_of_the_door_on(seeds, options):
    scans, truth, openings = ride(*seeds, **options)
    tracks = driven(scans)
    assert [float(track.stamps[0]) for track in tracks] == pytest.approx([100.0, *openings], abs=1.0)
    first = 0
    for track in tracks:
        assert errors_m(track, truth[first : first + len(track)]).max() < 0.1
        first += len(track)
    assert first == len(scans)
    assert [track.is_new_floor for track in tracks] == [True] * len(seeds)


def test_nobody_knows_the_floor_to_which_a_robot_rode():
    scans, _, _ = ride(1, 2)
    assert [track.floor for track in driven([replace(scans[0], new_floor="1"), *scans[1:]])] == ["1", ""]


@pytest.mark.parametrize(("seed", "laser"), [(1, SHORT), (3, NOT_ALL_AROUND), (9, AHEAD)])
def test_a_robot_that_waits_in_a_closet_goes_on(seed, laser):
    assert len(driven(ride(seed, seed, laser=laser)[0])) == 1


def test_a_lift_that_comes_back_to_its_floor_changes_nothing():
    scans, _, _ = ride(5, 5, 5, closed_s=12.0)
    assert len(driven(scans)) == 1


def test_what_was_put_before_the_door_meanwhile_is_no_other_floor():
    change = lambda walls: np.vstack((walls, box(2.0, 0.4, 2.8, 0.9), box(5.0, -0.9, 5.6, -0.5)))  # noqa: E731
    assert len(driven(ride(1, 1, change=change)[0])) == 1


def test_people_around_a_robot_are_no_cabin():
    scans, _, _ = ride(1, 1)
    rng, crowd = np.random.default_rng(0), []
    for number, scan in enumerate(scans):
        near = frozen(np.minimum(scan.ranges_m, rng.uniform(0.8, 1.5, len(scan.ranges_m))), np.float32)
        crowd.append(replace(scan, ranges_m=near) if 200 <= number < 240 else scan)
    assert len(driven(crowd)) == 1


@pytest.mark.parametrize(("speed_m_s", "rides"), [(0.0, True), (0.3, False)])
def test_whoever_drives_through_a_small_room_rides_nowhere(speed_m_s, rides):
    closed, opened = (ranges(np.array((*INSIDE, 0.0)), walls)[0] for walls in (np.vstack((CABIN, DOOR)), CABIN))
    cabin = Cabin()
    for k in range(26):
        seen = frozen(closed if k < 25 else opened, np.float32)
        cabin.add(LaserScan(0.2 * k, seen, LASER, frozen(np.array((0.2 * k * speed_m_s, 0.0, 0.0)))))
    assert cabin.is_leaving == rides
