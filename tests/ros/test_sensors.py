"""Messages of a live robot become the records of a bag."""

import itertools

import numpy as np
import pytest

from fcslam.errors import SourceError
from fcslam.records import CameraImage, GnssFix, LaserScan
from fcslam.robot.mapped_scans import MappedScans
from fcslam.ros.live_plan import PATIENCE_S, SCANS_FOR_RIG
from fcslam.ros.sensors import ODOMETRY_PATIENCE_S, STEPS_BACK_FOR_RESTART, LiveSensors
from fcslam.ros.topics import SensorTopics
from fcslam.sources import BagOptions, open_source
from fcslam.sources.bags.codec import CAMERA_INFO, FIX, IMAGE, IMU, POINT_CLOUD, TRANSFORMS
from fcslam.sources.bags.records import RecordFile
from fcslam.sources.faults import Fault
from fcslam.sources.point_clouds import FEWEST_FLOORS
from fcslam.wire.limits import MAXIMUM_BEAMS
from tests.ros.ros_messages import (
    KINDS,
    LASER_POSE,
    camera_info,
    encoded,
    fix,
    header,
    image,
    imu,
    odometry,
    scan,
    transform,
)
from tests.sources.bag_messages import save
from tests.sources.clouds import PERIOD_S, VELODYNE, at_rest, cloud, depth_image, plan_ranges, rotation, spinning
from tests.sources.test_bag_clouds import LEANING, drive
from tests.sources.test_drivers import in_tf, late

pytestmark = pytest.mark.slow

RANGES = np.full(180, 5.0)


class Robot:
    """Feeds messages to sensors and keeps what comes out."""

    def __init__(
        self, odometry="/odom", kinds=KINDS, camera=None, info=None, scans=("/scan",), fixes=None, imu=None,
        mounted=(), **options,
    ):  # fmt: skip
        """``mounted`` are the frames of the sensors in tf, and their poses."""
        self.said = []
        self.kinds = kinds
        in_space = options.get("in_3d", False)
        topics = SensorTopics(kinds, scans, odometry, ("/tf", "/tf_static"), camera, info, fixes, (), imu, in_space)
        self.sensors = LiveSensors(topics, "", BagOptions(**options), self.hears_of)
        self.records = []
        self.now_s = 0.0
        for frame, (x, y, heading, *height_m) in dict(mounted).items():
            self.hears("/tf_static", transform(0.0, "base_link", frame, (x, y, heading), *height_m))

    def hears_of(self, line):
        if line not in self.said:
            self.said.append(line)

    def hears(self, topic, message, received_s=1e-9):
        payload = message if isinstance(message, bytes) else encoded(self.kinds[topic], message)
        self.records += self.sensors.add(topic, payload, self.now_s, round(received_s * 1e9))
        return self

    def drives(self, stamps, offset=0.0):
        for stamp in stamps:
            self.hears("/odom", odometry(stamp + offset, (stamp, 0.0, 0.0)))
            self.hears("/scan", scan(stamp + offset, RANGES))
        return self

    def waits(self, until_s):
        self.now_s = until_s
        self.records += self.sensors.wait(until_s)

    @property
    def stamps(self):
        return [record.stamp for record in self.records]


LASER, LIDAR = {"laser": LASER_POSE}, {"lidar": (*LASER_POSE, 0.4)}


@pytest.fixture
def robot():
    return Robot(mounted=LASER)


def test_no_scan_is_lost_while_the_mounting_is_not_known():
    robot = Robot().drives(np.arange(1.0, 9.0))
    assert robot.records == []
    robot.hears("/tf_static", transform(0.0, "base_link", "laser"))
    assert robot.stamps == list(np.arange(1.0, 9.0))
    assert robot.records[0].laser.T_base_laser == pytest.approx(LASER_POSE)
    assert robot.records[3].T_odom_base == pytest.approx([4.0, 0.0, 0.0])
    assert (robot.sensors.planner.odom_frame, robot.sensors.planner.base_frame) == ("odom", "base_link")


def test_a_scan_waits_for_its_odometry(robot):
    robot.drives(np.arange(1.0, 7.0))
    robot.hears("/scan", scan(6.5, RANGES))
    assert robot.stamps[-1] == 6.0
    robot.hears("/odom", odometry(7.0, (7.0, 0.0, 0.0)))
    assert robot.stamps[-1] == 6.5
    assert robot.records[-1].T_odom_base[0] == pytest.approx(6.5)


