"""A live robot in a finished map: found, followed and lost as a recording is, and no pose waits for the search."""

from concurrent.futures import BrokenExecutor

import numpy as np
import pytest

import fcslam
from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.live.records import Wiring
from fcslam.maps.occupancy_map import map_yaml, pgm_bytes
from fcslam.mission.localization import read_map
from tests import small_fleet
from tests.carmen_logs import write_carmen
from tests.lidar.worlds import Recording
from tests.live.same_thread import SameThread
from tests.robot.test_map_localizer import errors, map_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def fleet():
    return small_fleet.draw(3)


@pytest.fixture(scope="module")
def building(fleet):
    return map_of(fleet.robots[:2])


@pytest.fixture(scope="module")
def scans(fleet):
    return list(fleet.robots[2].scans())


def robot_in(building, scans, executor=None, **options):
    return fcslam.LocalizedRobot("anna", building, scans[0].laser, wiring=Wiring(executor or SameThread()), **options)


def drive(robot, scans):
    return [robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base) for scan in scans]


def test_the_poses_are_those_of_a_recording(fleet, building, scans, tmp_path):
    said = []
    with robot_in(building, scans, on_event=said.append) as robot:
        poses = drive(robot, scans)
        robot.finish()
        saved = robot.save(tmp_path / "run")
        with pytest.raises(InputError, match="finished"):
            drive(robot, scans[-1:])
    recorded = fcslam.localize(Recording(scans, "anna"), building).localized["anna"]
    known = recorded.is_localized
    assert [pose.is_localized for pose in poses] == known.tolist()
    assert np.allclose([pose.T_map_base for pose in poses], recorded.T_map_base, atol=1e-3, equal_nan=True)
    assert errors(saved.localized["anna"], fleet.robots[2])[0].max() < 0.1
    assert [event.kind for event in said] == [fcslam.EventKind.LOCALIZED]
    assert fcslam.open_run(tmp_path / "run").trajectories["anna"].stamps.tolist() == recorded.stamps[known].tolist()
    assert np.array_equal(read_map(tmp_path / "run").cells, building.cells), "the map does not change"


def test_an_unknown_pose_is_no_number(building, scans):
    with robot_in(building, scans) as robot:
        (pose,) = drive(robot, scans[:1])
        assert robot.status().localization == "not localized"
    assert not pose.is_localized
    assert np.isnan(pose.T_map_base).all()
    assert np.isnan(pose.covariance).all()
    assert pose.T_map_odom is None
    assert pose.quality == 0.0


def test_no_pose_waits_for_the_search(building, scans):
    executor = SameThread()
    with robot_in(building, scans, executor) as robot:
        executor.holds = True
        assert not any(pose.is_localized for pose in drive(robot, scans[:-1]))
        executor.work()
        (pose,) = drive(robot, scans[-1:])
        assert pose.is_localized, "what was searched for meanwhile counts from the next scan on"


def test_a_given_pose_counts_once_the_walls_confirm_it(fleet, building, scans):
    start = small_fleet.truth_at(fleet.robots[2], [scan.stamp for scan in scans])
    with robot_in(building, scans, initial_pose=start[0] + np.array((0.4, -0.3, 0.1))) as robot:
        (pose,) = drive(robot, scans[:1])
        assert np.hypot(*(pose.T_map_base - start[0])[:2]) < 0.1
        assert np.sqrt(pose.covariance[0, 0]) < 0.2
    with robot_in(building, scans) as robot:
        drive(robot, scans[:10])
        robot.suggest_pose(start[9] + np.array((5.0, 0.0, 2.0)))
        assert not drive(robot, scans[10:11])[0].is_localized
        robot.suggest_pose(start[10] + np.array((-0.3, 0.4, -0.1)))
        (pose,) = drive(robot, scans[11:12])
        assert np.hypot(*(pose.T_map_base - start[11])[:2]) < 0.1


def test_a_wrong_given_pose_does_not_move_a_localized_robot(fleet, building, scans):
    start = small_fleet.truth_at(fleet.robots[2], [scan.stamp for scan in scans])
    with robot_in(building, scans, initial_pose=start[0]) as robot:
        drive(robot, scans[:10])
        robot.suggest_pose(start[9] + np.array((4.0, 0.0, 2.0)))
        for pose, truth in zip(drive(robot, scans[10:20]), start[10:20], strict=True):
            assert np.hypot(*(pose.T_map_base - truth)[:2]) < 0.1


