"""A robot that sees another place than just before is lost; one that goes on, or meets a crowd, is not."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.lidar.frontend import LidarConfig, LidarFrontend
from fcslam.lidar.lost import (
    FEWEST_SCANS,
    MOST_SCANS,
    SETTLED_M,
    LostConfig,
    can_decide,
    drove_on,
    is_doubtful,
    is_lost,
)
from fcslam.lidar.odometry import PREDICTED, WHEELS, OdometryTrust
from fcslam.mission.mission import MissionConfig
from fcslam.records import LaserModel, frozen
from fcslam.robot.frontend import RobotFrontend
from tests.lidar.worlds import LASER, box, drive, recording, ring, ring_drive, room
from tests.robot.kidnapping import put_down

pytestmark = pytest.mark.slow

CONFIG = LostConfig()


def mapped(scans):
    frontend = LidarFrontend("r", LidarConfig())
    for scan in scans:
        frontend.process(scan)
    return frontend


@pytest.fixture(scope="module")
def around():
    poses = ring_drive()
    return recording(poses, poses, ring())


@pytest.fixture(scope="module")
def elsewhere():
    poses = drive([(-3.0, 0.0), (2.0, -2.0), (2.0, 2.0)])
    return recording(poses, poses, room())


def test_looking_leaves_no_trace(around):
    looked, plain = mapped(around[:80]), mapped(around[:80])
    for scan in around[80:90]:
        looked.localize(scan)
    again = [looked.process(scan) for scan in around[80:90]]
    for (pose, _), (other, _) in zip(again, (plain.process(scan) for scan in around[80:90]), strict=True):
        assert np.array_equal(pose.T_keyscan_base, other.T_keyscan_base)
        assert pose.keyscan == other.keyscan


def test_scans_of_one_drive_are_hardly_doubted_and_never_lost(around):
    frontend = mapped(around[:60])
    doubts = []
    for k in range(60, len(around) - 20):
        doubts.append(is_doubtful(frontend.localize(around[k]), frontend, CONFIG))
        if k % 25 == 0:
            assert not is_lost(around[k : k + 15], frontend)
        frontend.process(around[k])
    assert np.mean(doubts) < 0.02


def test_another_place_is_doubted_and_lost(around, elsewhere):
    before = around[:120]
    frontend, there = mapped(before), put_down(before[-1], elsewhere)[1:]
    assert is_doubtful(frontend.localize(there[0]), frontend, CONFIG)
    assert is_lost(there[:20], frontend)


RIGHT = OdometryTrust(0.2, 0.2, 200)


def last_of(scans):
    return {scans[-1].laser.T_base_laser: scans[-1]}


def test_who_drove_on_did_so_by_trusted_odometry_and_by_what_is_seen(around, elsewhere):
    before = around[:60]
    assert drove_on(last_of(before), around[60:62], WHEELS, RIGHT)
    assert not drove_on(last_of(before), around[60:62], WHEELS, OdometryTrust()), "nothing is known about odometry"
    assert not drove_on(last_of(before), put_down(before[-1], elsewhere)[1:9], WHEELS, RIGHT)


def test_one_scan_that_fits_is_enough_for_a_robot_that_drove_over_a_bump(around, elsewhere):
    before = around[:60]
    bump = replace(around[60], ranges_m=put_down(before[-1], elsewhere)[1].ranges_m)
    assert not drove_on(last_of(before), [bump], WHEELS, RIGHT)
    assert drove_on(last_of(before), [bump, around[61]], WHEELS, RIGHT)


@pytest.mark.parametrize(("odometry", "trust"), [(WHEELS, OdometryTrust(1.5, 0.5, 200)), (PREDICTED, RIGHT)], ids=str)
def test_odometry_worse_than_its_model_and_a_prediction_tie_nothing(around, odometry, trust):
    assert not drove_on(last_of(around[:60]), around[60:62], odometry, trust)


@pytest.mark.parametrize("farther_m", [3.0, 0.3])
def test_scans_that_share_little_or_disagree_do_not_show_one_place(around, farther_m):
    changed = np.arange(len(around[60].ranges_m)) % 3 > 0
    now = replace(around[60], ranges_m=frozen(around[60].ranges_m + farther_m * changed, np.float32))
    assert not drove_on(last_of(around[:60]), [now], WHEELS, RIGHT)


def test_another_local_map_is_tied_to_the_past_by_odometry_alone(around):
    frontend = mapped(around[:60])
    past_m = frontend.travel_m
    frontend.begin_local_map()
    assert frontend.settled_m == 0.0
    first, second, *_ = filter(None, (frontend.process(scan)[1] for scan in around[60:75]))
    assert first.travel_m > past_m
    # The motion is that of odometry, and its information that of the model, much less than with a match.
    assert 10.0 * first.odometry.information[0, 0] < second.odometry.information[0, 0]


def test_scans_that_do_not_explain_one_another_tell_nothing(around, elsewhere):
    before = around[:120]
    frontend, there = mapped(before), put_down(before[-1], elsewhere)[1:]
    rng = np.random.default_rng(0)
    torn = [replace(s, ranges_m=frozen(s.ranges_m * rng.uniform(0.5, 1.0, len(s.ranges_m)), np.float32)) for s in there]
    assert not is_lost(torn[:20], frontend)


def test_a_box_that_was_not_there_before_makes_nobody_lost(around):
    poses = ring_drive()
    changed = recording(poses, poses, np.vstack((ring(), box(13.6, 6.0, 14.1, 6.5))))
    before = 120
    frontend = mapped(around[:before])
    assert not is_lost(changed[before : before + 20], frontend)


def test_who_has_hardly_moved_cannot_be_lost(around, elsewhere):
    before = around[:15]
    frontend = mapped(before)
    assert 0.0 < frontend.travel_m < SETTLED_M
    assert not is_doubtful(frontend.localize(put_down(before[-1], elsewhere)[1]), frontend, CONFIG)


def test_it_takes_a_way_and_several_scans_or_very_many(around):
    still = [around[0]] * MOST_SCANS
    far = [replace(around[0], T_odom_base=frozen(np.array([0.3 * k, 0.0, 0.0]))) for k in range(FEWEST_SCANS)]
    assert can_decide(still)
    assert not can_decide(still[:-1])
    assert can_decide(far)
    assert not can_decide(far[:-1])


def test_what_was_not_matched_is_not_doubted(around):
    frontend = mapped(around[:60])
    nothing = replace(around[60], ranges_m=frozen(np.full(LASER.beam_count, LASER.max_range_m), np.float32))
    assert not is_doubtful(frontend.localize(nothing), frontend, CONFIG)


@pytest.mark.parametrize("thickness_m", [0.0, 0.02, 0.1])
def test_a_robot_that_looks_at_a_board_from_its_other_side_is_not_lost(thickness_m):
    """A laser of 3.5 m sees little else than the board when it has driven round its end."""
    short = LaserModel(360, -np.pi, np.pi / 180, 3.5)
    half = 0.5 * thickness_m
    board = box(-4.0, -half, 4.0, half)
    poses = drive([(-3.0, -0.8), (4.8, -0.8), (4.8, 0.8), (-3.0, 0.8)], step_m=0.2, step_rad=0.2)
    scans = recording(poses, poses, np.concatenate((board, box(-7.0, -3.0, 7.0, 3.0))), laser=short)
    robot = RobotFrontend("r", MissionConfig().robot)
    for scan in scans:
        robot.process(scan)
    assert len(robot.tracks) == 1
