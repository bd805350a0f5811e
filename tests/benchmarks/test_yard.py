"""Yards: what stands in them, what beams meet there, and walks that come home."""

import numpy as np
import pytest
from worlds.outdoor_rays import OutdoorRayCaster
from worlds.walk import draw_starts, plan_walk
from worlds.yard import draw_yard
from worlds.yard_plan import CELL_M, Terrain, YardKind, YardPlan

from fcslam.lab.simulation.drivable_space import ROBOT_RADIUS_M
from fcslam.lab.simulation.floorplan import Piece, disc, rectangle, segments_of
from fcslam.records import LaserModel
from tests.lab.simulation.driving import distances, drive

pytestmark = pytest.mark.slow
HERE = np.array([20.0, 20.0, 0.0])
AHEAD = LaserModel(3, -0.001, 0.001, 30.0)


def meadow(*pieces, slope=0.0):
    """40 m by 40 m that rises towards the east, with ``pieces``."""
    heights = np.tile(slope * CELL_M * np.arange(42.0), (42, 1))
    lanes = ((np.array([20.0, 1.0]), np.array([20.0, 39.0])),)
    return YardPlan((40.0, 40.0), tuple(pieces), segments_of(pieces), lanes, (), Terrain(heights))


def ahead(kind, distance_m, depth_m=0.2, wide_m=8.0):
    """A piece across the way of a robot at HERE, whose near side is ``distance_m`` away."""
    outline = rectangle((depth_m, wide_m), 0.0) + HERE[:2] + (distance_m + depth_m / 2.0, 0.0)
    return Piece(kind, outline)


def scans(plan, count=400, laser=AHEAD):
    """The middle beam of many scans at HERE."""
    caster, rng = OutdoorRayCaster(plan), np.random.default_rng(0)
    return np.array([caster.scan(HERE, laser, rng)[1] for _ in range(count)])


def test_each_beam_starts_where_the_robot_is_at_its_time():
    caster = OutdoorRayCaster(meadow(ahead(YardKind.WALL, 6.0)))
    poses = HERE + np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.1], [2.0, -0.5, -0.2]])
    alone = [caster.cast(pose, AHEAD)[beam] for beam, pose in enumerate(poses)]
    np.testing.assert_array_equal(caster.cast(poses, AHEAD), alone)
    assert len(set(alone)) == 3


def ranges(robot):
    return np.array([scan.ranges_m for scan in robot.scans()])


@pytest.mark.parametrize("seed", range(2))
def test_everything_stands_in_the_yard_and_clear_of_its_ways(seed):
    plan = draw_yard(np.random.default_rng(seed))
    assert all(60.0 < size < 160.0 for size in plan.size_m)
    kinds = {piece.kind for piece in plan.pieces}
    assert kinds >= {YardKind.WALL, YardKind.TRUNK, YardKind.CAR}
    corners = np.concatenate([piece.outline for piece in plan.pieces])
    assert np.all((corners > 0.0) & (corners < plan.size_m))
    for start, end in plan.lanes:
        way = start + np.linspace(0.0, 1.0, 60)[:, None] * (end - start)
        assert distances(way, plan.segments).min() > 1.2


@pytest.mark.parametrize("seed", range(2))
def test_a_walk_touches_nothing_has_its_length_and_comes_home(seed):
    rng = np.random.default_rng(seed)
    plan = draw_yard(rng)
    (start,) = draw_starts(plan, 1, rng)
    waypoints = plan_walk(plan, start, 400.0, rng)
    length_m = np.sum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))
    assert 0.93 * 400.0 < length_m < 1.02 * 400.0
    _, poses = drive(waypoints, 0.5)
    assert distances(poses[:, :2], plan.segments).min() > ROBOT_RADIUS_M
    away_m = np.linalg.norm(poses[:, :2] - start, axis=1)
    assert away_m.max() > 20.0
    assert away_m[len(away_m) // 2 :].min() < 3.0


def test_a_trunk_is_met_at_its_bark():
    plan = meadow(Piece(YardKind.TRUNK, disc(0.2) + HERE[:2] + (6.0, 0.0)))
    assert OutdoorRayCaster(plan).cast(HERE, AHEAD)[1] == pytest.approx(5.8, abs=1e-9)
    assert scans(plan, 20) == pytest.approx(5.8, abs=0.01)
    laser = LaserModel(3, np.pi - 0.001, 0.001, 30.0, T_base_laser=(0.3, 0.0, 0.0))
    assert OutdoorRayCaster(plan).cast(np.array([32.0, 20.0, 0.0]), laser)[1] == pytest.approx(6.1, abs=1e-9)


def test_walls_are_met_where_lines_cross_them():
    plan = draw_yard(np.random.default_rng(4))
    walls = tuple(piece for piece in plan.pieces if piece.kind is YardKind.WALL)
    bare = YardPlan(plan.size_m, walls, segments_of(walls), plan.lanes, (), plan.terrain)
    laser = LaserModel(90, -np.pi, 2.0 * np.pi / 90, 30.0)
    x, y = min(
        (np.mean(lane, axis=0) for lane in plan.lanes), key=lambda point: distances(point[None], bare.segments)[0]
    )
    found = OutdoorRayCaster(bare).cast(np.array([x, y, 0.4]), laser)
    met = found < 30.0
    assert np.sum(met) > 5
    ends = np.array([x, y]) + found[:, None] * np.column_stack([f(0.4 + laser.angles_rad()) for f in (np.cos, np.sin)])
    assert distances(ends[met], bare.segments).max() < 1e-6
    for share in (0.3, 0.6, 0.9):
        between = np.array([x, y]) + share * (ends - np.array([x, y]))
        assert distances(between, bare.segments).min() > 1e-3
