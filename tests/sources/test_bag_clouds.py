"""Bags whose scans come as point clouds, depth images or sectors, or with a range_max of their own."""

import math
from functools import cache

import numpy as np
import pytest

from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.lidar.frontend import LidarConfig
from fcslam.records import LaserScan
from fcslam.robot.calibrating import calibrated
from fcslam.sources import BagOptions, open_source
from fcslam.sources.bags.codec import CAMERA_INFO, IMAGE
from fcslam.sources.inspection import inspect
from tests.sources.bag_messages import header, odom, quaternion, save, scan, tf
from tests.sources.carmen_text import refusal, scans_of
from tests.sources.clouds import (
    OUSTER,
    REALSENSE,
    VELODYNE,
    Measured,
    cloud,
    depth_image,
    plan_ranges,
    rotation,
    said,
    scattered,
    spinning,
)

pytestmark = pytest.mark.slow

START = 1_700_000_000.0
OPTICAL_XYZW = (-0.5, 0.5, -0.5, 0.5)
"""Of a camera: z forward, x right, y down: a turn of -90 degrees about z after one of -90 degrees about x."""
LIDAR, YAW = (0.1, 0.05, 0.4), 0.3


def pose_at(times):
    """A circle in the room that the robot drives, shape (N, 3)."""
    turn = 0.8 * np.asarray(times)
    return np.stack((0.5 * np.sin(turn), 1.5 - 0.5 * np.cos(turn), turn), axis=1)


@cache
def seen(stamp, columns=480, rings=6, **leans):
    """The cloud of the turn that begins ``stamp`` seconds after the start."""
    return spinning(lambda times: pose_at(stamp + times), LIDAR, rotation(yaw=YAW, **leans), rings, columns)


def drive(seconds=2.0, every_s=0.1, layout=VELODYNE, body=None, ros1=False, stated=(), **scanner):
    """Odometry at 50 Hz and clouds of a turning scanner at 10 Hz; ``body``: points that it always sees, too.

    ``stated`` is how it leans in tf, ``scanner`` how it does, and what it sees.
    """
    messages = [tf(START, "base_link", "lidar", LIDAR, quaternion(YAW, **dict(stated)), topic="/tf_static")]
    for t in np.arange(0.0, seconds + 0.5, 0.02):
        messages.append(odom(START + t, pose_at([t])[0], bag_time=START + t))
    for t in np.arange(0.1, seconds, every_s).round(3).tolist():
        measured = seen(t, **scanner)
        if body is not None:
            points, times = np.vstack((measured.points, body)), np.append(measured.times, np.zeros(len(body)))
            measured = Measured(points, times)
        messages.append(said("/points", START + t, cloud(START + t, measured, layout, ros1=ros1), ros1=ros1))
    return messages


def misfit_m(records):
    """Median distance of the returns from the walls, each placed where the robot was at its time."""
    errors = []
    for record in (each for each in records if isinstance(each, LaserScan)):
        beams, sweep = record.laser.beams, record.sweep
        times = np.linspace(sweep.first_s, sweep.last_s, beams.beam_count) if sweep else np.zeros(beams.beam_count)
        angles = beams.angle_min_rad + beams.angle_increment_rad * np.arange(beams.beam_count)
        poses = np.array(
            [se2.compose(pose, np.array(record.laser.T_base_laser)) for pose in pose_at(record.stamp - START + times)]
        )
        errors.append(record.ranges_m - plan_ranges(poses[:, 0], poses[:, 1], poses[:, 2] + angles))
    return np.nanmedian(np.abs(errors))


@pytest.mark.parametrize(("suffix", "layout"), [(".mcap", VELODYNE), (".db3", OUSTER), (".bag", VELODYNE)])
def test_a_cloud_is_the_scan_of_a_laser_in_its_place(tmp_path, suffix, layout):
    path = save(tmp_path / f"drive{suffix}", drive(ros1=suffix == ".bag", layout=layout))
    source = open_source(path)
    records = scans_of(source)
    assert len(records) == 19
    assert source.survey().lasers[0].T_base_laser == pytest.approx((0.1, 0.05, 0.3))
    assert all(record.sweep.velocity[2] == pytest.approx(0.8, abs=0.01) for record in records)
    assert misfit_m(records) < 0.01


