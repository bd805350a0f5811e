"""A live robot: the poses of a tracker at once, and in the end the run of a recording."""

import logging
import math
import threading
from dataclasses import replace

import numpy as np
import pytest

import fcslam
from fcslam.errors import FcslamError, InputError
from fcslam.geometry import se2
from fcslam.live.records import Wiring
from fcslam.sources import open_source
from fcslam.wire.messages import Hello
from fcslam.wire.packets import decode
from tests import small_fleet
from tests.carmen_logs import write_carmen
from tests.lidar import worlds
from tests.live.same_thread import SameThread
from tests.robot.fake_cloud import FakeCloud, Network
from tests.robot.kidnapping import kidnapping
from tests.spinning_lidar import circle, room
from tests.spinning_lidar import drive as drive_lidar

pytestmark = pytest.mark.slow

CAMERA = fcslam.CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5, fcslam.Transform((0.1, 0.0, 0.4), (-0.5, 0.5, -0.5, 0.5)))


@pytest.fixture(scope="module")
def scans():
    return list(small_fleet.draw(1, path_length_m=8.0).robots[0].scans())


@pytest.fixture
def robot(scans):
    with fcslam.Robot("anna", scans[0].laser, wiring=Wiring(SameThread())) as robot:
        yield robot


def drive(robot, scans):
    return [robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base) for scan in scans]


def test_a_scan_that_a_driver_repeats_moves_the_robot_by_its_odometry_alone(robot, scans):
    """The transform from ``map`` to ``odom`` stays, so odometry carries the robot on."""
    *_, last = drive(robot, scans[:20])
    T_odom_base = np.add(scans[19].T_odom_base, (0.3, 0.0, 0.0))
    moved = replace(scans[19], stamp=scans[20].stamp, T_odom_base=T_odom_base)
    assert robot.add(moved) is last


def test_each_pose_is_that_of_the_tracker(robot, scans):
    poses, (frontend, _) = drive(robot, scans), small_fleet.driven(scans)
    assert np.allclose([pose.T_map_base for pose in poses], frontend.scan_poses.T_odom_base(), atol=1e-3)
    assert [pose.stamp for pose in poses] == [scan.stamp for scan in scans]
    assert all(pose.is_localized for pose in poses)
    assert {pose.map_index for pose in poses} <= {None, 0}
    assert all(pose.quality > 0.8 for pose in poses[1:] if not math.isnan(pose.quality))
    assert robot.pose is poses[-1]


def test_the_frame_of_the_odometry_carries_the_correction(robot, scans):
    for pose, scan in zip(drive(robot, scans), scans, strict=True):
        assert np.allclose(se2.compose(pose.T_map_odom, scan.T_odom_base), pose.T_map_base)
        assert pose.T_odom_base is scan.T_odom_base


def test_the_covariance_is_one_in_the_axes_of_the_map(robot, scans):
    for pose in drive(robot, scans):
        covariance = pose.covariance
        assert covariance.shape == (3, 3)
        assert np.allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0.0
        assert math.sqrt(covariance[0, 0]) < 0.2


def test_the_finished_run_is_that_of_the_recording(scans, tmp_path):
    write_carmen(tmp_path / "anna.clf", scans)
    mapped = fcslam.map_recordings(tmp_path / "anna.clf")
    with fcslam.Robot("anna", wiring=Wiring(SameThread())) as robot:
        for record in open_source(tmp_path / "anna.clf").records():
            robot.add(record)
        robot.finish()
        saved = robot.save(tmp_path / "run")
    assert saved.trajectories["anna"].T_map_base.tobytes() == mapped.trajectories["anna"].T_map_base.tobytes()
    assert saved.map_files == mapped.map_files
    assert saved.metrics == mapped.metrics
    assert saved.pose_graph_g2o == mapped.pose_graph_g2o
    assert saved.config_yaml == mapped.config_yaml
    assert fcslam.open_run(tmp_path / "run").map_files == mapped.map_files