def test_a_scan_of_a_spinning_scanner_waits_for_the_odometry_of_its_last_beam(robot):
    robot.drives(np.arange(1.0, 7.0))
    robot.hears("/odom", odometry(7.0, (7.0, 0.0, 0.0)))
    robot.hears("/scan", scan(6.9, RANGES, beam_s=0.2 / 179))
    assert robot.stamps[-1] == 6.0
    robot.hears("/odom", odometry(7.2, (7.2, 0.0, 0.0)))
    assert robot.stamps[-1] == 6.9
    sweep = robot.records[-1].sweep
    assert (sweep.first_s, sweep.last_s) == pytest.approx((0.0, 0.2))
    assert sweep.displacement(0.2) == pytest.approx([0.2, 0.0, 0.0], abs=1e-6)


def test_a_robot_without_odometry_is_mapped_after_some_seconds():
    robot = Robot(odometry=None, mounted=LASER)
    robot.hears("/scan", scan(1.0, RANGES))
    robot.waits(0.0)
    assert robot.records == []
    robot.waits(PATIENCE_S + 1.0)
    assert "no odometry" in robot.said[0]
    robot.hears("/scan", scan(2.0, RANGES))
    assert robot.stamps == [1.0, 2.0]
    assert all(np.isnan(record.T_odom_base).all() for record in robot.records)
    assert robot.sensors.planner.base_frame == "base_link"


def test_a_scan_whose_odometry_does_not_come_gets_the_nearest(robot):
    robot.drives(np.arange(1.0, 7.0))
    robot.hears("/scan", scan(6.5, RANGES))
    robot.hears("/scan", scan(8.5, RANGES))
    robot.waits(0.5 * ODOMETRY_PATIENCE_S)
    assert robot.stamps[-1] == 6.0
    robot.waits(1.1 * ODOMETRY_PATIENCE_S)
    assert robot.stamps[-1] == 6.5
    assert robot.records[-1].T_odom_base[0] == pytest.approx(6.0)
    assert len(robot.said) == 1
    assert "no odometry within 1 s" in robot.said[0]


def test_the_odometry_in_tf_is_that_of_the_laser():
    robot = Robot(odometry=None)
    for stamp in np.arange(1.0, 9.0):
        robot.hears("/tf", transform(stamp, "camera_odom_frame", "camera_pose_frame", (9.0, 9.0, 0.0)))
        robot.hears("/tf", transform(stamp, "odom", "base_link", (stamp, 0.0, 0.0)))
        robot.hears("/tf_static", transform(0.0, "base_link", "laser"))
        robot.hears("/scan", scan(stamp, RANGES))
    assert [record.T_odom_base[0] for record in robot.records] == list(np.arange(1.0, 9.0))
    assert (robot.sensors.planner.odom_frame, robot.sensors.planner.base_frame) == ("odom", "base_link")


def test_scans_of_another_frame_on_the_topic_are_left_out_and_said(robot):
    robot.drives(np.arange(1.0, 7.0))
    for frame in ("rear", *map(str, range(50))):
        robot.hears("/scan", scan(6.5, RANGES, frame=frame))
    robot.drives(np.arange(7.0, 9.0))
    assert 6.5 not in robot.stamps
    assert [line for line in robot.said if "has scans of the frames 'laser' and 'rear'" in line] == robot.said[:1]
    assert len([line for line in robot.said if "of the frames" in line]) == 1


def test_one_scan_far_back_in_time_is_left_out(robot):
    robot.drives([*np.arange(100.0, 110.0), 50.0, 110.0])
    assert robot.stamps == list(np.arange(100.0, 111.0))
    assert robot.said == []


def test_damaged_messages_are_told_once(robot):
    robot.drives(np.arange(1.0, 7.0))
    robot.hears("/scan", b"no message").hears("/scan", b"nor this").drives([7.0])
    assert robot.stamps[-1] == 7.0
    assert len(robot.said) == 1
    other = Robot().drives(np.arange(1.0, 7.0)).hears("/scan", scan(8.0, RANGES, increment=0.0))
    assert "angle_increment is 0); correct the driver" in other.said[0]


