"""Recordings with the conventions of drivers: the path is right, or a line says why not."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.lidar.frontend import LidarConfig
from fcslam.metrics.trajectory import align
from fcslam.robot.calibrating import calibrated
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import open_source
from fcslam.sources.bags.codec import COMPRESSED_IMAGE
from fcslam.sources.source import Doubt
from tests.robot import spinning
from tests.sources.bag_messages import CODECS, Said, header, odom, quaternion, save, scan, tf
from tests.sources.clouds import plan_ranges, said

pytestmark = pytest.mark.slow

START, SCANS = 1_700_000_000.0, 90
TICKS = np.arange(0.0, 20.0, 0.01)
POSES = spinning.pose_at(TICKS) - (0.0, 0.5, 0.0)
NAN, INF = math.nan, math.inf


class Scanner(NamedTuple):
    """How a 2D scanner measures, and what its driver says."""

    beams: int = 360
    first_rad: float = -math.pi
    step_deg: float = 1.0
    """Between the beams, in the order of the message."""
    hz: float = 10.0
    turns_s: float | None = None
    """Time from the first beam of the message to the last; below 0: the last one is measured first."""
    stated_s: float | None = None
    """The same as the message says; None: as it is."""
    stamped: float = 0.0
    """When the stamp is, in shares of a turn after its begin."""
    reach_m: float = 12.0
    nothing: float = INF
    """Range without a return."""
    shortest_m: float = 0.1
    range_max: float | None = None
    grid_m: float = 0.001
    noise_m: float = 0.005
    yaw_rad: float = 0.0
    """Of the laser, in tf."""
    roll_rad: float = 0.0
    varies: int = 0
    """Beams by which the scans differ."""
    unit: float = 1.0
    """Value per metre."""
    bent: float = 1.0
    """Stated angles per angle."""
    pace: float = 1.0
    """How many times as fast the robot drives."""
    frame: str = "laser"
    line: str = ""
    """A part of the lines that are printed."""


def pose_at(times):
    """A winding drive in the room."""
    return np.stack([np.interp(times, TICKS, axis) for axis in POSES.T], axis=-1)


def scans_of(its: Scanner):
    rng = np.random.default_rng(1)
    period = 1.0 / its.hz
    duration = its.turns_s or 0.0
    for number in range(SCANS):
        count = its.beams + int(rng.integers(-its.varies, its.varies + 1)) if its.varies else its.beams
        step = math.radians(its.step_deg) * its.beams / count
        begin = number * period
        share = np.arange(count) / (count - 1)
        times = begin + np.abs(duration) * (share if duration >= 0.0 else 1.0 - share)
        angles = its.first_rad + step * np.arange(count)
        x, y, heading = pose_at(its.pace * times).T
        at = x + 0.12 * np.cos(heading), y + 0.12 * np.sin(heading)
        seen = plan_ranges(*at, heading + its.yaw_rad + (-angles if its.roll_rad else angles))
        seen = np.round((seen + rng.normal(0.0, its.noise_m, count)) / its.grid_m) * its.grid_m
        ranges = np.where(seen < its.reach_m, its.unit * seen, its.nothing)
        stated = duration if its.stated_s is None else its.stated_s
        farthest = its.reach_m if its.range_max is None else its.range_max
        yield scan(
            START + begin + its.stamped * period, ranges, frame=its.frame, angle_min=its.bent * its.first_rad,
            angle_increment=its.bent * step, range_min=its.shortest_m, range_max=farthest,
            time_increment=stated / (count - 1), bag_time=START + begin + period,
        )  # fmt: skip


def readings(seconds, every_s=0.08, late_s=0.0, scale=1.0):
    for t in np.arange(0.0, seconds + 0.5, every_s).tolist():
        x, y, heading = pose_at(t)
        yield odom(START + t + late_s, (scale * x, scale * y, heading), bag_time=START + t)


def recording(its: Scanner) -> list[Said]:
    mounting = tf(
        START, "base_link", its.frame, (0.12, 0.0, 0.2), quaternion(its.yaw_rad, its.roll_rad), topic="/tf_static"
    )
    return [mounting, *readings(SCANS / its.hz), *scans_of(its)]


def outcome(path, options=None, pace=1.0):
    """The lines that are said, and the error of the path in metres, or None if it is refused."""
    try:
        source = calibrated(open_source(path, options), LidarConfig())
        frontend = RobotFrontend("r", RobotConfig())
        for record in source.records():
            frontend.process(record)
        said = " ".join(source.survey().notes) + f" {source.faults}" * bool(source.faults)
    except SourceError as error:
        return str(error), None
    frontend.finish()
    off = []
    for track in frontend.tracks:
        true, estimated = pose_at(pace * (np.array(track.stamps) - START)), track.T_odom_base()
        off.append(se2.compose(align(true, estimated), estimated)[:, :2] - true[:, :2])
    lost = " the robot was lost" * (len(off) > 1)
    return said + lost, float(np.sqrt(np.mean(np.sum(np.vstack(off) ** 2, axis=1))))


UNIT = "they seem to be in another unit"
WRONG = (UNIT, "may be feet", "the robot's distance is 0.5", "span 3")
"""Lines about ranges and angles that are not corrected."""
SLOW, FAST = 0.2 * 359 / 360, 0.1 * 359 / 360
WIDE = {"beams": 811, "first_rad": math.radians(-135.0), "step_deg": 1.0 / 3.0}
SCANNERS = {
    # spins clockwise; the driver turns the order of the ranges and states times as if it had not
    "rplidar A1": Scanner(turns_s=-FAST, stated_s=FAST, shortest_m=0.15, yaw_rad=math.pi),
    "rplidar A3, beams by the speed of the motor": Scanner(
        turns_s=-FAST, stated_s=FAST, varies=6, beams=720, step_deg=0.5
    ),
    "sllidar, upside down": Scanner(turns_s=FAST, roll_rad=math.pi),
    "sick LMS1xx, 0 for no return": Scanner(
        541, math.radians(-135.0), 0.5, hz=25.0, turns_s=0.03, nothing=0.0, shortest_m=0.01
    ),
    "sick nanoScan3, NaN": Scanner(**WIDE, hz=12.5, turns_s=0.06, nothing=NAN),
    "hokuyo URG-04LX, a code below the least range": Scanner(
        683, math.radians(-120.0), 0.3516, turns_s=0.067, nothing=0.02, reach_m=5.6, shortest_m=0.06
    ),
    "hokuyo UTM-30LX, a value beyond range_max": Scanner(
        541, math.radians(-135.0), 0.5, hz=20.0, turns_s=0.025, nothing=65.533, range_max=30.0, reach_m=9.0
    ),
    "ydlidar X4, negative increment": Scanner(
        first_rad=math.pi, step_deg=-0.5, beams=720, turns_s=0.1, nothing=0.0, varies=5
    ),
    "ydlidar G2, stamp at the end": Scanner(
        beams=500, step_deg=0.72, turns_s=FAST, stamped=1.0, nothing=0.0, line="stamp is that of the last beam"
    ),
    "ld19, from 0 to a turn, NaN": Scanner(
        first_rad=0.0, beams=450, step_deg=0.8, turns_s=-0.0998, stated_s=0.0998, nothing=NAN, varies=2, shortest_m=0.02
    ),
    "turtlebot3 LDS-01, wrong time_increment": Scanner(
        first_rad=0.0, hz=5.0, turns_s=SLOW, stated_s=0.01, nothing=0.0, reach_m=3.5, noise_m=0.01, line="a scan takes "
    ),
    "turtlebot3 LDS-02, no times": Scanner(
        230, 0.0, 360 / 230, 5.0, SLOW, stated_s=0.0, varies=8, nothing=0.0, reach_m=8.0, line="a scan takes"
    ),
    "turtlebot4, laser to the left": Scanner(
        beams=540, step_deg=2.0 / 3.0, turns_s=-FAST, stated_s=FAST, yaw_rad=math.pi / 2, frame="rplidar_link"
    ),
    "gazebo, both ends of the turn": Scanner(beams=361, step_deg=1.0),
    "gazebo classic, range_max for no return": Scanner(nothing=3.5, reach_m=3.5, noise_m=0.01),
    "isaac sim, -1 for no return": Scanner(nothing=-1.0, reach_m=6.0),
    "depthimage_to_laserscan": Scanner(
        320, math.radians(-43.0), 86.0 / 319, hz=15.0, nothing=NAN, shortest_m=0.45, reach_m=10.0
    ),
    "lslidar N10, range_max 0": Scanner(first_rad=0.0, turns_s=-FAST, nothing=0.0, range_max=0.0, shortest_m=0.0),
    "inches": Scanner(unit=39.37, range_max=12.0 * 39.37, line=UNIT),
    "feet": Scanner(unit=1.0 / 0.3048, range_max=40.0, line="may be feet"),
    "a counter of half the time of flight": Scanner(unit=0.5, line="the robot's distance is 0.5"),
    "a turn stated as 270 deg": Scanner(bent=0.75, line="span 3"),
}


@pytest.mark.parametrize("its", SCANNERS.values(), ids=SCANNERS)
def test_a_scanner(tmp_path, its):
    said, error_m = outcome(save(tmp_path / "run.mcap", recording(its)))
    assert its.line in said
    assert its.line in WRONG or error_m < 0.005


def test_ranges_that_are_not_in_metres_speak_against_the_map(tmp_path):
    source = calibrated(open_source(save(tmp_path / "run.mcap", recording(SCANNERS["feet"]))), LidarConfig())
    assert [type(note) for note in source.survey().notes if "may be feet" in note] == [Doubt]


LASER = Scanner(turns_s=FAST)


def in_tf():
    for each in recording(LASER):
        if each.topic != "/odom":
            yield each
            continue
        x, y, z = each.fields["at"]
        yield tf(each.fields["stamp"], "odom", "base_footprint", (x, y, z), each.fields["rotation"])
    yield tf(START, "base_footprint", "base_link", topic="/tf_static")


def never_set():
    """A topic of odometry that never moves, beside the tf of the same robot."""
    yield from in_tf()
    yield from (each._replace(fields={**each.fields, "at": (0.0, 0.0, 0.0), "rotation": quaternion(0.0),
                                      "child": "base_footprint"}) for each in readings(9.0))  # fmt: skip


def late(seconds):
    """Odometry by a clock of its own."""
    mounting, *_ = recording(LASER)
    return [mounting, *readings(9.0, late_s=seconds), *scans_of(LASER)]


def slashed():
    """Frames of old ROS 1."""
    for each in recording(LASER):
        names = {key: f"/{each.fields[key]}" for key in ("frame", "parent", "child") if key in each.fields}
        yield each._replace(fields={**each.fields, **names})


def scaled():
    mounting, *_ = recording(LASER)
    return [mounting, *readings(9.0, scale=1 / 1.2), *scans_of(LASER)]


def with_ranges(change):
    """``change`` is given the time of each scan and its ranges."""
    for each in recording(LASER):
        if each.topic == "/scan":
            ranges = change(each.fields["stamp"] - START, np.array(each.fields["ranges"]))
            each.fields["ranges"] = ranges
        yield each


def posts(_, ranges):
    """Four posts of the robot hide a part of the view."""
    at = (np.arange(4)[:, None] * 90 + 40 + np.arange(5)).ravel()
    ranges[at] = 0.25
    return ranges


def operator(time, ranges):
    """Somebody walks 1 m behind the robot."""
    legs = np.arange(-8, 9) + round(4 * math.sin(3.0 * time))
    ranges[legs[np.abs(legs) > 2]] = 1.0
    return ranges


def with_odometry(change):
    """``change`` is given the number of each reading and its pose, and returns the pose."""
    mounting, *_ = recording(LASER)
    stamps = [START + 0.04 * k for k in range(238)]
    said = [odom(stamp, change(k, *pose_at(stamp - START)), bag_time=stamp) for k, stamp in enumerate(stamps)]
    return [mounting, *said, *scans_of(LASER)]


def begun_again(pose):
    return tuple(se2.between(pose_at(4.0), np.array(pose)))


def bursts():
    """Readings that are recorded five at a time."""
    return [
        each._replace(bag_time=START + 0.5 * math.ceil(2.0 * (each.fields["stamp"] - START)))
        if each.topic == "/odom"
        else each
        for each in recording(LASER)
    ]


def packed_depth():
    message = CODECS[False].make(COMPRESSED_IMAGE, header=header(START, "camera"), data=np.zeros(20, np.uint8))
    return [*readings(1.0), said("/depth/image_raw/compressedDepth", START, message, COMPRESSED_IMAGE)]


ROBOTS = {
    "turtlebot4: odometry in tf": (in_tf, ""),
    "odometry that is set in tf only": (never_set, "/odom never changes"),
    "micro-ROS: a clock of its own": (lambda: late(0.25), "the clock of the odometry is 250 ms ahead"),
    "micro-ROS: a clock since boot": (lambda: late(5.0 - START), "by the times of recording; corrected"),
    "frames with a slash": (slashed, ""),
    "wheels of another radius": (scaled, "the robot's distance is 1.19"),
    "odometry that begins again": (lambda: with_odometry(lambda k, *its: its if k < 100 else begun_again(its)), ""),
    "two publishers that agree": (lambda: with_odometry(lambda k, x, y, a: (x + 0.01 * (k % 2), y, a)), ""),
    "two publishers that differ": (
        lambda: with_odometry(lambda k, x, y, a: (x + 5.0 * (k % 2), y, a)),
        "the scans contradict the odometry",
    ),
    "odometry in millimetres": (
        lambda: with_odometry(lambda _, x, y, a: (1000.0 * x, 1000.0 * y, a)),
        "the robot's distance is 0.001",
    ),
    "bursts of odometry": (bursts, ""),
    "posts of the robot": (lambda: with_ranges(posts), ""),
    "legs of the operator": (lambda: with_ranges(operator), ""),
    "compressed depth images": (packed_depth, "record /depth/image_raw;"),
}


@pytest.mark.parametrize(("make", "line"), ROBOTS.values(), ids=ROBOTS)
def test_a_robot(tmp_path, make, line):
    messages, error_m = outcome(save(tmp_path / "run.mcap", make()))
    assert line in messages
    assert "contradict" not in messages or "contradict" in line
    assert error_m is None or error_m < 0.01
