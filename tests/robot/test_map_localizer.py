"""A robot in a finished map: found where it is, followed, lost when carried away, never placed in another building."""

from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.frozen_map import frozen_map
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.fusion import fuse
from fcslam.maps.occupancy_map import Occupancy, parse_map
from fcslam.mission.localization import FinishedMap, run_localization
from fcslam.mission.mission import MissionConfig
from fcslam.records import Keyscan, KeyscanId
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.map_localizer import MapLocalizer
from tests import small_fleet
from tests.lidar.worlds import Recording
from tests.robot.kidnapping import put_down

pytestmark = pytest.mark.slow

RIGHT_M, RIGHT_RAD = 0.1, 0.03
FRAGMENT_M, GAP_M = 4.0, 10.0


def map_of(robots):
    """The true map of what these robots saw, in the coordinates of the building."""
    keyscans, poses = [], []
    for robot in robots:
        for number, scan in enumerate(robot.scans()):
            if number % 3 == 0:
                keyscans.append(Keyscan(KeyscanId(robot.name, number), scan.stamp, scan.ranges_m))
                poses.append(robot.T_building_base[number])
    return fuse(keyscans, np.array(poses), {robot.name: robot.lasers for robot in robots}, OccupancyConfig())


@pytest.fixture(scope="module")
def fleet():
    return small_fleet.draw(3, 30.0)


@pytest.fixture(scope="module")
def building(fleet):
    """The map that two of the three robots made."""
    return map_of(fleet.robots[:2])


def errors(poses, robot):
    """Distance (m) and turn (rad) of the believed poses from the truth."""
    believed = poses.believed()
    off = se2.between(small_fleet.truth_at(robot, believed.stamps), believed.T_map_base)
    return np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])


def localized(scans, occupancy, name="robot", **options):
    return run_localization(Recording(list(scans), name), FinishedMap(occupancy), MissionConfig(), **options)


def test_a_robot_is_found_without_an_initial_pose(fleet, building):
    robot = fleet.robots[2]
    run = localized(robot.scans(), building)
    poses = run.localized["robot"]
    distance_m, turn_rad = errors(poses, robot)
    assert run.metrics["fixes"].value == 1
    assert run.metrics["losses"].value == 0
    assert run.metrics["first_fix_after"].value < 15.0
    assert poses.is_localized.mean() > 0.5
    assert distance_m.max() < RIGHT_M
    assert turn_rad.max() < RIGHT_RAD
    assert poses.is_localized[-1]
    assert (poses.sigma[poses.is_localized] > 0.0).all()
    assert ((poses.quality > 0.5) == poses.is_localized).all()


def test_a_small_map_of_another_building_with_such_rooms_does_not_place_a_robot():
    elsewhere = map_of(small_fleet.draw(1, 15.0, seed=7).robots)
    for robot in small_fleet.draw(3, 15.0, seed=1).robots[:2]:
        assert localized(robot.scans(), elsewhere).metrics["fixes"].value == 0


def test_an_initial_pose_is_used_if_the_walls_confirm_it(fleet, building):
    robot = fleet.robots[2]
    start = robot.T_building_base[0]
    near = localized(robot.scans(), building, initial=start + np.array((0.4, -0.3, 0.1)))
    distance_m, _ = errors(near.localized["robot"], robot)
    assert near.metrics["first_fix_after"].value < 4.0
    assert distance_m.max() < RIGHT_M
    far = localized(robot.scans(), building, initial=start + np.array((3.0, 2.0, 1.5)))
    distance_m, _ = errors(far.localized["robot"], robot)
    assert distance_m.max() < RIGHT_M