def test_map_and_trajectory_are_there_at_any_time(robot, scans):
    assert (robot.map().cells == fcslam.Occupancy.UNKNOWN).all()
    assert len(robot.trajectory().stamps) == 0
    poses = drive(robot, scans)
    drawn, path = robot.map(), robot.trajectory()
    assert drawn.cells.shape[0] * drawn.resolution_m > 3.0
    assert {*np.unique(drawn.cells)} == set(fcslam.Occupancy)
    assert np.array_equal(path.stamps, [scan.stamp for scan in scans])
    assert np.allclose(path.T_map_base[-1], poses[-1].T_map_base, atol=0.05)
    seen = robot.add_scan(scans[-1].ranges_m, scans[-1].stamp, scans[-1].T_odom_base)
    column, row = np.floor((seen.T_map_base[:2] - drawn.origin_xy) / drawn.resolution_m).astype(int)
    assert drawn.cells[row, column] == fcslam.Occupancy.FREE, "where the robot stands"


def test_without_a_scan_there_is_nothing_to_save(robot, tmp_path):
    with pytest.raises(InputError, match="no scan was added"):
        robot.save(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_robot_with_a_2d_lidar_maps_in_space(scans, tmp_path):
    space = {"fleet": {"dimensions": 3}}
    with fcslam.Robot("anna", scans[0].laser, config=space, wiring=Wiring(SameThread())) as robot:
        poses = drive(robot, scans)
        robot.finish()
        assert poses[-1].T_map_base_6d.shape == poses[-1].T_map_odom_6d.shape == (7,)
        assert poses[-1].z == pytest.approx(0.0, abs=1e-6)
        assert np.diag(poses[-1].covariance_6d)[2:5].tolist() == [0.0, 0.0, 0.0]
        assert robot.trajectory().poses.shape == (len(scans), 7)
        assert len(robot.points()) == 0, "a 2D LiDAR gives no points in space"
        assert robot.own_map().cells.any()
        run = robot.save(tmp_path / "run")
        with pytest.raises(InputError, match="a turn of a 3D LiDAR; make the robot with lidar_3d=True"):
            robot.add(next(drive_lidar(room(1), circle((6.0, 4.0), 1.6, 0.8), 1, azimuths=9))[0])
    assert run.trajectories["anna"].T_map_base_6d.shape == (len(scans), 7)
    with pytest.raises(InputError, match=r"a 3D LiDAR needs a map in space; set fleet.dimensions to 3 \(--3d\)"):
        fcslam.Robot("anna", lidar_3d=True, wiring=Wiring(SameThread()))
    with pytest.raises(InputError, match=r"uses no camera; leave out camera= \(--learn\)"):
        fcslam.Robot("anna", lidar_3d=True, config=space, wiring=Wiring(SameThread(), keeps_keyframes=True))


def test_a_run_can_be_saved_before_the_end(robot, scans, tmp_path):
    drive(robot, scans[:30])
    run = robot.save(tmp_path / "run")
    assert len(run.trajectories["anna"].stamps) == 30
    drive(robot, scans[30:])
    with pytest.raises(fcslam.InputError, match="already holds a run"):
        robot.save(tmp_path / "run")
    assert len(robot.save(tmp_path / "run", force=True).trajectories["anna"].stamps) == len(scans)


def test_a_lost_robot_says_so_and_finds_its_place_again():
    scans, moment = kidnapping()
    events = []

    def settled(pose):
        return not moment < pose.stamp < lost.stamp

    with fcslam.Robot("anna", scans[0].laser, wiring=Wiring(SameThread()), on_event=events.append) as robot:
        poses = drive(robot, scans)
    lost, found = (event for event in events if event.kind is not fcslam.EventKind.CORRECTED)
    assert (lost.kind, found.kind) == (fcslam.EventKind.LOST, fcslam.EventKind.RELOCALIZED)
    assert moment < lost.stamp < found.stamp
    assert all(pose.is_localized == (not lost.stamp <= pose.stamp < found.stamp) for pose in poses if settled(pose))


def test_a_worker_that_ends_is_told_once_and_the_robot_goes_on(scans, caplog):
    executor, events = SameThread(), []
    with fcslam.Robot("anna", scans[0].laser, wiring=Wiring(executor), on_event=events.append) as robot:
        drive(robot, scans[:10])
        executor.is_broken = True
        with caplog.at_level(logging.WARNING):
            poses = drive(robot, scans[10:])
        with pytest.raises(FcslamError, match="anna: the robot's map is gone: BrokenExecutor: it was killed"):
            robot.map()
    assert len(poses) == len(scans) - 10
    assert {event.kind for event in events} == {fcslam.EventKind.FAILED}
    assert len(caplog.records) == len(events) <= 2


def test_without_odometry_scan_matching_alone_gives_the_motion(scans):
    events = []
    with fcslam.Robot("anna", scans[0].laser, wiring=Wiring(SameThread()), on_event=events.append) as blind:
        poses = [blind.add_scan(scan.ranges_m, scan.stamp) for scan in scans]
        with pytest.raises(InputError, match="some scans have odometry and some have not"):
            blind.add_scan(scans[-1].ranges_m, scans[-1].stamp, scans[-1].T_odom_base)
    frontend, _ = small_fleet.driven(scans)
    assert np.allclose([pose.T_map_base for pose in poses], frontend.scan_poses.T_odom_base(), atol=0.06)
    assert all(pose.T_odom_base is pose.T_map_odom is None for pose in poses)
    assert not [event for event in events if event.kind is not fcslam.EventKind.CORRECTED]


@pytest.mark.parametrize(
    ("told", "words"),
    [((0.0, 0.0, 0.0), "the odometry never changes"), ((1.0, 1.0, 0.0), "its heading is never set")],
    ids=["always zero", "heading never set"],
)
def test_odometry_that_says_nothing_is_told_and_not_used(scans, told, words):
    events = []
    with fcslam.Robot("anna", scans[0].laser, wiring=Wiring(SameThread()), on_event=events.append) as robot:
        for scan in scans:
            pose = robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base * told)
    assert [words in event.text for event in events if event.kind is fcslam.EventKind.FAILED] == [True]
    assert np.allclose(se2.compose(pose.T_map_odom, pose.T_odom_base), pose.T_map_base)


