"""Laws of the rooms of 3D LiDARs, each against a right value that is computed in another way."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se3
from fcslam.geometry.voxels import VOXEL_STEPS, voxelised
from fcslam.lidar3d.ground import Vertical, levelled
from fcslam.lidar3d.local_maps import Keyframes
from fcslam.lidar3d.surfels import POINT_SIGMA_M, SurfelMap
from fcslam.lidar3d.tracker import Tracked, Tracker3d, without_noise
from fcslam.records import STEP_M
from fcslam.sources.clouds_in_space import FEWEST_ON_FLOOR, floor_at
from tests.spinning_lidar import PERIOD_S, circle, drive, room

PLANE = np.array([0.4, 0.4, 0.1])
"""Middle of the one voxel of 0.8 m in which the tests of surfels have their plane."""


def floor_and_furniture(generator: np.random.Generator, noise_m: float) -> np.ndarray:
    """Points of a level floor at height 0, and of a wall and a table on it."""
    floor = np.column_stack((generator.uniform(-6.0, 6.0, (4000, 2)), generator.normal(0.0, noise_m, 4000)))
    wall = np.column_stack((np.full(600, 2.5), generator.uniform((-3.0, 0.0), (3.0, 2.5), (600, 2))))
    table = np.column_stack((generator.uniform((-2.0, 1.0), (-1.0, 2.0), (400, 2)), np.full(400, 0.7)))
    return np.concatenate((floor, wall, table))


@pytest.mark.parametrize("tilt_rad", [(0.0, 0.0), (0.06, 0.0), (0.0, -0.06), (0.03, 0.04)])
@pytest.mark.parametrize("height_m", [-0.05, 0.0, 0.08])
def test_the_ground_of_a_leaning_base_is_level_whatever_its_mounting(
    tilt_rad: tuple[float, float], height_m: float
) -> None:
    ground = floor_and_furniture(np.random.default_rng(1), 0.01)
    T_ground_base = np.array([0.0, 0.0, height_m, *se3.exp(np.array([0.0, 0.0, 0.0, *tilt_rad, 0.0]))[3:]])
    floor = floor_at(se3.transform(se3.inverse(T_ground_base), ground))
    assert floor is not None
    normal, distance_m = floor
    truth = se3.rotation(T_ground_base)[2]
    assert np.arccos(min(1.0, normal @ truth)) < 0.008, "the foot of the wall leans, too"
    assert distance_m == pytest.approx(-height_m, abs=0.01)
    T_base_ground = levelled(se3.IDENTITY, normal, -distance_m)
    heights = se3.transform(se3.inverse(T_base_ground), se3.transform(se3.inverse(T_ground_base), ground))[:, 2]
    assert heights == pytest.approx(ground[:, 2], abs=0.06)
    assert se3.rotation(T_base_ground)[1, 0] == pytest.approx(tilt_rad[0] * tilt_rad[1], abs=1e-3), (
        "heading of the base"
    )


def test_no_floor_is_found_in_a_wall_or_in_a_strip() -> None:
    generator = np.random.default_rng(2)
    wall = np.column_stack((np.full(500, 1.0), generator.uniform(-3.0, 3.0, (500, 2))))
    strip = np.column_stack((generator.uniform(-3.0, 3.0, 500), generator.normal(0.0, 0.1, 500), np.zeros(500)))
    assert floor_at(wall) is None
    assert floor_at(strip) is None
    assert floor_at(strip[: FEWEST_ON_FLOOR - 1]) is None


def test_up_is_that_of_most_floors_though_a_robot_starts_on_a_ramp() -> None:
    generator, vertical = np.random.default_rng(3), Vertical()
    ramp, level = np.array([-0.12, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
    for direction in [*4 * [ramp], *8 * [level]]:
        vertical.add(direction + generator.normal(0.0, 0.005, 3))
    assert np.arccos(vertical.up @ level) < 0.005
    for _ in range(7):
        vertical.add(ramp)
    assert vertical.up @ level < 0.995, "most of the drive was on the ramp"


def circles(t: float) -> np.ndarray:
    """Position and heading of a robot that speeds up to 1 m/s and drives on along a circle of 1.5 m."""
    way = 0.25 * t**2 if t < 2.0 else t - 1.0
    return np.array([1.5 * np.cos(way / 1.5), 1.5 * np.sin(way / 1.5), way / 1.5 + np.pi / 2])


def stop_and_go(t: float) -> np.ndarray:
    """The same of one that speeds up within 1 s to 1 m/s, drives, brakes, and stands for 2 s, again and again."""
    laps, s = divmod(t, 6.0)
    return np.array([2.0 * laps + np.interp(s, np.linspace(0.0, 4.0, 41), np.cumsum(SPEEDS) / 10.0), 0.0, 0.0])


SPEEDS = np.concatenate((np.arange(0.05, 1.0, 0.1), np.ones(20), np.arange(0.95, 0.0, -0.1), np.zeros(1)))
LEVEL, FLOOR = np.array([0.0, 0.0, 1.0]), np.random.default_rng(8).uniform((-3.0, -3.0, 0.0), (3.0, 3.0, 0.0), (400, 3))


def lean_deg(
    drive_at: object, floor: np.ndarray, pitch_rad: float = 0.0, bias: float = 0.0, unit: float = 1.0
) -> float:
    """How far ``up`` leans after 25 s with an IMU, on a slope of ``pitch_rad`` whose ``floor`` the robot sees."""
    keyframes, uphill = Keyframes(), se3.exp(np.array([0.0, 0.0, 0.0, 0.0, pitch_rad, 0.0]))
    stamps = np.arange(250) * 0.1
    poses = se3.compose(uphill, se3.from_plane(np.array([drive_at(t) for t in stamps])))  # type: ignore[operator]
    accelerations = np.diff(poses[:, :3], 2, axis=0, prepend=poses[[0, 0], :3]) / 0.01 + 9.81 * LEVEL
    forces = unit * (np.einsum("nij,ni->nj", se3.rotation(poses), accelerations) + np.array([0.0, bias, 0.0]))
    found = se3.compose(poses, se3.exp(np.random.default_rng(0).normal(0.0, 0.002, (250, 6))))
    motions = se3.between(poses[[0, *range(249)]], poses)
    for t, pose, motion, force in zip(stamps, found, motions, forces, strict=True):
        keyframes.add(Tracked(t, pose, floor, np.zeros(3), np.eye(6), motion, np.ones(6), False), force)
    return float(np.degrees(np.arccos(min(1.0, keyframes.vertical.up @ LEVEL))))


@pytest.mark.parametrize("drive_at", [circles, stop_and_go])
@pytest.mark.parametrize("unit", [1.0, 1.0 / 9.81])
def test_up_is_against_gravity_however_the_robot_drives(drive_at: object, unit: float) -> None:
    assert lean_deg(drive_at, FLOOR[:0], unit=unit) < 0.5
    assert lean_deg(drive_at, FLOOR[:0], pitch_rad=0.12, unit=unit) < 0.5


@pytest.mark.parametrize("drive_at", [circles, stop_and_go])
def test_up_is_that_of_the_floor_though_the_imu_leans_and_gravity_knows_ramps(drive_at: object) -> None:
    assert lean_deg(drive_at, FLOOR, bias=0.3) < 0.1
    assert lean_deg(drive_at, FLOOR, pitch_rad=0.12) < 0.5
    assert lean_deg(drive_at, FLOOR, unit=0.0) < 0.1, "an IMU that leaves gravity out says nothing"


def one_plane(seed: int, count: int = 400) -> tuple[SurfelMap, np.ndarray, np.ndarray]:
    """A map of one plane in one voxel, its points (N, 3), and its true normal."""
    generator = np.random.default_rng(seed)
    normal = generator.normal(0.0, 1.0, 3)
    normal *= np.copysign(1.0, normal[2]) / np.linalg.norm(normal)
    across = generator.uniform(-0.2, 0.2, (count, 3))
    points = PLANE + across - np.outer(across @ normal, normal) + np.outer(generator.normal(0.0, 0.005, count), normal)
    surfels = SurfelMap()
    surfels.add(points, np.tile(-normal, (count, 1)), 1.0)
    return surfels, points, normal


@pytest.mark.parametrize("seed", range(4))
def test_a_surfel_has_the_normal_and_the_variances_of_its_points(seed: int) -> None:
    surfels, points, truth = one_plane(seed)
    values, axes = np.linalg.eigh(np.cov(points.T, bias=True))
    normal = axes[:, 0] * np.copysign(1.0, axes[:, 0] @ truth)
    assert normal @ truth > 0.9999
    start = PLANE + 2.0 * truth
    query = points.mean(axis=0) + 0.03 * normal
    H, b, noise, count = surfels.normal_equations(
        (query - start)[None], np.zeros(1), np.eye(3), start, np.zeros((2, 6)), 0.1
    )
    assert count == 1
    thin = values[0] * len(points) / (len(points) - 3.0)
    weight = 1.0 / (POINT_SIGMA_M**2 + thin / len(points) + 0.03**2 / 6.0)
    assert H[:3, :3] == pytest.approx(weight * np.outer(normal, normal), rel=1e-6, abs=1e-6 * weight)
    assert b[:3] == pytest.approx(weight * 0.03 * normal, rel=1e-6)
    lever = query - start
    across = np.array([[*axis, *np.cross(lever, axis)] for axis in axes[:, 1:].T])
    own = noise[0, 0] / (across[:, 0] ** 2).sum()
    assert noise == pytest.approx(own * across.T @ across, rel=1e-6, abs=1e-9), "errors of a normal are in its plane"
    assert own / weight > thin / (len(points) * values[1])


def test_the_gradient_is_that_of_the_loss_at_both_ends_of_a_turn() -> None:
    surfels, points, normal = one_plane(7)
    generator = np.random.default_rng(3)
    start = PLANE + 2.0 * normal
    R = se3.rotation(se3.exp(np.array([0.0, 0.0, 0.0, 0.1, -0.2, 0.3])))
    for share in (0.0, 0.3, 1.0):
        at = points.mean(axis=0) + 0.02 * normal + generator.normal(0.0, 0.005, 3)
        point = ((at - start) @ R)[None]

        def loss(corrections: np.ndarray, point: np.ndarray = point, share: float = share) -> float:
            # the weight of the Cauchy loss 3 log(s + r^2 / 6) is 1 / (s + r^2 / 6), the trace for one motion of all
            H = surfels.normal_equations(point, np.array([share]), R, start, corrections.reshape(2, 6), 0.2)[0]
            both = H[:3, :3] + H[6:9, 6:9] + H[:3, 6:9] + H[6:9, :3]
            return -3.0 * float(np.log(np.trace(both)))

        _, gradient, _, count = surfels.normal_equations(point, np.array([share]), R, start, np.zeros((2, 6)), 0.2)
        steps = 1e-5 * np.eye(12)
        numeric = np.array([(loss(step) - loss(-step)) / 2e-5 for step in steps])
        assert count == 1
        assert np.abs(gradient).max() > 1.0
        assert gradient == pytest.approx(numeric, rel=1e-4, abs=1e-4)


def test_without_noise_is_the_difference_and_never_negative() -> None:
    generator = np.random.default_rng(4)
    half = generator.normal(0.0, 1.0, (6, 20))
    information, unit = half @ half.T, np.eye(6)
    kept, factors = without_noise(information, np.zeros((6, 6)))
    assert kept == pytest.approx(information, rel=1e-6)
    assert factors == pytest.approx(np.eye(12), abs=1e-6)
    small = 0.1 * np.linalg.eigvalsh(information)[0] * unit
    kept, factors = without_noise(information, small)
    assert kept == pytest.approx(information - small, rel=1e-6)
    assert factors[:6, :6] @ information @ factors[:6, :6].T == pytest.approx(kept)
    weak = np.diag([1.0, 1e6, 1e6, 1e6, 1e6, 1e6])
    kept, _ = without_noise(weak, 10.0 * unit)
    assert not without_noise(0.0 * unit, 0.0 * unit)[0].any(), "nothing was near"
    assert np.abs(kept[0]).max() < 1e-6
    assert kept[1, 1] == pytest.approx(1e6, rel=1e-4)


@pytest.mark.parametrize("leaning_rad", [0.0, 0.1])
def test_errors_of_normals_are_no_information_along_a_bare_corridor(leaning_rad: float) -> None:
    """Floor and walls of one scan along x; in the second case the walls really close in, and that is information."""
    generator = np.random.default_rng(5)
    surfels, sigma_m = SurfelMap(), 0.015
    parts = []
    for side in (-1.0, 1.0):
        x, z = generator.uniform(-6.0, 6.0, 1500), np.repeat(np.linspace(0.3, 2.6, 6), 250)
        parts.append(np.column_stack((x, side * (1.2 + leaning_rad * x) + generator.normal(0.0, sigma_m, 1500), z)))
    floor = np.column_stack((generator.uniform((-6.0, -1.0), (6.0, 1.0), (1500, 2)), np.zeros(1500)))
    floor[:, 2] = generator.normal(0.0, sigma_m, 1500)
    points = np.concatenate([*parts, floor])
    origin = np.array([0.0, 0.0, 0.8])
    surfels.add(points, points - origin, 1.0)
    H, _, noise, count = surfels.normal_equations(
        points - origin, np.zeros(len(points)), np.eye(3), origin, np.zeros((2, 6)), 0.1
    )
    assert count > 2000
    raw = H[:6, :6]
    kept, _ = without_noise(raw, noise)
    if leaning_rad:
        assert kept[0, 0] > 0.5 * raw[0, 0]
    else:
        assert kept[0, 0] < 0.05 * raw[0, 0]
    assert kept[1, 1] > 0.9 * raw[1, 1]


def test_points_of_a_fast_turn_are_moved_to_where_they_were_at_its_begin() -> None:
    walls = room(3)[:6]
    inner = np.array([[0.0, 12.0], [0.0, 8.0], [0.0, 3.0]])

    def off_m(points: np.ndarray, T: np.ndarray) -> float:
        """Root mean square of the distances to the nearest wall."""
        at = se3.transform(T, points)
        distances = np.abs(at[:, :, None] - inner).min(axis=(1, 2))
        return float(np.sqrt((distances**2).mean()))

    tracker = Tracker3d()
    turns = list(drive(walls, circle((6.0, 4.0), 0.8, 1.5), 6, noise_m=0.005))
    tracked = [tracker.track(scan) for scan, _ in turns][-1]
    scan, pose = turns[-1]
    assert off_m(scan.points_m.astype(float), pose) > 0.1
    assert off_m(tracked.points, pose) < 0.03


def test_wheels_are_corrected_by_their_whole_error() -> None:
    tracker = Tracker3d()
    for scan, _ in drive(room(1), lambda t: np.array([2.0 + 1.0 * t, 4.0, 0.0]), 75, scale=1.03):
        tracker.track(scan)
    assert tracker.sensors.trust.distance.value == pytest.approx(1.0 / 1.03, abs=0.006)


def test_clouds_that_were_measured_at_once_show_the_velocity_between_them() -> None:
    tracker = Tracker3d()
    for number in range(12):
        at = np.array([2.0 + 0.08 * number, 4.0, 0.0])
        scan, _ = next(drive(room(1), lambda _, at=at: at, 1, azimuths=360, wheels=False))
        tracker.track(replace(scan, stamp=number * PERIOD_S, times_s=np.zeros_like(scan.times_s)))
    assert tracker.sensors.velocity == pytest.approx([0.8, 0.0, 0.0, 0.0, 0.0, 0.0], abs=0.1)


def test_voxels_of_voxels_are_the_same_and_each_holds_its_point() -> None:
    generator = np.random.default_rng(6)
    points, origins = generator.uniform(-14.0, 14.0, (5000, 3)), np.zeros((2, 3))
    steps, seen_from = voxelised(points, generator.integers(0, 2, 5000), origins)
    again, seen_again = voxelised(steps * STEP_M + 1e-6, seen_from.astype(np.int64), origins)
    assert np.array_equal(steps, again)
    assert np.array_equal(seen_from, seen_again)
    side_m = VOXEL_STEPS * STEP_M
    inside = (np.abs(points[:, :2]) < 12.8).all(axis=1) & (points[:, 2] >= -6.4)
    occupied = np.unique(np.floor(points[inside] / side_m), axis=0)
    assert np.array_equal(np.unique(steps // VOXEL_STEPS, axis=0), occupied)
    single, _ = voxelised(points[:1], np.zeros(1, np.int64), origins)
    assert np.abs(single[0] * STEP_M - points[0]).max() <= STEP_M
