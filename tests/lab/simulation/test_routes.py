"""Free space, paths on it, and the goals of a fleet."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.lab.simulation.drivable_space import ROBOT_RADIUS_M, DrivableSpace
from fcslam.lab.simulation.floorplan import FloorPlan, Piece, PieceKind, Room, draw_floor_plan, move_furniture
from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.route import SPEED_M_S, TURN_RATE_RAD_S, draw_goals, plan_route
from tests.lab.simulation.driving import distances, drive, route


def box(west, south, east, north):
    return Piece(PieceKind.WALL, np.array([[west, south], [east, south], [east, north], [west, north]], dtype=float))


def halves(*walls):
    """8 m by 6 m with ``walls`` across its middle, each from one y to another."""
    pieces = [box(-0.1, -0.1, 8.1, 0.0), box(-0.1, 6.0, 8.1, 6.1), box(-0.1, 0.0, 0.0, 6.0), box(8.0, 0.0, 8.1, 6.0)]
    pieces += [box(3.95, south, 4.05, north) for south, north in walls]
    segments = np.concatenate([np.hstack((p.outline, np.roll(p.outline, -1, axis=0))) for p in pieces])
    lane = (np.array([1.0, 3.0]), np.array([7.0, 3.0]))
    rooms = tuple(Room(lane[0], lane[1], np.array([x, 0.0]), np.array([x + 4.0, 6.0])) for x in (0.0, 4.0))
    return FloorPlan((8.0, 6.0), tuple(pieces), segments, (lane,), rooms)


def length(path):
    return np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1))


def route_of(seed, building=Building.DEFAULT, length_m=60.0):
    rng = np.random.default_rng(seed)
    return route(draw_floor_plan(rng, building), length_m, rng)


@pytest.mark.slow
@pytest.mark.parametrize("building", list(Building))
def test_robots_touch_nothing_wherever_furniture_stands(building):
    rng = np.random.default_rng(0)
    plan = draw_floor_plan(rng, building)
    for goals in draw_goals(plan, 3, 30.0, rng):
        moved = move_furniture(plan, 0.5, rng)
        _, poses = drive(plan_route(moved, goals, 30.0, rng), 0.2)
        assert distances(poses[:, :2], moved.segments).min() > ROBOT_RADIUS_M


def test_free_points_are_those_with_clearance():
    plan = draw_floor_plan(np.random.default_rng(1), Building.FLAT)
    space = DrivableSpace(plan)
    assert distances(space.points, plan.segments).min() > ROBOT_RADIUS_M + 0.01
    grid = np.stack(np.meshgrid(np.arange(0.3, 9.0, 0.1), np.arange(0.3, 8.0, 0.1)), axis=-1).reshape(-1, 2)
    wide = grid[distances(grid, plan.segments) > 0.6]
    assert max(np.linalg.norm(space.points[space.nearest(point)] - point) for point in wide) < 0.08


def test_a_path_goes_through_the_middle_of_the_door():
    space = DrivableSpace(halves((0.0, 4.0), (5.0, 6.0)))
    start, end = space.nearest(np.array([1.0, 1.0])), space.nearest(np.array([7.0, 1.0]))
    path = space.path(start, end)
    (crossing,) = (
        a[1] + (4.0 - a[0]) / (b[0] - a[0]) * (b[1] - a[1]) for a, b in pairwise(path) if (a[0] < 4.0) != (b[0] < 4.0)
    )
    assert crossing == pytest.approx(4.5, abs=0.15)
    shortest = np.hypot(3.0, 3.3) * 2.0
    assert shortest < length(path) < 1.15 * shortest


def test_what_cannot_be_reached_is_not_free():
    space = DrivableSpace(halves((0.0, 5.6)))
    sides = space.points[:, 0] > 4.0
    assert np.all(sides) or not np.any(sides)


@pytest.mark.slow
def test_a_drive_has_the_length_and_the_speeds_asked():
    waypoints = route_of(0)
    assert length(waypoints) == pytest.approx(60.0)
    period_s = 0.05
    _, poses = drive(waypoints, period_s)
    steps = np.diff(poses, axis=0)
    assert np.hypot(steps[:, 0], steps[:, 1]).max() <= SPEED_M_S * period_s + 1e-9
    turns = (steps[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(turns).max() <= TURN_RATE_RAD_S * period_s + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("length_m", [0.5, 5.0, 300.0])
def test_short_and_long_routes(length_m):
    assert length(route_of(3, length_m=length_m)) == pytest.approx(length_m)


@pytest.mark.slow
@pytest.mark.parametrize("building", list(Building))
def test_neighbours_share_ground_and_return_to_their_own(building):
    rng = np.random.default_rng(0)
    plan = draw_floor_plan(rng, building)
    goals = draw_goals(plan, 3, 60.0, rng)
    drives = [drive(plan_route(plan, own, 60.0, rng), 0.5)[1][:, :2] for own in goals]
    for (a, b), (here, there) in zip(pairwise(goals), pairwise(drives), strict=True):
        assert len({*map(tuple, a)} & {*map(tuple, b)}) >= 2
        assert np.mean(np.linalg.norm(here[:, None] - there, axis=2).min(axis=1) < 1.0) > 0.2
    for positions in drives:
        apart_m = np.linalg.norm(positions[:, None] - positions, axis=2)
        later = np.subtract.outer(np.arange(len(positions)), np.arange(len(positions))) > 60
        assert np.mean(np.any((apart_m < 1.0) & later, axis=1)) > 0.1


@pytest.mark.parametrize("changed", [{"pieces": (box(-1.0, -1.0, 9.0, 7.0),)}, {"lanes": (), "rooms": ()}])
def test_no_space_to_drive_in(changed):
    with pytest.raises(InputError, match="the building"):
        route(replace(halves(), **changed), 10.0, np.random.default_rng(0))
