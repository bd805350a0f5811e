"""The scans of a robot as it maps them: returns only, beams far enough apart, a laser that a packet can announce."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.records import CloudScan, LaserModel, LaserScan, frozen
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.mapped_scans import MappedScans
from fcslam.wire.messages import Hello
from fcslam.wire.packets import decode, encode
from tests.lidar.worlds import ranges, room
from tests.small_fleet import driven

POSE = (0.5, 0.0, 0.3)


def laser(beams, max_range_m=20.0, turns=1.0):
    return LaserModel(beams, -np.pi, turns * 2.0 * np.pi / beams, max_range_m)


def scan_of(model):
    return LaserScan(0.0, frozen(ranges(POSE, room(), model)[0], np.float32), model, np.zeros(3))


def mapped(*scans):
    """The announced lasers, and the first keyscan."""
    _, packets = driven(scans)
    hello, keyscan = (decode(encode(packet)).body for packet in packets[:2])
    assert isinstance(hello, Hello)
    return hello.lasers, keyscan


@pytest.mark.parametrize("max_range_m", [5.0, 5.1, 5.2, 5.6, 6.1, 5.601, 8.191])
def test_a_range_at_the_maximum_is_no_return_whatever_its_decimals(max_range_m):
    model = laser(360, max_range_m)
    nothing = frozen(np.full(360, max_range_m), np.float32)
    frontend = RobotFrontend("r", RobotConfig())
    frontend.process(LaserScan(0.0, nothing, model, np.zeros(3)))
    assert len(frontend.newest.tracked.scan) == 0
    frontend.process(LaserScan(0.1, nothing - np.float32(0.1), model, np.array([0.5, 0.0, 0.0])))
    assert len(frontend.newest.tracked.scan) == 360


@pytest.mark.parametrize(("beams", "step"), [(360, 1), (1080, 1), (1440, 1), (1600, 2), (3200, 4), (7200, 10)])
def test_of_beams_closer_than_a_quarter_degree_every_kth_is_mapped_at_most_half_a_degree_apart(beams, step):
    scan = scan_of(laser(beams))
    (announced,), keyscan = mapped(scan)
    assert announced.angle_increment_rad == pytest.approx(step * 2.0 * np.pi / beams)
    np.testing.assert_allclose(announced.angles_rad(), scan.laser.angles_rad()[::step])
    np.testing.assert_allclose(keyscan.ranges_m, scan.ranges_m[::step], atol=0.0011)


@pytest.mark.parametrize(
    ("model", "step"),
    [
        (laser(3199, turns=0.75), 5),
        (replace(laser(1440), angle_increment_rad=0.00436), 1),
        (LaserModel(5, 0.0, 1e-6, 20.0), 4),
    ],
    ids=["the last beams fill no step", "a header that rounds a quarter degree", "two beams of a narrow view"],
)
def test_every_kth_beam_is_kept(model, step):
    scan = scan_of(model)
    (announced,), keyscan = mapped(scan)
    assert announced.beam_count == len(keyscan.ranges_m) == len(scan.ranges_m[::step])


def test_of_clouds_and_scans_the_same_returns_are_left_out():
    ignore, footprint = ((20.0, 70.0), (-100.0, -95.5)), ((-1.0, -1.0), (0.5, -1.0), (0.5, 2.5), (-1.0, 2.5))
    model = replace(laser(360), T_base_laser=(0.2, 0.1, 0.4))
    scan = replace(scan_of(model), ranges_m=frozen(np.linspace(0.3, 4.0, 360), np.float32))
    angles = model.T_base_laser[2] + model.angles_rad()
    ends = np.column_stack((np.cos(angles), np.sin(angles))) * scan.ranges_m[:, None] + model.T_base_laser[:2]
    points = frozen(np.column_stack((ends, np.full(360, 0.7))), np.float32)
    times, origin = frozen(np.linspace(0.0, 0.1, 360), np.float32), frozen(np.array((0.2, 0.1, 0.5)))
    cloud = CloudScan(0.0, points, times, origin, np.zeros((0, 4)), np.zeros((0, 7)))
    for mapped_scans in (MappedScans(ignore), MappedScans((), footprint), MappedScans(ignore, footprint)):
        kept, left = mapped_scans.of(scan).ranges_m > 0.0, mapped_scans.cloud(cloud)
        assert 0 < kept.sum() < 360
        assert np.array_equal(left.points_m, points[kept])
        assert np.array_equal(left.times_s, times[kept])
    assert MappedScans().cloud(cloud) is cloud


def test_a_dense_scanner_whose_beams_vary_remains_one_laser():
    """Around a quarter of a degree, the first scan decides for all."""
    counts = (1442, 1460, 1430, 1490)
    (announced,), _ = mapped(*(replace(scan_of(laser(n)), stamp=0.1 * k) for k, n in enumerate(counts)))
    assert announced.beam_count == 1442
    (announced,), _ = mapped(*(replace(scan_of(laser(n)), stamp=0.1 * k) for k, n in enumerate(counts[::-1])))
    assert announced.beam_count == 1490 // 2


def test_a_maximum_range_beyond_that_of_packets_is_announced_as_theirs():
    scan = scan_of(laser(360, 1e30))
    (announced,), keyscan = mapped(replace(scan, ranges_m=frozen(np.minimum(scan.ranges_m, 1e6), np.float32)))
    assert announced == laser(360, 1000.0)
    assert np.all(keyscan.ranges_m > 0.0)