def test_a_bare_corridor_is_told_once_to_a_robot_without_odometry():
    laser = fcslam.LaserModel(360, -math.pi, math.radians(1.0), 12.0)
    distances = 1.0 / np.maximum(np.abs(np.sin(laser.angles_rad())), 1e-9)
    rng, events = np.random.default_rng(1), []
    with fcslam.Robot("anna", laser, wiring=Wiring(SameThread()), on_event=events.append) as robot:
        poses = [robot.add_scan(distances + rng.normal(0.0, 0.01, 360), stamp) for stamp in np.arange(0.0, 3.0, 0.1)]
    assert [event.kind for event in events] == [fcslam.EventKind.UNDETERMINED]
    assert not any(pose.is_determined for pose in poses)
    assert poses[-1].covariance[0, 0] > 3.0 * poses[-1].covariance[1, 1]


def test_the_number_of_beams_may_vary_from_scan_to_scan():
    """As of an RPLidar: one turn has a few beams more or less."""
    laser = fcslam.LaserModel(360, -math.pi, math.tau / 360, 12.0)
    truth = worlds.drive([(-2.0, -1.0), (1.5, -1.5), (1.5, 2.0)])
    rng, found = np.random.default_rng(0), []
    with fcslam.Robot("anna", laser, wiring=Wiring(SameThread())) as robot:
        for k, pose in enumerate(truth):
            beams = fcslam.LaserModel(count := 345 + k % 30, -math.pi, math.tau / count, 12.0)
            (ranges,) = worlds.ranges(pose[None], worlds.room(), beams, 0.01, rng)
            found.append(robot.add_scan(ranges, 0.1 * k, pose).T_map_base)
    off = se2.between(se2.between(truth[0], truth[-1]), se2.between(found[0], found[-1]))
    assert np.all(np.abs(off) < (0.03, 0.03, 0.01))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"ranges_m": [1.0]}, r"ranges_m: shape \(1,\), but the laser has about 180 beams"),
        ({"ranges_m": np.ones(90)}, r"ranges_m: shape \(90,\), but the laser has about 180 beams"),
        ({"ranges_m": "far"}, "ranges_m: not an array of numbers"),
        ({"stamp": math.nan}, "stamp: nan is not a time"),
        ({"stamp": "1.0"}, "stamp: 1.0 is not a time"),
        ({"odometry": (0.0, 0.0)}, "odometry: .* is not a pose"),
        ({"odometry": (0.0, math.nan, 0.0)}, "odometry: .* is not a pose"),
        ({"laser": "rear"}, "laser 'rear' is not known"),
        ({"stamp": 0.0}, "the clock went back"),
    ],
)
def test_a_scan_that_cannot_be_is_refused_and_the_next_one_is_not(robot, scans, change, reason):
    late = [replace(scan, stamp=scan.stamp + 100.0) for scan in scans]
    drive(robot, late[:1])
    good = {"ranges_m": late[1].ranges_m, "stamp": late[1].stamp, "odometry": late[1].T_odom_base}
    with pytest.raises(InputError, match=reason) as raised:
        robot.add_scan(**{**good, **change})
    assert "\n" not in str(raised.value)
    assert robot.add_scan(**good).is_localized


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"name": "a/b"}, "'a/b' is not a name"),
        ({"name": "a+1"}, "give the robot another name"),
        ({"laser": fcslam.LaserModel(360, 0.0, 1.0, 10.0)}, "are not of one turn"),
        ({"laser": fcslam.LaserModel(1, 0.0, 0.1, 10.0)}, "are not of one turn"),
        ({"laser": fcslam.LaserModel(9, 0.0, 0.1, 0.0)}, "max_range_m above 0"),
        ({"laser": {"a": fcslam.LaserModel(9, 0.0, 0.1, 5.0), "b": fcslam.LaserModel(9, 0.0, 0.1, 5.0)}}, "two lasers"),
        ({"config": {"robots": 1}}, "unknown key 'robots'"),
        ({"state": "/nowhere"}, "a robot without a server keeps nothing"),
        ({"camera": replace(CAMERA, fx=0.0)}, "a focal length above 0"),
        ({"camera": replace(CAMERA, T_base_camera=fcslam.Transform((0, 0, 0), (0, 0, 0, 2)))}, "not a unit"),
    ],
)
def test_a_robot_that_cannot_be_is_one_line(arguments, reason):
    with pytest.raises(InputError, match=reason) as raised:
        fcslam.Robot(**{"name": "anna", **arguments}, wiring=Wiring(SameThread()))
    assert "\n" not in str(raised.value)


