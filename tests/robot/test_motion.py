"""Robots with a scanner that spins: with odometry, without, and with odometry that is wrong."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.frontend import LidarConfig
from fcslam.records import CameraImage, CameraModel, Keyscan, Odometry, Transform, frozen
from fcslam.robot.calibrating import _tracked, calibrate_bag, calibrated
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import open_source, write_bag
from tests.lidar.worlds import chain
from tests.robot import spinning
from tests.small_fleet import driven

pytestmark = pytest.mark.slow


def integrated(scale=1.0, turn=1.0, slip=None):
    """Odometry that measures the true motion wrongly."""
    ticks = np.arange(0.0, 25.0, 0.02)
    steps = se2.relative(spinning.pose_at(ticks)) * (scale, scale, turn)
    if slip is not None:
        steps[slip] *= (0.4, 0.4, 0.6)
    known = chain(steps)
    known[:, 2] = np.unwrap(known[:, 2])
    return lambda stamp: np.array([np.interp(stamp, ticks, axis) for axis in known.T])


def held(odometry):
    """Odometry that is updated at 5 Hz and published more often."""
    return lambda stamp: odometry(np.floor(5.0 * stamp + 1e-6) / 5.0)


def reset(odometry, at=(6.0, 11.0)):
    """Odometry that starts at zero again at each of these times."""
    return lambda stamp: se2.between(
        odometry(max((time for time in at if time <= stamp), default=0.0)), odometry(stamp)
    )


def without_heading(odometry):
    return lambda stamp: odometry(stamp) * (1.0, 1.0, 0.0)


READINGS = np.arange(0.0, 20.5, 0.02)


def write_drive(path, *items):
    """A bag of readings and scans."""
    write_bag(path, [replace(i, stamp=i.stamp + spinning.BEGIN_S) for i in sorted(items, key=lambda item: item.stamp)])


@pytest.mark.parametrize(
    ("odometry", "delay_s"),
    [
        (integrated(), 0.0),
        (integrated(scale=1.15), 0.0),
        (integrated(scale=0.87, turn=0.9), 0.0),
        (integrated(turn=1.1), 0.0),
        (integrated(slip=slice(300, 450)), 0.0),
        (held(integrated()), 0.0),
        (reset(integrated()), 0.0),
        (integrated(), 0.2),
        (without_heading(integrated()), 0.0),
        (lambda _: np.zeros(3), 0.0),
        (None, 0.0),
    ],
    ids=[
        "right", "15 % too long", "short and turns too little", "turns 10 % too far", "slips on a carpet",
        "steps at 5 Hz", "starts at zero again", "stamps are 0.2 s late", "heading never set", "always zero", "none",
    ],
)  # fmt: skip
def test_a_bag_of_a_scanner_that_spins_maps_a_room(tmp_path, odometry, delay_s):
    readings = () if odometry is None else [Odometry(t + delay_s, frozen(odometry(t))) for t in READINGS.tolist()]
    write_drive(tmp_path / "r.mcap", *readings, *spinning.drive())
    config = RobotConfig()
    frontend, packets = driven(calibrated(open_source(tmp_path / "r.mcap"), config.lidar).records(), config)
    assert len(frontend.tracks) == 1
    assert spinning.error_m(frontend.tracks[0]) < 0.02
    keyscans = [packet.body for packet in packets if isinstance(packet.body, Keyscan)]
    assert max(abs(keyscan.sweep.velocity[2]) for keyscan in keyscans) > 1.0


@pytest.mark.parametrize(
    ("first_s", "last_s"), [(0.0, spinning.SWEEP_S), (spinning.SWEEP_S, 0.0), (0.0, 0.0)], ids=["ccw", "cw", "at once"]
)
def test_without_odometry_the_motion_shows_the_times_of_beams_that_a_bag_does_not_state(tmp_path, first_s, last_s):
    rng, beams_s = np.random.default_rng(3), np.linspace(first_s, last_s, spinning.LASER.beam_count)
    scans = [
        replace(scan, ranges_m=frozen(spinning.ranges_at(scan.stamp + beams_s, rng), np.float32))
        for scan in spinning.drive(states_sweep=False)
    ]
    write_drive(tmp_path / "r.mcap", *scans)
    bag = open_source(tmp_path / "r.mcap")
    sweep = calibrate_bag(bag, LidarConfig()).correction.sweep
    assert sweep is None if first_s == last_s else sweep == pytest.approx((first_s, last_s), abs=0.003)
    frontend, _ = driven(calibrated(bag, LidarConfig()).records())
    assert len(frontend.tracks) == 1
    assert spinning.error_m(frontend.tracks[0]) < 0.01


def test_a_drive_along_one_circle_fixes_no_mounting(tmp_path, monkeypatch):
    def circle(stamps):
        turn = 0.8 * np.asarray(stamps, float)
        return np.stack((0.5 * np.sin(turn), 0.5 - 0.5 * np.cos(turn), turn), axis=-1)

    monkeypatch.setattr(spinning, "pose_at", circle)
    readings = [Odometry(t, frozen(circle(t))) for t in READINGS.tolist()]
    write_drive(tmp_path / "r.mcap", *readings, *spinning.drive())
    frontend, _ = driven(calibrated(open_source(tmp_path / "r.mcap"), LidarConfig()).records())
    assert spinning.error_m(frontend.tracks[0]) < 0.02


def test_the_duration_of_a_scan_can_be_a_setting():
    config = RobotConfig(lidar=LidarConfig(scan_duration_s=spinning.SWEEP_S))
    frontend, _ = driven(spinning.drive(odometry=spinning.pose_at, states_sweep=False), config)
    assert len(frontend.tracks) == 1
    assert spinning.error_m(frontend.tracks[0]) < 0.03


@pytest.mark.parametrize("begin_s", [1.0, 1.6, 4.0])
@pytest.mark.parametrize(("rate_hz", "most_m"), [(7.0, 0.005), (5.0, 0.01), (4.0, 0.025)])
def test_without_odometry_a_robot_that_begins_in_a_turn_is_driven(begin_s, rate_hz, most_m):
    """It turns at up to 1.6 rad/s, so by 0.4 rad during a scan, and brakes at 2 rad/s^2."""
    frontend, _ = driven(spinning.drive(begin_s=begin_s, scan_s=1.0 / rate_hz))
    assert len(frontend.tracks) == 1
    assert len(frontend.tracks[0]) == round(20.0 * rate_hz)
    assert spinning.error_m(frontend.tracks[0]) < most_m


def with_gyro(scans, scan_s, bias=0.01):
    """Scans with readings of a gyro, 100 a second, up to their last beam."""
    rng, begin_s = np.random.default_rng(1), -np.inf
    for scan in scans:
        times = np.arange(max(begin_s, scan.stamp), scan.stamp + scan_s + 0.01, 0.01)
        rates = 0.9 * np.sin(0.8 * times) + 0.7 * np.sin(1.9 * times)
        yield replace(scan, gyro=np.column_stack((times, rates + bias + rng.normal(0.0, 0.003, len(times)))))
        begin_s = times[-1] + 0.01


@pytest.mark.parametrize(("rate_hz", "most_m"), [(7.0, 0.003), (3.0, 0.005)])
def test_without_odometry_a_gyro_tells_how_the_robot_turns_during_a_scan(rate_hz, most_m):
    """At 3 Hz, scans alone lead to errors of 0.05 m."""
    scans = spinning.drive(begin_s=4.0, scan_s=1.0 / rate_hz)
    frontend, _ = driven(with_gyro(scans, 1.0 / rate_hz))
    assert len(frontend.tracks) == 1
    assert spinning.error_m(frontend.tracks[0]) < most_m


def test_calibration_leaves_the_gyro_out():
    """Its turns in the assumed sweep would hide what the points say about the times of the beams."""
    blind = list(spinning.drive(5.0, states_sweep=False))
    plain, turned = (
        _tracked(scans, LidarConfig(), spinning.SCAN_S)[0] for scans in (iter(blind), with_gyro(blind, spinning.SCAN_S))
    )
    assert np.array_equal(plain.turned_rad, turned.turned_rad, equal_nan=True)


@pytest.mark.parametrize("at_s", [9.0, 10.0])
def test_without_odometry_a_robot_put_into_another_room_during_its_drive_is_lost(at_s):
    elsewhere = spinning.WALLS * (1.3, 1.5, 1.3, 1.5) + (0.5, 1.0, 0.5, 1.0)
    drives = spinning.drive(at_s), spinning.drive(14.0, begin_s=at_s, walls=elsewhere)
    frontend, _ = driven(scan for part in drives for scan in part)
    assert [len(track) * spinning.SCAN_S for track in frontend.tracks] == pytest.approx([at_s, 14.0], abs=0.4)
    assert spinning.error_m(frontend.tracks[1]) < 0.01


def cut(scans, begin_s, end_s):
    return [scan for scan in scans if not begin_s <= scan.stamp < end_s]


@pytest.mark.parametrize(
    "gaps", [[(7.0, 10.5)], [(8.0, 10.5), (11.0, 13.5)], [(5.0, 7.5), (9.0, 10.2)], [(7.0, 10.5), (12.0, 13.2)]]
)
def test_without_odometry_a_robot_that_drives_on_in_gaps_of_its_scans_is_found_again(gaps):
    """It moves by up to 1.0 m and 2.1 rad in a gap. A few scans between two gaps enter no map at a wrong place."""
    scans = list(spinning.drive(25.0))
    for gap in gaps:
        scans = cut(scans, *gap)
    frontend, _ = driven(scans)
    assert sum(len(track) for track in frontend.tracks) == len(scans)
    assert len(frontend.tracks) == 1 or len(gaps) == 2
    assert all(spinning.error_m(track) < 0.01 * len(gaps) for track in frontend.tracks)


@pytest.mark.parametrize(("moved_s", "sessions"), [(0.0, 1), (12.0, 2)])
def test_after_a_long_gap_without_odometry_a_robot_must_be_where_it_was(moved_s, sessions):
    """It moves by 2.5 m."""
    later = (replace(scan, stamp=scan.stamp + 60.0 - moved_s) for scan in spinning.drive(8.0, begin_s=9.0 + moved_s))
    frontend, _ = driven([*spinning.drive(9.0), *later])
    assert len(frontend.tracks) == sessions


def test_the_first_scan_without_odometry_has_a_pose_before_the_second_comes():
    scans, frontend = list(spinning.drive(2.0)), RobotFrontend("r", RobotConfig())
    assert frontend.process(scans[0]) == []
    assert frontend.newest.is_deferred
    np.testing.assert_array_equal(frontend.scan_poses.in_odom(frontend.newest.pose), np.zeros(3))
    assert {type(packet.body) for packet in frontend.process(scans[1])} >= {Keyscan}
    assert not frontend.newest.is_deferred
    alone, packets = driven(scans[:1])
    assert len(alone.scan_poses) == 1
    assert sum(isinstance(packet.body, Keyscan) for packet in packets) == 1


def test_the_first_scan_without_odometry_is_of_the_floor_before_a_change():
    scans, frontend = list(spinning.drive(2.0)), RobotFrontend("r", RobotConfig())
    frontend.process(scans[0])
    frontend.change_floor("2")
    for scan in scans[1:]:
        frontend.process(scan)
    assert [(track.floor, len(track)) for track in frontend.tracks] == [("", 1), ("2", len(scans) - 1)]


def test_a_robot_at_rest_keeps_its_odometry():
    scan = next(iter(spinning.drive(odometry=spinning.pose_at)))
    frontend, _ = driven([scan] * 40)
    assert frontend.motion.model.is_measured
    assert len(frontend.tracks) == 1


def test_without_odometry_an_image_is_where_the_robot_was_at_its_stamp():
    camera = CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0, Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    scans, frontend = list(spinning.drive(8.0)), RobotFrontend("r", RobotConfig())
    errors = []
    for scan, after in pairwise(scans):
        frontend.process(scan)
        half = 0.5 * (after.stamp - scan.stamp)
        image = CameraImage(scan.stamp + half, b"", camera, np.full(3, np.nan))
        placed = frontend.motion.place_image(image).T_odom_base
        true = se2.between(spinning.pose_at(scan.stamp), spinning.pose_at(scan.stamp + half))
        if placed is not None:
            newest = frontend.motion.place_image(replace(image, stamp=scan.stamp)).T_odom_base
            errors.append(se2.between(true, se2.between(newest, placed)))
    assert len(errors) > 0.8 * len(scans)
    assert (np.median(np.abs(errors), axis=0) < (0.002, 0.002, 0.01)).all()