def test_the_scans_of_a_sparse_scanner_have_fewer_directions(tmp_path):
    source = open_source(save(tmp_path / "sparse.mcap", drive(columns=180)))
    assert source.survey().lasers[0].beam_count == 360
    records = scans_of(source)
    assert {record.laser.beam_count for record in records} == {360}
    assert misfit_m(records) < 0.02


def test_points_in_no_order_are_moved_to_where_they_are_seen_at_one_time(tmp_path):
    messages = [each for each in drive() if each.topic != "/points"]
    for t in np.arange(0.1, 1.5, 0.1).round(3).tolist():
        measured = scattered(lambda times, t=t: pose_at(t + times), 8000, LIDAR, rotation(yaw=YAW))
        messages.append(said("/livox", START + t, cloud(START + t, measured, VELODYNE)))
    records = scans_of(open_source(save(tmp_path / "livox.mcap", messages)))
    assert all(record.sweep is None for record in records)
    assert [record.stamp - START for record in records] == pytest.approx(0.15 + 0.1 * np.arange(14), abs=1e-3)
    assert misfit_m(records) < 0.01


def test_laser_scans_are_preferred_unless_the_cloud_is_named(tmp_path):
    ranges = np.full(90, 3.0)
    scans = [scan(START + t, ranges, angle_increment=math.pi / 90) for t in np.arange(0.1, 2.0, 0.1)]
    laser = tf(START, "base_link", "laser", topic="/tf_static")
    path = save(tmp_path / "both.mcap", [*drive(), laser, *scans])
    chosen, named = inspect(path), inspect(path, BagOptions(scan_topics=("/points",)))
    assert chosen.lasers[0].model.beam_count == 90
    assert any("reads laser scans from /scan, not from /points" in note for note in chosen.notes)
    assert named.lasers[0].model.beam_count == 720
    assert any("the scans of /points are its nearest points from 0.1 m to 0.6 m" in note for note in named.notes)


def test_a_cloud_without_a_mounting_is_refused_in_one_line(tmp_path):
    path = save(tmp_path / "bare.mcap", [each for each in drive() if each.topic != "/tf_static"])
    with pytest.raises(SourceError, match=r"no transform from 'base_link' to 'lidar'.*--sensors laser-pose") as refused:
        open_source(path).survey()
    assert "\n" not in str(refused.value)
    by_hand = open_source(path, BagOptions(laser_poses=((0.1, 0.05, 0.3),)))
    assert misfit_m(by_hand.records()) < 0.01


@pytest.mark.parametrize(("frame", "has_tf"), [("odom", True), ("odom", False), ("camera_init", False)])
def test_clouds_that_another_node_moved_are_refused_with_what_to_record(tmp_path, frame, has_tf):
    messages = [each for each in drive() if each.topic != "/points"]
    for t in np.arange(0.1, 2.0, 0.1).round(3).tolist():
        messages.append(said("/points", START + t, cloud(START + t, seen(t), VELODYNE, frame)))
        x, y, theta = pose_at([t])[0].tolist()
        messages += [tf(START + t, "odom", "base_link", (x, y, 0.0), quaternion(theta))] * has_tf
    with pytest.raises(
        SourceError, match=f"in '{frame}', in which the robot drives, so another node has moved them; record"
    ):
        open_source(save(tmp_path / "moved.mcap", messages)).survey()


@pytest.mark.parametrize("parts", [10, 60])
def test_clouds_of_a_part_of_a_turn_are_mapped_if_they_show_walls(tmp_path, parts):
    messages = [each for each in drive() if each.topic != "/points"]
    for t in np.arange(0.1, 2.0, 0.1).round(3).tolist():
        measured = seen(t)
        for rows in np.array_split(np.arange(len(measured.points)), parts):
            first_s = measured.times[rows[0]]
            part, stamp = Measured(measured.points[rows], measured.times[rows] - first_s), START + t + first_s
            messages.append(said("/points", stamp, cloud(stamp, part, VELODYNE)))
    path = save(tmp_path / "parts.mcap", messages)
    if parts == 10:
        assert misfit_m(open_source(path).records()) < 0.01
    else:
        assert "check that the laser is not covered, that a cloud is a whole turn" in refusal(path)