def test_a_broken_search_is_told_once_and_the_pose_is_given_up(fleet, building, scans):
    executor, said = SameThread(), []
    start = small_fleet.truth_at(fleet.robots[2], [scans[0].stamp])[0]
    with robot_in(building, scans, executor, initial_pose=start, on_event=said.append) as robot:
        assert drive(robot, scans[:1])[0].is_localized
        executor.is_broken = True
        poses = drive(robot, scans[1:60])
        assert not poses[-1].is_localized
        assert [event.kind for event in said].count(fcslam.EventKind.FAILED) == 1
        assert "the search failed" in robot.status().notices[0]


@pytest.mark.parametrize("pose", [(0.0, 0.0), (np.nan, 0.0, 0.0), "here", (1e300, 0.0, 0.0)])
def test_what_is_no_pose_is_refused(building, scans, pose):
    with robot_in(building, scans) as robot, pytest.raises(InputError, match="pose"):
        robot.suggest_pose(pose)


def test_a_map_that_cannot_be_used_is_refused_in_one_line(building, scans, tmp_path):
    def refusal(map, **options):
        with pytest.raises(InputError) as caught:
            robot_in(map, scans, **options).close()
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "cannot be read as a map" in refusal(tmp_path / "missing")
    assert "no such file" in refusal(tmp_path / "missing.fcslam")
    (tmp_path / "empty.fcslam").write_bytes(b"")
    assert "empty.fcslam" in refusal(tmp_path / "empty.fcslam")
    bare = np.full((50, 50), fcslam.Occupancy.UNKNOWN, np.uint8)
    assert "no wall" in refusal(fcslam.OccupancyMap(bare, 0.05, (0.0, 0.0)))
    cells = np.full((10, 40_000), fcslam.Occupancy.FREE, np.uint8)
    cells[0] = fcslam.Occupancy.OCCUPIED
    wide = fcslam.OccupancyMap(cells, 0.05, (0.0, 0.0))
    (tmp_path / "wide.pgm").write_bytes(pgm_bytes(wide))
    (tmp_path / "wide.yaml").write_text(map_yaml(wide, "wide.pgm"))
    assert "extends over" in refusal(tmp_path / "wide.yaml")
    assert "leave the floor out" in refusal(tmp_path / "wide.yaml", floor="2")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "robots.csv").write_text("robot,map,path_length_m,scans,floor\na,0,1,1,two words\n")
    assert "damaged run folder ('two words' is not a floor)" in refusal(tmp_path / "run", floor="2")


def test_a_mission_file_is_a_map(fleet, tmp_path):
    write_carmen(tmp_path / "anna.clf", list(fleet.robots[0].scans())[:60])
    fcslam.map_recordings(tmp_path / "anna.clf", output=tmp_path / "run")
    moved = (tmp_path / "run" / "mission.fcslam").rename(tmp_path / "office.sqlite")  # as a service exports it
    assert np.array_equal(read_map(moved).cells, read_map(tmp_path / "run").cells)


@pytest.mark.system
def test_a_process_of_its_own_finds_the_robot(fleet, building, scans):
    with fcslam.LocalizedRobot("anna", building, scans[0].laser) as robot:
        for scan in scans:
            pose = robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base)
            while robot._frontend.packets.backlog > 5:  # a simulated robot is faster than a real one
                robot._frontend.ready()
        assert pose.is_localized
        off = se2.between(small_fleet.truth_at(fleet.robots[2], [pose.stamp])[0], pose.T_map_base)
        assert np.hypot(off[0], off[1]) < 0.1


def test_a_pose_that_is_given_after_the_worker_ended_raises_nothing(building, scans):
    """The thread that takes it receives all messages of a robot."""

    class Dead(SameThread):
        is_dead = False

        def submit(self, *arguments):
            if self.is_dead:
                raise BrokenExecutor("a process ended abruptly")
            return super().submit(*arguments)

    worker = Dead()
    with robot_in(building, scans, worker) as robot:
        drive(robot, scans[:3])
        worker.is_dead = True
        robot.suggest_pose(np.zeros(3))
        assert not drive(robot, scans[3:6])[-1].is_localized