def test_a_missing_mounting_says_who_could_publish_it_and_the_robot_waits():
    robot = Robot().drives(np.arange(1.0, 9.0))
    robot.waits(PATIENCE_S + 1.0)
    (line,) = robot.said
    assert "no transform from 'base_link' to 'laser'" in line
    assert "start robot_state_publisher" in line
    robot.drives(np.arange(9.0, 300.0)).hears("/tf_static", transform(0.0, "base_link", "laser"))
    assert robot.stamps == list(np.arange(1.0, 300.0))
    assert robot.said == [line]


def test_odometry_without_a_frame_is_odometry(robot):
    for stamp in np.arange(1.0, 9.0):
        robot.hears("/odom", odometry(stamp, (stamp, 0.0, 0.0), frame="")).hears("/scan", scan(stamp, RANGES))
    assert robot.stamps == list(np.arange(1.0, 9.0))
    assert robot.sensors.planner.odom_frame == "odom"


def test_silence_of_the_odometry_is_told():
    robot = Robot(laser_poses=((0.1, 0.0, 0.0),))
    robot.hears("/scan", scan(1.0, RANGES))
    robot.waits(PATIENCE_S + 1.0)
    assert "waits for odometry: /odom is silent" in robot.said[0]
    robot.drives([2.0, 3.0])
    assert robot.stamps == [1.0, 2.0, 3.0]


def test_silence_of_a_laser_is_told(robot):
    for second in range(3):
        robot.waits(PATIENCE_S + second)
    assert robot.said[0] == "waits for scans: none that can be read arrived on /scan within 5 s"
    robot.drives([1.0])
    assert robot.stamps == [1.0]


def two_lasers(**options):
    mounted = {**LASER, "rear": (-0.3, 0.0, 3.0)}
    return Robot(kinds={**KINDS, "/rear": KINDS["/scan"]}, scans=("/scan", "/rear"), mounted=mounted, **options)


def late_by(robot, laser_stops_s, until_s):
    """How late each record of a drive comes, if the rear laser stops at a time."""
    late = []
    for step in range(1, int(10 * until_s)):
        robot.now_s = now_s = 0.1 * step
        before = len(robot.records)
        robot.hears("/odom", odometry(now_s, (now_s, 0.0, 0.0)))
        robot.hears("/scan", scan(now_s - 0.02, RANGES))
        if now_s < laser_stops_s:
            robot.hears("/rear", scan(now_s - 0.01, RANGES, "rear"))
        late += [(now_s, now_s - record.stamp) for record in robot.records[before:]]
    return late


def test_a_laser_that_stops_does_not_delay_the_other():
    robot = two_lasers()
    late = late_by(robot, laser_stops_s=5.0, until_s=15.0)
    assert max(delay for now_s, delay in late if 1.0 < now_s < 5.0) < 0.15
    assert max(delay for now_s, delay in late if now_s > 6.0) < 0.15
    assert robot.said == ["/rear is silent; the robot goes on with its other lasers"]
    assert robot.stamps == sorted(robot.stamps)


def test_a_laser_that_starts_again_is_merged_again():
    robot = two_lasers()
    late_by(robot, laser_stops_s=2.0, until_s=4.0)
    for stamp in np.arange(5.0, 9.0, 0.1):
        robot.hears("/odom", odometry(stamp, (stamp, 0.0, 0.0)))
        robot.hears("/rear", scan(stamp - 0.01, RANGES, "rear"))
        robot.hears("/scan", scan(stamp - 0.02, RANGES))
    again = [record for record in robot.records if record.stamp > 5.2]
    assert [record.stamp for record in again] == sorted(record.stamp for record in again)
    assert sum(record.laser.T_base_laser[0] == pytest.approx(-0.3) for record in again) > 30


def test_raw_images_become_records_at_a_rate_that_is_enough():
    kinds = {**KINDS, "/image": IMAGE, "/camera_info": CAMERA_INFO}
    mounted = {**LASER, "camera": (0.1, 0.0, 0.0)}
    robot = Robot(kinds=kinds, camera="/image", info="/camera_info", mounted=mounted)
    robot.hears("/camera_info", camera_info(0.0)).drives(np.arange(1.0, 7.0))
    for step in range(10):
        robot.now_s = 0.1 * step
        robot.hears("/image", image(6.0))
    images = [record for record in robot.records if isinstance(record, CameraImage)]
    assert len(images) == 3
    assert images[0].T_odom_base == pytest.approx([6.0, 0.0, 0.0])
    assert images[0].camera.T_base_camera.translation_m == pytest.approx((0.1, 0.0, 0.0))