@pytest.mark.parametrize("unit", [1000.0, 100.0, 1.0 / 0.3048])
def test_a_cloud_in_another_unit_is_refused_with_what_to_check(tmp_path, unit):
    def scaled(name, kind, offset, value):
        return name, kind, offset, (lambda measured: unit * value(measured)) if name in "xyz" else value

    layout = VELODYNE[0], [scaled(*field) for field in VELODYNE[1]]
    with pytest.raises(SourceError, match=r"points are in metres|publish them in metres"):
        open_source(save(tmp_path / "run.mcap", drive(layout=layout))).survey()


@pytest.mark.parametrize(
    ("columns", "angles"), [(480, np.linspace(-2.5, 2.5, 400)), (180, np.radians(np.arange(-144.0, 145.0, 2.0)))]
)
def test_a_body_that_is_wider_than_usual_is_left_out_with_a_note(tmp_path, columns, angles):
    deck = np.stack((0.7 * np.cos(angles), 0.7 * np.sin(angles), np.full(len(angles), -0.1)), axis=1)
    bag = open_source(save(tmp_path / "deck.mcap", drive(8.6, 0.4, REALSENSE, deck, columns=columns)))
    source = calibrated(bag, LidarConfig())
    assert any("from the base belong to the robot and are left out" in note for note in source.survey().notes)
    assert min(np.nanmin(each.ranges_m) for each in scans_of(source)) > 0.75


@pytest.mark.parametrize(("frame", "xyzw"), [("optical_frame", OPTICAL_XYZW), ("camera_link", quaternion())])
def test_depth_images_are_scans(tmp_path, frame, xyzw):
    mounting = tf(START, "base_link", frame, (0.0, 0.0, 0.3), xyzw, topic="/tf_static")
    messages = [mounting, *(odom(START + t, (0.0, 0.0, 0.0), bag_time=START + t) for t in np.arange(0.0, 1.5, 0.1))]
    image, info = depth_image(START, "16UC1")
    for t in np.arange(0.2, 1.0, 0.1):
        image.header = info.header = header(START + t, frame)
        messages.append(said("/camera/depth/image_rect_raw", START + t, image, IMAGE))
        messages.append(said("/camera/depth/camera_info", START + t, info, CAMERA_INFO))
    found = inspect(save(tmp_path / "depth.mcap", messages))
    assert found.problem is None
    assert any("looks up, so 'camera_link' is not" in note for note in found.notes) == (frame == "camera_link")
    assert (found.scans, found.camera) == (8, None)
    record, *_ = scans_of(open_source(tmp_path / "depth.mcap"))
    beams, heading = record.laser.beams, record.laser.T_base_laser[2]
    angles = beams.angle_min_rad + beams.angle_increment_rad * np.arange(beams.beam_count) + heading
    errors = np.abs(record.ranges_m - plan_ranges(0.0, 0.0, angles))
    assert np.nanmedian(errors) < 0.005
    assert np.isfinite(errors).mean() == pytest.approx(2 * math.atan(80 / 95) / math.tau, abs=0.02)


BEAMS, TURN_S = 180, 0.2
SPACING_RAD = math.tau / BEAMS


def sectors(count, clockwise=False, skipped=(), turns=12, blind=()):
    """Sectors of turns of ``BEAMS`` beams, each measured at its own time while the robot drives."""
    messages = [tf(START, "base_link", "laser", (0.0, 0.0, 0.3), topic="/tf_static")]
    messages += [
        odom(START + t, pose_at([t])[0], bag_time=START + t) for t in np.arange(0.0, turns * TURN_S + 0.5, 0.02)
    ]
    size, sign = BEAMS // count, -1.0 if clockwise else 1.0
    for number in range(turns * count):
        if number in skipped or number % count in blind:
            continue
        first_s = number * TURN_S / count
        times = first_s + np.arange(size) * TURN_S / BEAMS
        angles = sign * (-math.pi + (number % count * size + np.arange(size)) * SPACING_RAD)
        poses = pose_at(times)
        ranges = plan_ranges(poses[:, 0], poses[:, 1], poses[:, 2] + angles)
        message = scan(
            START + first_s, ranges, angle_min=angles[0], angle_increment=sign * SPACING_RAD,
            time_increment=TURN_S / BEAMS, bag_time=START + first_s + TURN_S / count,
        )  # fmt: skip
        messages.append(message)
    return messages


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("count", [2, 12])
def test_sectors_of_a_turn_are_one_scan(tmp_path, count, clockwise):
    source = open_source(save(tmp_path / "sectors.mcap", sectors(count, clockwise)))
    survey = source.survey()
    assert any("/scan are sectors of a turn" in note for note in survey.notes)
    records = scans_of(source)
    assert len(records) == 12
    assert all(np.isfinite(record.ranges_m).all() for record in records)
    assert [record.stamp - START for record in records] == pytest.approx([TURN_S * k for k in range(12)], abs=1e-5)
    assert {round(record.sweep.duration_s, 5) for record in records} == {round(TURN_S * (1 - 1 / BEAMS), 5)}
    assert misfit_m(records) < 1e-4


