"""Scanners that spin: at rest as one that measures at once, in motion each beam from where the robot is at its time."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lab.simulation.noise import SCANNERS
from fcslam.lab.simulation.options import Building, OdometryKind, Scanner
from fcslam.lab.simulation.recording import record_robot
from fcslam.lab.simulation.route import Schedule
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.lidar.scan import beam_times, point_scan
from fcslam.records import CameraImage, LaserScan, Odometry, frozen
from fcslam.sources import open_source
from fcslam.sources.motion import moving_sweep
from tests.lab.simulation.driving import distances
from tests.sources.camera_records import same

pytestmark = pytest.mark.slow

SPINNING = [scanner for scanner, lidar in SCANNERS.items() if lidar.spin]
EXACT = {"range_noise_m": 0.0, "dropout": 0.0}


def robot(scanner, odometry=OdometryKind.GOOD, building=Building.FLAT, path_length_m=4.0, seed=1, **lidar):
    """A robot without a camera that turns at 2 rad/s."""
    settings = SimulationSettings(
        building=building, robots=1, path_length_m=path_length_m, camera=None, turn_rate_rad_s=2.0,
        lidar=SCANNERS[scanner].model_copy(update=lidar), odometry=odometry,
    )  # fmt: skip
    return simulate_fleet(settings, seed).robots[0]


def at_once(spinning):
    """The same robot with a scanner that measures all beams at once."""
    settings = spinning.settings
    return replace(
        spinning,
        settings=settings.model_copy(update={"lidar": settings.lidar.model_copy(update={"spin": 0})}),
    )


def parked(moving, k):
    """The robot where it is at scan ``k``, for three scans."""
    poses, stamps = np.tile(moving.T_building_base[k], (3, 1)), moving.stamps[:3]
    route = Schedule(frozen(np.array([0.0, 9.0])), frozen(poses[:2]))
    return replace(moving, stamps=stamps, T_building_base=frozen(poses), T_odom_base=frozen(poses), route=route)


@pytest.mark.parametrize("scanner", SPINNING)
def test_at_rest_it_measures_what_an_instantaneous_one_does(scanner):
    still = parked(robot(scanner), 20)
    pairs = list(zip(still.scans(), at_once(still).scans(), strict=True))
    assert len(pairs) == 3
    for spun, instant in pairs:
        np.testing.assert_array_equal(spun.ranges_m, instant.ranges_m)
        assert (spun.laser, instant.sweep) == (instant.laser, None)
        period_s = 1.0 / still.settings.lidar.rate_hz
        assert spun.sweep.duration_s == pytest.approx(period_s * spun.laser.beams.span_rad / (2.0 * np.pi))
        assert min(spun.sweep[:2]) == 0.0


def true_sweep(robot, scan):
    """The sweep with the true motion."""
    times = np.arange(scan.stamp - 0.1, scan.stamp + scan.sweep.duration_s + 0.1, 0.002)
    truth = [
        Odometry(stamp, pose) for stamp, pose in zip(times, robot.route.at(times - robot.first_stamp), strict=True)
    ]
    return moving_sweep(scan.sweep, scan.stamp, truth)


def wall_distances(robot, sweep_of):
    """Distance of all returns from the nearest surface, each placed by the sweep that ``sweep_of`` gives its scan."""
    placed = []
    for scan, pose in zip(robot.scans(), robot.T_building_base, strict=True):
        points = point_scan(scan.ranges_m, scan.laser, sweep_of(robot, scan)).points
        placed.append(se2.transform(pose, points[::7]))
    return distances(np.concatenate(placed), robot.plan.segments)


@pytest.mark.parametrize("scanner", SPINNING)
def test_beams_placed_by_the_true_motion_lie_on_the_walls(scanner):
    drive = robot(scanner, rate_hz=10.0, beams=450, **EXACT)
    moved, odometry, ignored = (
        wall_distances(drive, sweep) for sweep in (true_sweep, lambda _, scan: scan.sweep, lambda *_: None)
    )
    assert np.quantile(moved, 0.99) < 0.002
    assert moved.max() < 0.01
    assert np.quantile(odometry, 0.99) < 0.02
    assert np.quantile(ignored, 0.99) > 0.1


def test_speeds_change_steadily():
    instant, spinning = robot(Scanner.INSTANT).route, robot(Scanner.LD19).route
    times = np.arange(0.0, spinning.duration_s, 0.02)
    step = se2.between(spinning.at(times[:-1]), spinning.at(times[1:])) / 0.02
    assert np.abs(step[:, 2]).max() == pytest.approx(2.0, rel=1e-6)
    assert np.abs(np.diff(step, axis=0)).max() / 0.02 < 2.0 * 2.0 / 0.3 + 1e-6
    assert 0.0 < spinning.duration_s - instant.duration_s < 0.5
    np.testing.assert_allclose(spinning.poses[[0, -1]], instant.poses[[0, -1]], atol=1e-9)
    # An eased drive is 0.15 s behind, and cuts no corner.
    cut = spinning.at(times + 0.15)[:, :2] - instant.at(times)[:, :2]
    assert np.linalg.norm(cut, axis=1).max() < 0.05


@pytest.mark.parametrize("kind", OdometryKind)
def test_the_same_seed_gives_the_same_records(kind):
    drives = [list(robot(Scanner.LD19, kind, path_length_m=1.5, seed=seed).records()) for seed in (1, 1, 2)]
    first, again, other = drives
    assert len(first) == len(again) > 50 or kind is OdometryKind.NONE
    assert all(map(same, first, again))
    assert not all(map(same, first, other))


def test_records_come_in_order_and_the_motion_is_that_of_the_odometry():
    drive = robot(Scanner.LD19)
    items = list(drive.records())
    assert [item.stamp for item in items] == sorted(item.stamp for item in items)
    odometry = [item for item in items if isinstance(item, Odometry)]
    assert np.diff([reading.stamp for reading in odometry]) == pytest.approx(0.02, abs=1e-6)
    scans = [item for item in items if isinstance(item, LaserScan)]
    assert max(abs(scan.sweep.velocity[2]) for scan in scans) > 1.5
    for scan in scans:
        assert scan.sweep == moving_sweep(scan.sweep, scan.stamp, odometry)


def test_a_reset_within_a_scan_leaves_its_motion_unknown(tmp_path):
    drive = robot(Scanner.LD19, OdometryKind.RESET, building=Building.DEFAULT, path_length_m=20.0)
    reset = drive.readings.stamps[len(drive.readings.stamps) // 2]
    sweeps = [scan.sweep for scan in drive.scans() if 0.0 <= reset - scan.stamp < 0.1]
    assert [sweep.velocity for sweep in sweeps] == [(0.0, 0.0, 0.0)]
    record_robot(drive, tmp_path / "robot")


def test_without_odometry_poses_and_motion_are_unknown():
    settings = robot(Scanner.LD19, OdometryKind.NONE).settings
    items = list(simulate_fleet(settings, 1).robots[0].records())
    assert not any(isinstance(item, Odometry | CameraImage) for item in items)
    scans = [item for item in items if isinstance(item, LaserScan)]
    assert np.isnan([scan.T_odom_base for scan in scans]).all()
    assert all(scan.sweep[2:] == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for scan in scans)


@pytest.mark.parametrize("kind", [OdometryKind.GOOD, OdometryKind.NONE])
def test_recordings_hold_the_sweeps(tmp_path, kind):
    drive = robot(Scanner.RPLIDAR_A1, kind, path_length_m=2.0)
    record_robot(drive, tmp_path / "robot")
    made = [item for item in drive.records() if isinstance(item, LaserScan)]
    read = [item for item in open_source(tmp_path / "robot").records() if isinstance(item, LaserScan)]
    for before, after in zip(made, read, strict=True):
        np.testing.assert_array_equal(np.fmin(after.ranges_m, 12.0), before.ranges_m)
        np.testing.assert_allclose(after.T_odom_base, before.T_odom_base, atol=1e-6)
        np.testing.assert_allclose(
            beam_times(after.laser, after.sweep), beam_times(before.laser, before.sweep), atol=1e-6
        )