@pytest.mark.parametrize(("columns", "directions"), [(480, 720), (180, 360)])
def test_point_clouds_wait_for_tf_and_then_are_scans(columns, directions):
    robot = Robot(kinds={**KINDS, "/points": POINT_CLOUD}, scans=("/points",))
    measured = spinning(at_rest, (*LASER_POSE[:2], 0.4), rotation(yaw=LASER_POSE[2]), rings=8, columns=columns)

    def drives(stamps):
        for stamp in stamps:
            robot.hears("/odom", odometry(stamp, (0.0, 0.0, 0.0)))
            robot.hears("/points", cloud(stamp, measured, VELODYNE))

    drives([1.0, 1.1])
    robot.waits(PATIENCE_S + 1.0)
    assert any("waits for tf: it has no transform from 'base_link' to 'lidar'" in line for line in robot.said)
    robot.hears("/tf_static", transform(0.0, "base_link", "lidar", LASER_POSE, height_m=0.4))
    drives(1.2 + 0.1 * np.arange(2 * SCANS_FOR_RIG))
    record = robot.records[0]
    assert record.laser.T_base_laser == pytest.approx(LASER_POSE)
    assert record.laser.beam_count == directions
    assert record.sweep.duration_s == pytest.approx(PERIOD_S, rel=0.01)
    angles = record.laser.angles_rad() + LASER_POSE[2]
    errors = np.abs(record.ranges_m - plan_ranges(*LASER_POSE[:2], angles))
    assert np.nanmedian(errors) < 0.005
    assert np.isfinite(errors).mean() > 0.9


@pytest.mark.parametrize("wheels", [True, False])
def test_clouds_that_are_read_whole_come_with_the_readings_until_their_end(wheels):
    kinds = {**KINDS, "/points": POINT_CLOUD, "/imu": IMU}
    options = {} if wheels else {"odom_topic": "none"}
    options |= {"scans": ("/points",), "imu": "/imu", "in_3d": True, "mounted": LIDAR}
    robot = Robot("/odom" if wheels else None, kinds, **options)
    measured = spinning(at_rest, (*LASER_POSE[:2], 0.4), rotation(yaw=LASER_POSE[2]), columns=180)

    def drives(stamps):
        for stamp in stamps:
            robot.hears("/points", cloud(stamp, measured, VELODYNE))
            for later in stamp + np.arange(0.02, 0.11, 0.02):
                robot.hears("/imu", imu(later, 0.1))
                if wheels:
                    robot.hears("/odom", odometry(later, (later, 0.0, 0.0)))

    drives(9.0 + 0.1 * np.arange(12))
    assert robot.stamps == pytest.approx(9.0 + 0.1 * np.arange(12))
    record = robot.records[-1]
    heights = record.points_m[:, 2]
    assert np.median(heights[heights < 0.2]) == pytest.approx(0.0, abs=0.01)
    assert record.times_s.max() == pytest.approx(PERIOD_S, rel=0.02)
    assert record.origin_m == pytest.approx((*LASER_POSE[:2], 0.4))
    assert record.imu[:, 0] == pytest.approx(record.stamp + np.arange(0.02, 0.11, 0.02))
    assert record.imu[:, [3, 6]] == pytest.approx(np.tile((0.1, 9.81), (5, 1)))
    at_stamp = (record.stamp + 0.02, 0.0, 0.0) if wheels else np.full(3, np.nan)
    assert record.T_odom_base == pytest.approx(at_stamp, abs=1e-6, nan_ok=True)
    drives(0.1 * np.arange(5))
    assert robot.sensors.restarts == 1
    assert robot.stamps[-1] == pytest.approx(0.4)


def test_a_lidar_with_one_ring_is_refused_in_3d():
    robot = Robot(kinds={**KINDS, "/points": POINT_CLOUD}, scans=("/points",), in_3d=True, mounted=LIDAR)
    measured = spinning(at_rest, (*LASER_POSE[:2], 0.4), rings=1)
    for stamp in 0.1 * np.arange(1, 1 + FEWEST_FLOORS):
        robot.hears("/points", cloud(stamp, measured, VELODYNE))
    with pytest.raises(SourceError, match="/points has one ring, so it is a 2D laser; map it without --3d"):
        robot.hears("/odom", odometry(1.0, (0.0, 0.0, 0.0)))