def test_nothing_comes_after_the_end(robot, scans):
    drive(robot, scans[:3])
    robot.finish()
    robot.finish()
    with pytest.raises(InputError, match="the robot is finished"):
        drive(robot, scans[3:4])
    with pytest.raises(InputError, match="the robot is finished"):
        robot.add(scans[3])
    with pytest.raises(InputError, match="the robot is finished"):
        robot.change_floor("2")
    assert len(robot.trajectory().stamps) == 3


def test_a_closed_robot_waits_for_no_output_that_was_cancelled(scans):
    executor = SameThread()
    with fcslam.Robot("anna", scans[0].laser, own_map=False, wiring=Wiring(executor)) as robot:
        drive(robot, scans[:20])
        executor.holds = True
        drive(robot, scans[20:])
    robot._frontend.packets.newest.cancel()
    assert len(robot.trajectory().stamps) == len(scans)


def test_another_thread_may_ask_meanwhile(scans):
    with fcslam.Robot("anna", scans[0].laser) as robot:  # with a process of its own
        stop, drawn = threading.Event(), []

        def look():
            while not stop.is_set():
                drawn.append(robot.map())
                robot.trajectory()

        thread = threading.Thread(target=look)
        thread.start()
        try:
            drive(robot, scans)
        finally:
            stop.set()
            thread.join()
        assert len(robot.trajectory().stamps) == len(scans)
        assert robot.map().cells.size > 1
    assert drawn