@pytest.mark.parametrize(
    ("count", "gaps", "missing"),
    [
        (12, {"skipped": (40, 59)}, [0] * 10 + [15, 15]),
        (4, {"blind": (0,)}, [BEAMS // 4] * 12),
        (4, {"blind": (0, 3)}, [BEAMS // 2] * 12),
    ],
    ids=["lost", "a quarter never seen", "a half never seen"],
)
def test_a_sector_that_is_missing_is_invalid(tmp_path, count, gaps, missing):
    source = open_source(save(tmp_path / "lost.mcap", sectors(count, **gaps)))
    records = scans_of(source)
    assert sorted(np.isnan(record.ranges_m).sum() for record in records) == missing
    assert misfit_m(records) < 1e-4


def test_scans_of_half_a_turn_are_no_sectors(tmp_path):
    messages = [tf(START, "base_link", "laser", topic="/tf_static")]
    for k in range(30):
        messages += [odom(START + 0.1 * k, (0.05 * k, 0.0, 0.0)), scan(START + 0.1 * k, np.linspace(1, 2, 180),
                     angle_increment=math.pi / 180)]  # fmt: skip
    source = open_source(save(tmp_path / "half.mcap", messages))
    assert len(scans_of(source)) == 30


def test_each_scan_has_its_own_limits(tmp_path):
    messages = [tf(START, "base_link", "laser", topic="/tf_static")]
    for k in range(30):
        far = 2.0 if k < 20 else 12.0
        ranges = np.array([0.3, 1.0, 1.9, 5.0, 11.0, 12.0, 1.0, 1.0])
        messages += [
            odom(START + 0.2 * k, (0.1 * k, 0.0, 0.0)),
            scan(START + 0.2 * k, ranges, range_max=far, range_min=0.1 if k < 20 else 0.5),
        ]
    source = open_source(save(tmp_path / "limits.mcap", messages))
    records = scans_of(source)
    assert source.survey().lasers[0].max_range_m == 12.0
    nan = np.nan
    assert np.array_equal(records[0].ranges_m[:6], np.float32([0.3, 1.0, 1.9, nan, nan, nan]), equal_nan=True)
    assert np.array_equal(records[-1].ranges_m[:6], np.float32([nan, 1.0, 1.9, 5.0, 11.0, nan]), equal_nan=True)


LEANING = {"rings": 16, "columns": 360}


@pytest.mark.parametrize("leans", [{"roll": -0.5}, {"pitch": 0.1}], ids=str)
def test_a_sensor_that_leans_against_tf_is_levelled(tmp_path, leans):
    right = open_source(save(tmp_path / "right.mcap", drive(stated=leans, **LEANING, **leans)))
    wrong = open_source(save(tmp_path / "wrong.mcap", drive(**LEANING, **leans)))
    assert "the floor in" not in " ".join(right.survey().notes)
    degrees = math.degrees(abs(sum(leans.values())))
    said = f"the floor in /points leans by {degrees:.0f} deg against the mounting of 'lidar'; corrected"
    assert (said in " ".join(wrong.survey().notes)) == (degrees > 10), "a little is levelled without a word"
    ranges = [np.array([each.ranges_m for each in scans_of(source)]) for source in (right, wrong)]
    both = np.isfinite(ranges[0]) & np.isfinite(ranges[1])
    assert both.mean() > 0.4
    assert np.median(np.abs(ranges[0] - ranges[1])[both]) < 0.03