def test_depth_images_wait_for_their_calibration():
    kinds = {**KINDS, "/depth/image": IMAGE, "/depth/camera_info": CAMERA_INFO}
    robot = Robot(kinds=kinds, scans=("/depth/image",), laser_poses=((0.0, 0.0, 0.0),))
    frame, info = depth_image(1.0, "32FC1")

    def drives(stamps):
        for stamp in stamps:
            frame.header = header(stamp, "depth_optical_frame")
            robot.hears("/odom", odometry(stamp, (0.0, 0.0, 0.0)))
            robot.hears("/depth/image", frame)

    drives([1.0, 1.1])
    robot.waits(PATIENCE_S + 1.0)
    assert any("waits for the calibration of /depth/image: /depth/camera_info is silent" in each for each in robot.said)
    robot.hears("/depth/camera_info", info)
    drives(1.2 + 0.1 * np.arange(SCANS_FOR_RIG + 1))
    record = robot.records[0]
    errors = np.abs(record.ranges_m - plan_ranges(0.0, 0.0, record.laser.angles_rad()))
    assert np.nanmedian(errors) < 0.005


def test_a_fix_of_satellite_navigation_has_the_antenna_that_tf_says():
    robot = Robot(kinds={**KINDS, "/fix": FIX}, fixes="/fix")
    robot.hears("/fix", fix(0.5, 47.0, 8.5))  # it waits until it is known where the antenna sits
    robot.hears("/tf_static", transform(0.0, "base_link", "laser"))
    robot.hears("/tf_static", transform(0.0, "base_link", "gnss", (-0.3, 0.2, 0.0)))
    robot.drives(np.arange(1.0, 9.0))
    robot.hears("/fix", fix(8.1, 47.0, 8.5)).hears("/fix", fix(8.2, 0.0, 0.0)).hears("/fix", fix(8.3, 191.0, 8.5))
    found = [record for record in robot.records if isinstance(record, GnssFix)]
    expected = [(0.5, 47.0, 8.5), (8.1, 47.0, 8.5)]
    assert [(each.stamp, each.latitude_deg, each.longitude_deg) for each in found] == expected
    assert all(each.antenna_xy == pytest.approx((-0.3, 0.2)) for each in found)
    assert robot.sensors.audit.faults()[Fault.FIX_AT_ZERO].count == 1
    assert robot.sensors.audit.faults()[Fault.NO_LATITUDE].count == 1


WALL_S = 1_700_000_000.0


@pytest.mark.parametrize("ahead_s", [18.0, -3600.0])
@pytest.mark.parametrize("in_tf", [False, True])
def test_clocks_that_differ_are_those_by_which_messages_arrive(robot, ahead_s, in_tf):
    robot = Robot(None if in_tf else "/odom", kinds={**KINDS, "/fix": FIX}, fixes="/fix", mounted=LASER)
    for now_s in WALL_S + np.arange(1.0, 15.0, 0.5):
        at, pose = now_s + ahead_s, (now_s - WALL_S, 0.0, 0.0)
        robot.hears("/fix", fix(at, 47.0, 8.5), now_s).hears("/tf", transform(now_s, "map", "odom"), now_s)
        moved = ("/tf", transform(at, "odom", "base_link", pose)) if in_tf else ("/odom", odometry(at, pose))
        robot.hears(*moved, now_s).hears("/scan", scan(now_s - 0.01, RANGES), now_s)
    scans = [record for record in robot.records if not isinstance(record, GnssFix)]
    fixes = [record for record in robot.records if isinstance(record, GnssFix)]
    assert [record.stamp for record in scans[:3]] == pytest.approx(WALL_S + np.array([0.99, 1.49, 1.99]))
    assert [record.T_odom_base[0] for record in scans[:3]] == pytest.approx([1.0, 1.5, 2.0], abs=0.03)
    assert [record.stamp for record in fixes] == pytest.approx(WALL_S + np.arange(1.0, 15.0), abs=0.03)
    assert [line.partition(" is ")[0] for line in robot.said] == [
        f"the clock of {'tf from odom to base_link' if in_tf else '/odom'}", "the clock of /fix",
    ]  # fmt: skip
    assert all(f" {ahead_s:.2f}" in line.replace(f"{ahead_s + 0.01:.3f}", f"{ahead_s:.2f}") for line in robot.said)