def test_closures_join_places_that_are_near_each_other(robot, scans):
    drive(robot, scans)
    end_s = scans[-1].stamp
    drive(robot, [replace(scan, stamp=2.0 * end_s - scan.stamp) for scan in scans[::-1]])
    robot.finish()
    ends = robot.closures()
    assert ends.shape[1:] == (2, 2)
    assert len(ends)
    assert np.hypot(*(ends[:, 0] - ends[:, 1]).T).max() < 5.0


def test_images_are_grey_or_rgb_and_of_the_camera(robot, scans):
    with pytest.raises(InputError, match="the robot has no camera"):
        robot.add_image(np.zeros((48, 64), np.uint8), scans[1].stamp)
    with fcslam.Robot("anna", scans[0].laser, camera=CAMERA, wiring=Wiring(SameThread())) as seeing:
        drive(seeing, scans[:2])
        seeing.add_image(np.zeros((48, 64), np.uint8), scans[1].stamp)
        seeing.add_image(np.zeros((48, 64, 3), np.uint8), scans[1].stamp, scans[1].T_odom_base)
        for wrong in (np.zeros((48, 63), np.uint8), np.zeros((48, 64)), np.zeros((48, 64, 4), np.uint8), "no image"):
            with pytest.raises(InputError, match="but the camera gives"):
                seeing.add_image(wrong, scans[1].stamp)
    with pytest.raises(InputError, match="finished"):
        seeing.add_image(np.zeros((48, 64), np.uint8), scans[1].stamp)


def test_two_lasers_are_told_apart_by_name(scans):
    rear = replace(scans[0].laser, T_base_laser=(-0.2, 0.0, math.pi))
    with fcslam.Robot("anna", {"front": scans[0].laser, "rear": rear}, wiring=Wiring(SameThread())) as robot:
        for scan in scans[:10]:
            robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base, laser="front")
            robot.add_scan(np.full(180, np.inf), scan.stamp, scan.T_odom_base, laser="rear")
        with pytest.raises(InputError, match="laser '' is not known; known: 'front', 'rear'"):
            robot.add_scan(scans[0].ranges_m, scans[9].stamp, scans[9].T_odom_base)
        assert len(robot.trajectory().stamps) == 20


def test_a_lift_begins_a_session_on_another_floor(scans, tmp_path):
    cloud, events, half = FakeCloud(), [], len(scans) // 2
    wiring = Wiring(SameThread(), transport=Network(cloud))
    with fcslam.Robot("alice", scans[0].laser, floor="1", wiring=wiring, on_event=events.append) as robot:
        drive(robot, scans[:half])
        robot.change_floor("1")
        robot.change_floor("2")
        poses = drive(robot, scans[half:])
        with pytest.raises(InputError, match="is not 1 to 16"):
            robot.change_floor("the attic")
        robot.finish()
        assert (robot.status().times_lost, robot.status().localization) == (0, "mapping")
        run = robot.save(tmp_path / "run")
    assert {name: trajectory.floor for name, trajectory in run.trajectories.items()} == {"alice": "1", "alice+1": "2"}
    assert {trajectory.map_index for trajectory in run.trajectories.values()} == {0, 1}
    assert all(pose.is_localized for pose in poses)
    told = [event.kind for event in events if event.kind in {fcslam.EventKind.FLOOR, fcslam.EventKind.LOST}]
    assert told == [fcslam.EventKind.FLOOR]
    hellos = [decode(data).body for data in cloud.stored.values() if isinstance(decode(data).body, Hello)]
    assert [(hello.epoch, hello.floor) for hello in hellos] == [(0, "1"), (1, "2")]
