"""Tracking in space: errors of a robot that turns in a room, whatever else measures its motion."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se3
from fcslam.lidar3d.surfels import SurfelMap
from fcslam.lidar3d.tracker import Tracker3d, fit_rigid
from fcslam.records import CloudScan
from tests.spinning_lidar import ORIGIN, circle, drive, room

CORRIDOR = np.array(
    [
        ((-99, -3, -0.2), (99, 3, 0)),
        ((-99, -3, 3), (99, 3, 3.2)),
        ((-99, 1.2, 0), (99, 1.4, 3)),
        ((-99, -1.4, 0), (99, -1.2, 3)),
    ],
    float,
)


def errors(tracker: Tracker3d, turns: object) -> np.ndarray:
    """Tangents of the errors of all poses relative to the first, shape (N, 6)."""
    found, truth = [], []
    for scan, pose in turns:  # type: ignore[attr-defined]
        found.append(tracker.track(scan).T_odom_base)
        truth.append(pose)
    return se3.log(se3.between(se3.between(truth[0], np.array(truth)), se3.between(found[0], np.array(found))))


@pytest.mark.parametrize(("wheels", "gyro"), [(True, False), (False, True), (False, False), (True, True)])
def test_poses_are_right_whatever_else_measures_the_motion(wheels: bool, gyro: bool) -> None:
    tracker = Tracker3d()
    turns = drive(room(1), circle((6.0, 4.0), 0.8, 1.0), 63, wheels=wheels, gyro=gyro, scale=1.03)
    found = errors(tracker, turns)
    assert np.sqrt((found[:, :3] ** 2).sum(axis=1).mean()) < (0.015 if wheels or gyro else 0.03)
    assert np.degrees(np.linalg.norm(found[:, 3:], axis=1).mean()) < (0.4 if wheels or gyro else 0.5)
    if gyro:
        assert tracker.sensors.bias.value[2] == pytest.approx(0.02, abs=0.01)


def test_a_plain_corridor_says_nothing_along_its_axis_and_wheels_hold_it() -> None:
    tracker = Tracker3d()
    found = errors(tracker, drive(CORRIDOR, lambda t: np.array([0.5 * t, 0.0, 0.0]), 40))
    assert np.abs(found[:, 0]).max() < 0.05
    scan, _ = next(drive(CORRIDOR, lambda t: np.array([2.0 + 0.5 * t, 0.0, 0.0]), 1))
    information = tracker.track(replace(scan, stamp=4.0, wheels=scan.wheels + np.array([4.0, 0.0, 0.0, 0.0]))).measured
    assert information[0, 0] < 1e-3 * information[1, 1]


def test_wheels_hold_roll_and_pitch_where_few_rings_show_little_floor() -> None:
    def every_second_ring(scan: CloudScan) -> CloudScan:
        x, y, z = (scan.points_m - ORIGIN).T
        kept = np.rint(np.degrees(np.arctan2(z, np.hypot(x, y))) + 15.0) % 4.0 == 0.0
        return replace(scan, points_m=scan.points_m[kept], times_s=scan.times_s[kept])

    turns = drive(CORRIDOR, lambda t: np.array([0.7 * t, 0.0, 0.0]), 25, azimuths=240, noise_m=0.015)
    found = errors(Tracker3d(), ((every_second_ring(scan), pose) for scan, pose in turns))
    assert np.degrees(np.abs(found[:, 3:5])).max() < 0.5, "the floor between two turns has the error of their poses"


def test_wheels_hold_a_robot_that_stops_in_a_plain_corridor_while_its_lidar_pauses() -> None:
    turns = list(drive(CORRIDOR, lambda t: np.array([min(t, 2.0), 0.0, 0.0]), 45))
    kept, missed = [*turns[:19], *turns[34:]], [scan.wheels for scan, _ in turns[19:34]]
    after, pose = kept[19]
    kept[19] = replace(after, wheels=np.concatenate((*missed, after.wheels))), pose
    assert np.abs(errors(Tracker3d(), kept)[:, 0]).max() < 0.05, "constant velocity explains the walls as well"


def test_both_sides_of_a_thin_wall_stay_apart() -> None:
    generator = np.random.default_rng(0)
    surfels, sides = SurfelMap(), (0.0, 0.12)
    for x, ray in zip(sides, (1.0, -1.0), strict=True):
        points = np.column_stack((x + generator.normal(0.0, 0.005, 4000), generator.uniform(0.0, 4.0, (4000, 2))))
        surfels.add(points, np.tile((ray, 0.2, 0.0), (4000, 1)), ray + 2.0)
    for x, ray in zip(sides, (1.0, -1.0), strict=True):
        seen = np.column_stack((np.full(500, x), generator.uniform(0.2, 3.8, (500, 2))))
        start = np.array([-3.0 * ray, 2.0, 2.0])
        H, b, _, count = surfels.normal_equations(seen - start, np.zeros(500), np.eye(3), start, np.zeros((2, 6)), 0.5)
        assert count > 400
        assert abs(b[0]) / H[0, 0] < 0.005


def test_registration_of_a_moved_cloud_finds_the_motion() -> None:
    (first, _), (second, _) = (
        next(drive(room(2), lambda _, at=at: np.array(at), 1, azimuths=720))
        for at in ((4.0, 3.0, 0.3), (4.2, 3.1, 0.35))
    )
    surfels = SurfelMap()
    surfels.add(first.points_m.astype(float), first.points_m - first.origin_m, 1.0)
    T, information, on_surface, near = fit_rigid(surfels, second.points_m.astype(float), se3.IDENTITY)
    truth = se3.between(se3.from_plane((4.0, 3.0, 0.3)), se3.from_plane((4.2, 3.1, 0.35)))
    assert se3.log(se3.between(truth, T)) == pytest.approx(0.0, abs=0.02)
    assert np.linalg.eigvalsh(information)[0] > 0.0
    assert on_surface > 0.9 * near > 0.5 * len(second.points_m)


def test_surfaces_that_were_not_seen_for_a_while_are_forgotten() -> None:
    surfels, generator = SurfelMap(), np.random.default_rng(0)
    for when, x in ((1.0, 0.0), (2.0, 30.0)):
        points = np.column_stack((np.full(500, x), generator.uniform(0.0, 3.0, (500, 2))))
        surfels.add(points, np.tile((1.0, 0.0, 0.0), (500, 1)), when)
    before = surfels.count
    surfels.forget(1.5)
    assert 0 < surfels.count < before
    points = np.column_stack((np.zeros(100), generator.uniform(0.3, 2.7, (100, 2))))
    counts = [
        surfels.normal_equations(
            points + np.array([x, 0.0, 0.0]), np.zeros(100), np.eye(3), np.zeros(3), np.zeros((2, 6)), 0.5
        )[3]
        for x in (0.0, 30.0)
    ]
    assert counts[0] == 0 < counts[1]
