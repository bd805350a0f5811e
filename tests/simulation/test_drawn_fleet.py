"""The drawn fleet: rays against an independent oracle, odometry that drifts as said."""

import sys
import types

import numpy as np
import pytest
from simulation.driving import distances

from fcslam import config
from fcslam.errors import ConfigError
from fcslam.geometry import se2
from fcslam.metrics.relations import PoseTable, read_relations, relation_errors
from fcslam.records import LaserModel
from fcslam.runs import read_tum
from fcslam.simulation.drawn_fleet import FleetSettings, cast_rays, draw_fleet, sense, write_fleet
from fcslam.simulation.floorplan import draw_floor_plan
from fcslam.simulation.noise import LidarSettings
from fcslam.simulation.odometry import DriftSettings, drift

SEEDS = range(8)
NO_DRIFT = DriftSettings(travel_noise_m=0, heading_noise_rad=0, turn_noise_rad=0, scale_bias=0, veer_bias_rad_m=0)


@pytest.fixture(scope="module")
def fleet():
    return draw_fleet(FleetSettings(), np.random.default_rng(0))


def solve_ray(pose, angle, segments, max_range):
    """Distance along one ray by solving for the crossing with every segment."""
    direction = np.array([np.cos(pose[2] + angle), np.sin(pose[2] + angle)])
    hits = [max_range]
    for x1, y1, x2, y2 in segments:
        system = np.array([[direction[0], x1 - x2], [direction[1], y1 - y2]])
        if abs(np.linalg.det(system)) > 1e-12:
            along, share = np.linalg.solve(system, np.array([x1, y1]) - pose[:2])
            if along > 0.0 and 0.0 <= share <= 1.0:
                hits.append(along)
    return min(hits)


def test_rays_agree_with_linear_systems():
    rng = np.random.default_rng(1)
    plan = draw_floor_plan(rng)
    poses = np.column_stack((rng.uniform(-2.0, 25.0, (6, 2)), rng.uniform(-3.0, 3.0, 6)))
    angles = rng.uniform(-np.pi, np.pi, 12)
    expected = [[solve_ray(pose, angle, plan.segments, 12.0) for angle in angles] for pose in poses]
    np.testing.assert_allclose(cast_rays(poses, angles, plan.segments, 12.0), expected, atol=1e-9)


def test_nothing_to_hit_is_the_maximum_range():
    assert np.all(cast_rays(np.zeros((2, 3)), np.zeros(4), np.empty((0, 4)), 7.0) == 7.0)


def test_every_room_has_a_door_that_a_robot_can_see_through():
    for seed in SEEDS:
        plan = draw_floor_plan(np.random.default_rng(seed))
        assert len(plan.rooms) == 12
        for room in plan.rooms:
            way = room.inside - room.doorway
            pose = np.array([[*room.doorway, np.arctan2(way[1], way[0])]])
            assert cast_rays(pose, np.zeros(1), plan.segments, 50.0)[0, 0] > np.linalg.norm(way)


def test_noiseless_returns_lie_on_walls(fleet):
    laser = LaserModel(90, -2.0, 0.04, 10.0, T_base_laser=(0.2, -0.1, 0.5))
    poses = fleet.robots[0].T_building_base[::100]
    settings = LidarSettings(range_noise_m=0.0, dropout=0.0)
    ranges = sense(fleet.plan, poses, laser, settings, np.random.default_rng(0))
    angles = laser.angles_rad()
    beams = np.stack((ranges * np.cos(angles), ranges * np.sin(angles)), axis=-1)
    points = se2.transform(se2.compose(poses, laser.T_base_laser), beams)[ranges < laser.max_range_m]
    assert len(points) > 0.8 * ranges.size
    assert distances(points, fleet.plan.segments).max() < 1e-9


def test_noise_and_dropouts_are_as_large_as_said(fleet):
    poses, laser = fleet.robots[0].T_building_base[::5], fleet.robots[0].laser
    noisy = LidarSettings(range_noise_m=0.02, dropout=0.1)
    true = cast_rays(poses, laser.angles_rad(), fleet.plan.segments, laser.max_range_m)
    ranges = sense(fleet.plan, poses, laser, noisy, np.random.default_rng(0))
    hit, returned = true < laser.max_range_m, ranges < laser.max_range_m
    assert not np.any(returned & ~hit)
    assert np.mean(~returned[hit]) == pytest.approx(0.1, abs=0.01)
    assert np.std((ranges - true)[returned]) == pytest.approx(0.02, rel=0.05)