@pytest.mark.parametrize("is_zero", [lambda k: k < 7, lambda k: k % 2 == 0, lambda k: k > 6])
def test_stamps_of_zero_are_read_by_the_clock_of_the_others(robot, is_zero):
    for k in range(20):
        now_s = 0.5 * k + 100.0
        robot.hears("/odom", odometry(now_s, (now_s, 0.0, 0.0)), WALL_S + now_s)
        robot.hears("/scan", scan(0.0 if is_zero(k) else now_s, RANGES), WALL_S + now_s)
    robot.hears("/odom", odometry(110.0, (110.0, 0.0, 0.0)), WALL_S + 110.0)
    assert robot.stamps == pytest.approx(np.arange(100.0, 110.0, 0.5))
    assert robot.said == ["/scan has messages without a stamp; the times at which they arrive count"]


def test_a_robot_that_never_stamps_has_the_times_at_which_messages_arrive(robot):
    for k in range(20):
        robot.now_s = 0.5 * k
        robot.hears("/odom", odometry(0.0, (0.5 * k, 0.0, 0.0)), WALL_S + 0.5 * k)
        robot.hears("/scan", scan(0.0, RANGES), WALL_S + 0.5 * k)
    assert robot.stamps == pytest.approx(WALL_S + np.arange(0.0, 10.0, 0.5))


def test_a_gyro_turns_a_robot_without_wheels():
    mounted = {**LASER, "imu": (0.0, 0.0, 0.0, 0.1)}
    robot = Robot(None, {**KINDS, "/imu": IMU}, imu="/imu", odom_topic="none", mounted=mounted)
    for k in range(300):
        now_s = 1.0 + 0.01 * k
        if k % 20 == 0:
            robot.hears("/scan", scan(now_s - 0.15, RANGES, beam_s=0.15 / 179))
        robot.hears("/imu", imu(now_s, 0.1 * k))
    assert robot.stamps == pytest.approx(1.0 + 0.2 * np.arange(15) - 0.15)
    for before, record in itertools.pairwise(robot.records):
        assert record.gyro[:, 1] == pytest.approx(10.0 * (record.gyro[:, 0] - 1.0), abs=1e-6)
        assert before.stamp + 0.15 <= record.gyro[0, 0] + 1e-6
        assert record.gyro[-1, 0] >= record.stamp + 0.15 - 0.011
    assert robot.hears("/scan", scan(10.0, RANGES)).stamps[-1] == 10.0  # a gyro that has stopped holds no scan


def played(path, **options):
    """A robot that hears the messages of a bag as they were recorded."""
    stored = list(RecordFile(path, ros1=False).messages())
    kinds = {each.topic: each.kind for each in stored} | {"/tf": TRANSFORMS}
    scans = tuple(sorted({"/scan", "/points"} & kinds.keys()))
    robot = Robot("/odom" if "/odom" in kinds else None, kinds, scans=scans, **options)
    for each in stored:
        robot.now_s = each.time_ns / 1e9
        robot.hears(each.topic, each.payload, robot.now_s)
    robot.records += robot.sensors.finish()
    return robot


@pytest.mark.parametrize(
    ("make", "words"),
    {
        "odometry in tf": (lambda path: save(path, in_tf()), ""),
        "a clock of its own": (lambda path: save(path, late(17.0)), "the clock of /odom is 17.0"),
        "points that lean": (lambda path: save(path, drive(**LEANING, roll=-0.5)), "the floor in /points leans"),
    }.values(),
)
def test_a_live_robot_is_read_as_its_bag(make, words, tmp_path):
    path = make(tmp_path / "run.mcap")
    source, robot = open_source(path), played(path)
    assert (words in " ".join(robot.said), words in " ".join(source.survey().notes)) == (True, True)
    of_bag, live = ([r for r in records if isinstance(r, LaserScan)] for records in (source.records(), robot.records))
    assert [scan.stamp for scan in live] == pytest.approx([scan.stamp for scan in of_bag], abs=2e-3)
    for one, other in zip(live, of_bag, strict=True):
        assert np.nanmedian(np.abs(one.ranges_m - other.ranges_m)) < 1e-3
        assert one.T_odom_base == pytest.approx(other.T_odom_base, abs=2e-3)


def turned(message, **numbers):
    """A transform with other numbers in its rotation."""
    for name, value in numbers.items():
        setattr(message.transforms[0].transform.rotation, name, value)
    return message


NAN = float("nan")


