"""The simulated fleet without a GL library: rays against an independent oracle, chance that stays where it belongs."""

import importlib
from dataclasses import replace

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.lab.simulation import engine, textures
from fcslam.lab.simulation.floorplan import PieceKind, draw_floor_plan
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.scene import bare_model
from fcslam.lab.simulation.sensors import RayCaster
from fcslam.lab.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet
from fcslam.records import LaserModel, LaserScan
from tests.lab.simulation.driving import drive, route
from tests.lidar.worlds import cast

pytestmark = pytest.mark.slow

TINY = SimulationSettings(
    building=Building.FLAT, robots=2, path_length_m=4.0, camera=None, lidar=LidarSettings(beams=60, rate_hz=4.0)
)


@pytest.mark.parametrize("building", [Building.FLAT, Building.DEFAULT])
def test_rays_agree_with_lines_that_cross(building):
    rng = np.random.default_rng(2)
    plan = draw_floor_plan(rng, building)
    _, poses = drive(route(plan, 40.0, rng), 8.0)
    # Columns are round here and have eight corners there.
    pieces = tuple(piece for piece in plan.pieces if piece.kind is not PieceKind.COLUMN)
    sides = [np.hstack((p.outline, np.roll(p.outline, -1, axis=0))) for p in pieces if p.kind is not PieceKind.LINTEL]
    laser = LaserModel(120, -np.pi, 2.0 * np.pi / 120, 9.0, T_base_laser=(0.1, 0.02, 0.3))
    caster = RayCaster(bare_model(replace(plan, pieces=pieces)))
    ranges = np.array([caster.cast(pose, laser) for pose in poses])
    T_building_laser = se2.compose(poses, np.array(laser.T_base_laser))
    met = [cast(pose[:2], pose[2] + laser.angles_rad(), np.concatenate(sides)) for pose in T_building_laser]
    expected = np.minimum(met, 9.0)
    # Walls end a millimetre earlier: a beam that grazes a corner may go on.
    assert np.mean(np.abs(ranges - expected) < 1e-6) > 0.9
    assert np.mean(np.abs(ranges - expected) < 0.02) > 0.995
    assert np.any(expected == 9.0) or building is Building.FLAT


def test_nothing_to_hit_is_the_maximum_range():
    plan = draw_floor_plan(np.random.default_rng(0), Building.FLAT)
    column = next(piece for piece in plan.pieces if piece.kind is PieceKind.COLUMN)
    caster = RayCaster(bare_model(replace(plan, pieces=(column,))))
    laser = LaserModel(4, -np.pi, 0.5 * np.pi, 7.0)
    assert np.all(caster.cast(np.array([*column.centre + 20.0, 0.0]), laser) == 7.0)


def test_scans_and_truth_come_in_order():
    fleet = simulate_fleet(TINY, 1)
    for robot in fleet.robots:
        items = list(robot.records())
        scans = [item for item in items if isinstance(item, LaserScan)]
        stamps, truth = robot.truth
        np.testing.assert_array_equal([scan.stamp for scan in scans], robot.stamps)
        np.testing.assert_array_equal(stamps, robot.stamps)
        np.testing.assert_allclose(truth, robot.T_building_base, atol=1e-5)
        np.testing.assert_array_equal([scan.T_odom_base for scan in scans], robot.T_odom_base)
        assert all(scan.ranges_m.shape == (60,) for scan in scans)
    assert len(set(np.concatenate([robot.stamps for robot in fleet.robots]))) == sum(
        len(robot.stamps) for robot in fleet.robots
    )


def ranges(robot):
    return np.array([item.ranges_m for item in robot.records() if isinstance(item, LaserScan)])


def test_the_same_seed_gives_the_same_fleet_and_another_another():
    first, again, other = (simulate_fleet(TINY, seed).robots[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(ranges(first), ranges(again))
    assert ranges(first).shape != ranges(other).shape or np.any(ranges(first) != ranges(other))


def test_a_further_robot_changes_nothing_for_the_others():
    few, more = simulate_fleet(TINY, 1), simulate_fleet(TINY.model_copy(update={"robots": 3}), 1)
    for a, b in zip(few.robots, more.robots[:2], strict=True):
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)
        np.testing.assert_array_equal(ranges(a), ranges(b))


def test_a_camera_changes_nothing_for_the_lidar():
    blind = simulate_fleet(TINY, 1)
    seeing = simulate_fleet(TINY.model_copy(update={"camera": CameraSettings()}), 1)
    for a, b in zip(blind.robots, seeing.robots, strict=True):
        np.testing.assert_array_equal(a.T_building_base, b.T_building_base)
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)
        np.testing.assert_array_equal(a.plan.segments, b.plan.segments)
        assert len(a.image_stamps) == 0 < len(b.image_stamps)


def test_furniture_moves_before_every_robot_but_the_first():
    still = simulate_fleet(TINY, 1)
    moved = simulate_fleet(TINY.model_copy(update={"moved_furniture": 1.0}), 1)
    np.testing.assert_array_equal(moved.robots[0].plan.segments, still.plan.segments)
    assert np.any(moved.robots[1].plan.segments != still.plan.segments)


def test_without_a_gl_library_one_line_says_what_to_install(monkeypatch):
    engine.mujoco()
    real = importlib.import_module

    def without_gl(name):
        if name in ("mujoco.egl", "mujoco.osmesa"):
            raise AttributeError("eglQueryDevicesEXT")
        return real(name)

    monkeypatch.setattr(importlib, "import_module", without_gl)
    with pytest.raises(InputError, match=r"^no GL library.*apt-get install libegl1 .*--no-camera"):
        engine.gl_context(32, 24)


@pytest.mark.parametrize(
    "draw", [textures.plaster, textures.planks, textures.tiles, textures.carpet, textures.cupboard, textures.picture]
)
def test_images_repeat_by_seed_and_differ_between_seeds(draw):
    first, again, other = (draw(np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.dtype == np.uint8
    assert first.shape[2] == 3
    np.testing.assert_array_equal(first, again)
    assert np.mean(first != other) > 0.3