def test_wheels_without_faults_tell_the_truth(fleet):
    truth = fleet.robots[0].T_building_base
    odometry = drift(truth, NO_DRIFT, np.random.default_rng(0))
    np.testing.assert_allclose(odometry[0], 0.0)
    np.testing.assert_allclose(se2.between(se2.compose(truth[0], odometry), truth), 0.0, atol=1e-9)


def test_heading_noise_grows_with_the_square_root_of_the_way():
    straight = np.column_stack((np.linspace(0.0, 16.0, 161), np.zeros((161, 2))))
    settings = NO_DRIFT.model_copy(update={"heading_noise_rad": 0.01})
    rng = np.random.default_rng(5)
    headings = np.array([drift(straight, settings, rng)[:, 2] for _ in range(400)])
    assert np.std(headings[:, 40]) == pytest.approx(0.02, rel=0.15)
    assert np.std(headings[:, 160]) == pytest.approx(0.04, rel=0.15)


@pytest.mark.parametrize(
    ("bias", "turn_share", "travel_share"), [("scale_bias", 1.0, 0.0), ("veer_bias_rad_m", 0.0, 1.0)]
)
def test_biases_grow_with_what_causes_them(bias, turn_share, travel_share):
    turning = np.column_stack((np.zeros((101, 2)), np.linspace(0.0, 3.0, 101)))
    driving = np.column_stack((np.linspace(0.0, 3.0, 101), np.zeros((101, 2))))
    settings, rng = NO_DRIFT.model_copy(update={bias: 0.01}), np.random.default_rng(6)
    for truth, share in ((turning, turn_share), (driving, travel_share)):
        wrong = np.array([drift(truth, settings, rng)[:, 2] - truth[:, 2] for _ in range(400)])
        assert np.std(wrong[:, 100]) == pytest.approx(share * 0.03, rel=0.15, abs=1e-12)
        np.testing.assert_allclose(wrong[:, 50], wrong[:, 100] / 2.0, atol=1e-9)


def test_default_odometry_is_bad_enough_to_need_a_map(fleet):
    for robot in fleet.robots:
        end = se2.between(se2.between(robot.T_building_base[0], robot.T_building_base[-1]), robot.T_odom_base[-1])
        assert 0.1 < np.hypot(end[0], end[1]) < 10.0


def test_the_same_seed_gives_the_same_fleet_and_another_another(fleet):
    again = draw_fleet(FleetSettings(), np.random.default_rng(0))
    other = draw_fleet(FleetSettings(), np.random.default_rng(1))
    for a, b in zip(fleet.robots, again.robots, strict=True):
        np.testing.assert_array_equal(a.ranges_m, b.ranges_m)
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)
    assert fleet.plan.segments.shape != other.plan.segments.shape or np.any(fleet.plan.segments != other.plan.segments)


def test_scans_are_records_and_stamps_tell_the_robot(fleet):
    stamps = np.concatenate([robot.stamps for robot in fleet.robots])
    assert len(set(np.round(stamps, 6))) == len(stamps) > 1500
    scans = list(fleet.robots[1].scans())
    assert len(scans) == len(fleet.robots[1].stamps)
    assert scans[3].stamp == fleet.robots[1].stamps[3]
    assert scans[3].ranges_m.dtype == np.float32
    assert scans[3].ranges_m.shape == (360,)
    assert not scans[3].ranges_m.flags.writeable
    np.testing.assert_array_equal(scans[0].T_odom_base, 0.0)


def test_a_recording_is_written_with_its_truth(fleet, tmp_path, monkeypatch):
    written = {}
    sources = types.ModuleType("fcslam.sources")
    sources.write_carmen = lambda path, scans: written.update({path.name: len(list(scans))})
    monkeypatch.setitem(sys.modules, "fcslam.sources", sources)
    logs = write_fleet(fleet, tmp_path / "fleet", np.random.default_rng(0))
    assert written == {log.name: len(robot.stamps) for log, robot in zip(logs, fleet.robots, strict=True)}
    truth = tmp_path / "fleet" / "ground_truth"
    tables = [read_tum(truth / f"{robot.name}.tum") for robot in fleet.robots]
    table = PoseTable.of(np.concatenate([t[0] for t in tables]), np.concatenate([t[1] for t in tables]))
    errors = relation_errors(read_relations(truth / "relations"), table)
    assert errors.used == errors.total == 2000
    assert errors.translation.maximum < 1e-6


@pytest.mark.parametrize(
    "content", [{"robots": 0}, {"path_length_m": -1}, {"lidar": {"dropout": 2}}, {"lidar": {"beam": 3}}]
)
def test_impossible_settings_are_refused(content):
    with pytest.raises(ConfigError, match="fleet"):
        config.parse(FleetSettings, content, "fleet")