@pytest.mark.attack
@pytest.mark.parametrize("rotation", [dict.fromkeys("xyzw", NAN), {"w": 0.0, "z": 0.0}, {"w": np.inf}, {"z": 1e308}])
def test_a_mounting_that_is_no_rotation_is_told_and_the_right_one_counts(rotation):
    robot = Robot().hears("/tf_static", turned(transform(0.0, "base_link", "laser", (0.2, 0.0, 0.0)), **rotation))
    robot.drives(np.arange(1.0, 9.0))
    assert [line.partition(" (")[0] for line in robot.said] == ["/tf_static: broken messages skipped"]
    robot.hears("/tf_static", transform(0.0, "base_link", "laser")).drives(np.arange(9.0, 15.0))
    assert robot.stamps == list(np.arange(1.0, 15.0))


@pytest.mark.attack
def test_odometry_that_is_no_pose_is_told_and_left_out(robot):
    for stamp in np.arange(1.0, 9.0):
        robot.hears("/odom", odometry(stamp, (NAN, 0.0, 0.0))).drives([stamp])
    assert robot.stamps == list(np.arange(1.0, 9.0))
    assert [record.T_odom_base[0] for record in robot.records] == robot.stamps
    assert [line.partition(" (")[0] for line in robot.said] == ["/odom: broken messages skipped"]


@pytest.mark.attack
@pytest.mark.parametrize("frames", [("laser", "laser"), ("a", "laser", "a"), ("laser", "a", "b", "laser")])
def test_frames_in_a_loop_are_no_mounting(frames):
    robot = Robot()
    for parent, child in itertools.pairwise(frames):
        robot.hears("/tf_static", transform(0.0, parent, child))
    robot.drives(np.arange(1.0, 9.0)).waits(PATIENCE_S + 1.0)
    (line,) = robot.said
    assert "no transform from 'base_link' to 'laser'" in line


@pytest.mark.attack
def test_of_a_million_ranges_no_more_are_mapped_than_a_packet_holds(robot):
    million = np.full(1_000_000, 5.0)
    robot.drives(np.arange(1.0, 7.0)).hears("/scan", scan(7.0, million, increment=1e-6)).drives([8.0])
    assert robot.stamps == [*np.arange(1.0, 7.0), 8.0]  # another laser than the first scans'
    dense = Robot(mounted=LASER)
    for stamp in np.arange(1.0, 7.0):
        dense.hears("/odom", odometry(stamp, (stamp, 0.0, 0.0))).hears("/scan", scan(stamp, million, increment=3e-6))
    (mapped, *_) = [MappedScans().of(record) for record in dense.records]
    assert mapped.laser.beam_count == len(mapped.ranges_m) <= MAXIMUM_BEAMS


@pytest.mark.attack
@pytest.mark.parametrize("ahead_s", [3.0, 3600.0, 2e9])
def test_a_scan_from_the_future_costs_no_scan_after_it(robot, ahead_s):
    robot.drives(np.arange(100.0, 106.0)).drives([106.0], ahead_s).drives(np.arange(106.0, 120.0))
    assert robot.stamps[-14:] == list(np.arange(106.0, 120.0))


@pytest.mark.attack
@pytest.mark.parametrize("offset_s", [3600.0, -3600.0])
def test_a_clock_that_jumps_by_an_hour_and_back_costs_a_few_scans(robot, offset_s):
    robot.drives(np.arange(5000.0, 5010.0)).drives(np.arange(5010.0, 5030.0), offset_s)
    robot.drives(np.arange(5030.0, 5060.0)).waits(60.0)
    assert len(robot.records) >= 60 - STEPS_BACK_FOR_RESTART
    (line,) = robot.said
    assert "stepped back" in line


@pytest.mark.attack
@pytest.mark.parametrize("other", [(3600.0, 90), (-3600.0, 180)])
def test_a_second_publisher_of_another_time_or_laser_is_left_out(robot, other):
    offset_s, beams = other
    robot.drives(np.arange(5000.0, 5006.0))
    for robot.now_s in np.arange(5006.0, 5030.0):
        robot.drives([robot.now_s]).hears("/scan", scan(robot.now_s + offset_s, np.full(beams, 2.0)))
        robot.waits(robot.now_s + 0.5)
        assert robot.stamps[-1] == robot.now_s - 0.5
    assert robot.stamps == list(np.arange(5000.0, 5030.0))
