"""A robot sees others of its fleet: it is not matched by them, and nobody hides a wall by a false pose."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fcslam.lidar.occupancy import Casting, OccupancyConfig, cast, classify
from fcslam.live.joint_map import OLDEST_S, JointMap, beams_on_teammates
from fcslam.live.map_poses import CorrectedOdometry
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import Correction, Keyscan, LaserModel, LaserScan, frozen
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from tests.lidar import worlds

LASER = LaserModel(360, -math.pi, math.radians(1.0), 8.0)
RADIUS_M = 0.3
HERE = frozen((-1.0, 0.5, 0.4))


def mate(x, y, age_s=0.2):
    return float(x), float(y), age_s


def scan_at(pose, segments, centre=None):
    """A scan, with a robot at ``centre`` if it is given, and which beams hit that."""
    free = worlds.ranges(pose, segments, LASER)[0]
    ranges = free if centre is None else worlds.with_disc(free, pose, centre, RADIUS_M, LASER)
    return LaserScan(0.0, frozen(ranges, np.float32), LASER, frozen(np.zeros(3))), ranges < free


@pytest.fixture(scope="module")
def joint():
    """The map of the room without any robot in it."""
    poses = worlds.drive([(-3.0, -1.0), (1.5, -2.0), (3.2, 1.0), (-0.5, 2.0)], step_m=0.3)
    config = OccupancyConfig()
    grid = cast([Casting(scan_at(pose, worlds.room())[0].ranges_m, LASER, pose) for pose in poses], config)
    return OccupancyMap(classify(grid), grid.resolution_m, grid.origin_xy)


def on(scan, joint, *teammates, pose=HERE):
    found = beams_on_teammates(scan, pose, scan.T_odom_base, np.array(teammates), joint, 0.35)
    return np.zeros(360, bool) if found is None else found


def test_the_beams_on_a_teammate_are_found_and_no_others(joint):
    scan, hit = scan_at(HERE, worlds.room(), (0.8, 0.2))
    assert hit.sum() > 10
    assert np.array_equal(on(scan, joint, mate(0.8, 0.2), mate(-3.0, 1.0)), hit)
    moved_on = mate(0.8 - 0.4, 0.2, age_s=1.0)
    assert np.array_equal(on(scan, joint, moved_on), hit), "where it may be grows with the age of its pose"
    assert not on(scan, joint, mate(0.8, 0.2, age_s=OLDEST_S + 0.1)).any()


def test_a_robot_that_says_it_is_elsewhere_does_not_hide_where_it_stands(joint):
    scan, hit = scan_at(HERE, worlds.room(), (0.8, 0.2))
    assert not (on(scan, joint, mate(-2.5, -1.0)) & hit).any()


def test_poses_at_the_walls_hide_none_of_them_however_many_there_are(joint):
    scan, _ = scan_at(HERE, worlds.room())
    everywhere = [mate(x, y, age_s=1.9) for x in np.arange(-4, 4.1, 0.4) for y in np.arange(-3, 4, 0.4)]
    assert not on(scan, joint, *everywhere).any()


def test_a_wall_that_the_joint_map_does_not_know_yet_stays(joint):
    known = replace(joint, cells=np.where(np.arange(joint.cells.shape[1]) * 0.05 + joint.origin_xy[0] < 1.0,
                                          joint.cells, np.uint8(Occupancy.UNKNOWN)))  # fmt: skip
    scan, hit = scan_at(HERE, worlds.room(), (1.6, 0.2))
    assert on(scan, joint, mate(1.6, 0.2))[hit].all()
    assert not on(scan, known, mate(1.6, 0.2)).any(), "nobody looked through there"
    assert not on(scan, OccupancyMap(np.zeros((1, 1), np.uint8), 0.05, (0.0, 0.0)), mate(1.6, 0.2)).any()


class Fleet:
    """What the cloud says, in place of a connection."""

    def __init__(self, joint):
        self.joint_map, self.news, self.map_index, self.drawn_s = joint, [], 0, -np.inf
        self._teammates = np.empty((0, 3))

    def hear(self, *teammates):
        self._teammates = np.array(teammates)

    def teammates(self, _map_index):
        return self._teammates


def corridor_map():
    cells = np.full((60, 1200), Occupancy.UNKNOWN, np.uint8)
    cells[10:50], cells[10], cells[49] = Occupancy.FREE, Occupancy.OCCUPIED, Occupancy.OCCUPIED
    return OccupancyMap(cells, 0.05, (-20.0, -1.5))


class Follower:
    """The front end of a robot whose odometry begins where the joint map does."""

    def __init__(self, fleet, radius_m):
        self.shown = JointMap(fleet, OccupancyConfig(robot_radius_m=radius_m))
        self.frontend = RobotFrontend("a", RobotConfig(), mark=self._mark)
        self._pose = None

    def _mark(self, scan):
        return self.shown.mark_teammates(scan, 0, self._pose)

    def add(self, ranges, stamp, odometry):
        scan = LaserScan(stamp, frozen(ranges, np.float32), LASER, frozen(odometry))
        self.shown.add(self.frontend.process(scan))
        self._pose = place(frozen(self.frontend.scan_poses.in_odom(self.frontend.newest.pose)))
        return self._pose.T_map_base


def convoy(robot, fleet):
    """Drive 10 m behind another robot through a corridor; returns the true and the estimated way."""
    rng = np.random.default_rng(1)
    truth = np.stack((np.arange(0.0, 10.0, 0.05), np.zeros(200), np.zeros(200)), axis=-1)
    odometry = worlds.drifting(truth, rng)
    measured = worlds.ranges(truth, worlds.corridor(), LASER, 0.01, rng)
    poses = []
    for k, (pose, empty) in enumerate(zip(truth, measured, strict=True)):
        ahead = pose + np.array((1.0, 0.0, 0.0))
        fleet.hear(mate(*ahead[:2]))
        ranges = worlds.with_disc(empty, pose, ahead[:2], RADIUS_M, LASER)
        poses.append(robot.add(ranges, 0.1 * k, odometry[k]))
    return truth, np.array(poses)


def test_a_robot_that_follows_another_through_a_corridor_knows_that_it_drives():
    """In its own frame, the robot ahead stands still, and the walls say nothing."""
    ends = {}
    for radius_m in (0.35, 0.0):
        fleet = Fleet(corridor_map())
        truth, poses = convoy(Follower(fleet, radius_m), fleet)
        ends[radius_m] = np.hypot(*(poses - truth)[-1, :2])
    assert ends[0.35] < 0.3
    assert ends[0.0] > 3.0, "or the test shows nothing"


def test_a_robot_that_stands_is_no_ghost_in_what_this_robot_saw_last(joint):
    """Until the cloud draws the newest scans, the robot draws them itself."""
    start, standing = np.array((-1.5, 0.0)), np.array((0.3, 0.8))
    poses = worlds.drive([start, (1.5, 0.0)], step_m=0.1)
    shifted = replace(joint, origin_xy=tuple((np.array(joint.origin_xy) - start).tolist()))
    ghosts = {}
    for radius_m in (0.35, 0.0):
        fleet, localizer = Fleet(shifted), CorrectedOdometry(lambda: 0.0)
        fleet.hear(mate(*(standing - start)))
        localizer.correct(Correction("a", 1, 0, frozen(np.zeros(3))))
        robot = Follower(fleet, radius_m)
        for k, pose in enumerate(poses):
            robot.add(scan_at(pose, worlds.room(), standing)[0].ranges_m, 0.1 * k, pose)
        drawn = robot.shown.draw(0, robot.frontend.scan_poses, localizer)
        rows, columns = np.nonzero(drawn.cells == Occupancy.OCCUPIED)
        places = drawn.origin_xy + 0.05 * (np.stack((columns, rows), axis=-1) + 0.5)
        ghosts[radius_m] = np.count_nonzero(np.hypot(*(places - (standing - start)).T) < RADIUS_M + 0.05)
    assert ghosts[0.35] == 0
    assert ghosts[0.0] > 0, "or the test shows nothing"


def test_the_points_stay_in_the_scan_that_is_sent():
    scan, hit = scan_at(HERE, worlds.room(), (0.8, 0.2))
    frontend = RobotFrontend("a", RobotConfig())
    packets = [*frontend.process(replace(scan, on_teammates=hit)), *frontend.finish()]
    (keyscan,) = [packet.body for packet in packets if isinstance(packet.body, Keyscan)]
    assert np.allclose(keyscan.ranges_m[hit], scan.ranges_m[hit], atol=1e-3)
    assert len(frontend.newest.tracked.scan) == np.count_nonzero(~hit)


def place(T_map_base):
    """Where the robot is in map 0, as far as the joint map asks."""
    return SimpleNamespace(T_map_base=np.asarray(T_map_base), map_index=0)


def test_the_first_scan_of_a_session_is_not_placed_by_the_odometry_of_the_one_before(joint):
    scan, hit = scan_at(HERE, worlds.room(), (0.8, 0.2))
    fleet = Fleet(joint)
    fleet.hear(mate(0.8, 0.2))
    shown = JointMap(fleet, OccupancyConfig())
    shown.mark_teammates(replace(scan, T_odom_base=frozen([5.0, 5.0, 1.0])), 0, place(HERE))
    assert shown.mark_teammates(scan, 1, place(HERE)).on_teammates is None
    assert np.array_equal(shown.mark_teammates(scan, 1, place(HERE)).on_teammates, hit)