def test_with_update_the_map_shows_what_changed_since_and_the_map_before_stays(fleet, building):
    robot = fleet.robots[2]
    scans = list(robot.scans())
    start = robot.T_building_base[0]
    rows, columns = np.nonzero(building.cells == Occupancy.OCCUPIED)
    with_box = building.cells.copy()  # a box that is gone, on the way of the robot
    x, y = np.floor((robot.T_building_base[len(scans) // 2, :2] - building.origin_xy) / building.resolution_m).astype(
        int
    )
    with_box[y - 2 : y + 3, x - 2 : x + 3] = Occupancy.OCCUPIED
    old = replace(building, cells=with_box)
    run = localized(scans, old, initial=start, update=True)
    before, after = (parse_map(name, run.map_files[f"{name}.pgm"], run.map_files[f"{name}.yaml"].decode())
                     for name in ("map_before", "map"))  # fmt: skip
    assert np.array_equal(before.cells, with_box)
    cell = np.round((np.array(after.origin_xy) - old.origin_xy) / old.resolution_m).astype(int)
    grown = after.cells[-cell[1] :, -cell[0] :][: with_box.shape[0], : with_box.shape[1]]
    assert (grown[y - 2 : y + 3, x - 2 : x + 3] == Occupancy.FREE).all()
    kept = (grown[rows, columns] == Occupancy.OCCUPIED).mean()
    assert kept > 0.95, "what did not change stays"


def test_a_robot_that_is_carried_away_is_found_again_and_never_wrong(fleet, building):
    carried, there = fleet.robots[2], fleet.robots[0]
    before = list(carried.scans())[:80]
    scans = before + put_down(before[-1], list(there.scans()))
    truth = np.concatenate((carried.T_building_base[:80], there.T_building_base))
    run = localized(scans, building)
    poses = run.localized["robot"]
    off = se2.between(truth, poses.T_map_base)
    wrong = poses.is_localized & (np.hypot(off[:, 0], off[:, 1]) > 0.5)
    assert run.metrics["losses"].value == 1
    assert wrong.sum() <= 5  # scans until the robot notices
    assert poses.is_localized[-1]


def test_a_pose_at_which_most_walls_are_unknown_is_given_up_for_one_that_explains_them(fleet, building):
    robot = fleet.robots[2]
    start = robot.T_building_base[0]
    # A fragment of the building, around the start of the robot, once more beside it.
    rows, columns = np.indices(building.cells.shape)
    x, y = (start[:2] - building.origin_xy) / building.resolution_m
    fragment = building.cells.copy()
    fragment[np.hypot(rows - y, columns - x) * building.resolution_m > FRAGMENT_M] = Occupancy.UNKNOWN
    gap = np.full((len(fragment), round(GAP_M / building.resolution_m)), Occupancy.UNKNOWN, fragment.dtype)
    twice = replace(building, cells=np.hstack((building.cells, gap, fragment)))
    shift_m = (fragment.shape[1] + gap.shape[1]) * building.resolution_m
    poses = localized(robot.scans(), twice, initial=start + np.array((shift_m, 0.0, 0.0))).localized["robot"]
    off_m = np.hypot(*(poses.T_map_base - robot.T_building_base)[:, :2].T)
    step_m = np.append(0.0, np.hypot(*np.diff(robot.T_building_base[:, :2], axis=0).T))
    believed_wrongly = poses.is_localized & (off_m > 0.5 * shift_m)
    assert 0.0 < step_m[believed_wrongly].sum() < 6.0
    assert off_m[-1] < RIGHT_M


class Keyscans:
    """Keeps what the front end gives its back end."""

    def __init__(self):
        self.inputs = []

    def submit(self, input):
        self.inputs.append(input)
        done = Future()
        done.set_result([])
        return done


def test_quality_falls_with_the_first_keyscan_that_shows_other_walls(fleet, building):
    robot, kept, config = fleet.robots[2], Keyscans(), MissionConfig().robot
    frontend = RobotFrontend("robot", config, kept.submit)
    for scan in robot.scans():
        frontend.process(scan)
    start = small_fleet.truth_at(robot, [robot.stamps[0]])[0]
    localizer = MapLocalizer(frozen_map(building, "building"), start)
    qualities = []
    for new in kept.inputs[:8]:
        localizer.submit(new)
        qualities.append(localizer.estimate.quality)
    assert min(qualities) > 0.9
    last = kept.inputs[8].keyscan
    mirrored = replace(last.points, points=last.points.points * (1, -1), normals=last.points.normals * (1, -1))
    localizer.submit(replace(kept.inputs[8], keyscan=replace(last, points=mirrored)))
    assert localizer.estimate is None or localizer.estimate.quality < 0.7
