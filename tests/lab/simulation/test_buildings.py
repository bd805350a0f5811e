"""All kinds of building: furniture moves within its room, sizes are as said."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.lab.simulation.decoration import light_of
from fcslam.lab.simulation.floorplan import (
    DOOR_M,
    PieceKind,
    draw_floor_plan,
    move_furniture,
)
from fcslam.lab.simulation.options import Building, Lighting
from tests.lab.simulation.driving import distances

every_building = pytest.mark.parametrize("building", list(Building))


@every_building
def test_every_room_has_a_door_and_lies_in_the_building(building):
    plan = draw_floor_plan(np.random.default_rng(1), building)
    for room in plan.rooms:
        assert np.all(room.low >= 0.0)
        assert np.all(room.high <= np.array(plan.size_m) + 1e-9)
        assert np.all((room.inside > room.low) & (room.inside < room.high))
    lintels = [piece for piece in plan.pieces if piece.kind is PieceKind.LINTEL]
    assert len(lintels) == len(plan.rooms)
    assert all(piece.size[0] == pytest.approx(DOOR_M + 0.12) for piece in lintels)


@pytest.mark.parametrize("seed", range(10))
def test_the_default_building_is_large_enough_for_a_fleet(seed):
    plan = draw_floor_plan(np.random.default_rng(seed))
    assert np.prod(plan.size_m) >= 300.0
    assert len(plan.rooms) >= 8


@pytest.mark.slow
@every_building
def test_every_room_has_a_straight_free_way_in(building):
    plan = draw_floor_plan(np.random.default_rng(2), building)
    for room in plan.rooms:
        way = room.doorway + np.linspace(0.0, 1.0, 50)[:, None] * (room.inside - room.doorway)
        assert distances(way, plan.segments).min() > 0.35


def test_the_office_is_sixty_by_forty_metres():
    plan = draw_floor_plan(np.random.default_rng(0), Building.OFFICE)
    assert plan.size_m == (60.0, 40.0)
    assert len(plan.rooms) > 40


def test_the_corridor_has_twenty_doors_that_are_alike():
    plan = draw_floor_plan(np.random.default_rng(0), Building.CORRIDOR)
    assert len(plan.rooms) == 20
    for side in (plan.rooms[:10], plan.rooms[10:]):
        np.testing.assert_allclose(np.diff([room.doorway[0] for room in side], n=2), 0.0, atol=1e-9)
        np.testing.assert_allclose([room.high - room.low for room in side], [side[0].high - side[0].low] * 10)
    lane_y = plan.lanes[0][0][1]
    furniture = [piece for piece in plan.pieces if piece.kind in (PieceKind.CABINET, PieceKind.COLUMN)]
    assert min(abs(piece.outline[:, 1] - lane_y).min() for piece in furniture) > 1.1


@every_building
def test_moving_leaves_walls_and_keeps_furniture_in_its_room(building):
    plan = draw_floor_plan(np.random.default_rng(4), building)
    moved = move_furniture(plan, 1.0, np.random.default_rng(5))
    changed = 0
    for before, after in zip(plan.pieces, moved.pieces, strict=True):
        same = np.array_equal(before.outline, after.outline)
        changed += not same
        assert same or before.kind in (PieceKind.CABINET, PieceKind.COLUMN)
        np.testing.assert_allclose(after.size, before.size)
        if not same:
            (room,) = (r for r in plan.rooms if np.all(before.centre > r.low) and np.all(before.centre < r.high))
            assert np.all((after.outline > room.low) & (after.outline < room.high))
    assert changed >= len(plan.rooms)


def test_lamps_fail_and_evening_is_darker():
    plan = draw_floor_plan(np.random.default_rng(0))
    day, evening, failed = (light_of(plan, lighting, np.random.default_rng(1)) for lighting in Lighting)
    assert len(day.lamps) == len(evening.lamps) > len(failed.lamps) >= 0.6 * len(day.lamps)
    assert sum(evening.ambient_rgb) < 0.5 * sum(day.ambient_rgb)
    assert np.all(day.lamps[:, :2] < plan.size_m)


def test_a_lamp_fails_even_where_there_is_one_room():
    plan = draw_floor_plan(np.random.default_rng(0), Building.FLAT)
    few = replace(plan, rooms=plan.rooms[:1], lanes=())
    assert len(light_of(few, Lighting.LAMP_OFF, np.random.default_rng(0)).lamps) == 0


def test_furniture_moves_in_the_visited_rooms_only():
    plan = draw_floor_plan(np.random.default_rng(4))
    room = plan.rooms[0]
    moved = move_furniture(plan, 1.0, np.random.default_rng(5), np.array([room.inside]))
    changed = [
        before
        for before, after in zip(plan.pieces, moved.pieces, strict=True)
        if not np.array_equal(before.outline, after.outline)
    ]
    assert changed
    assert all(room.contains(piece.centre[None]) for piece in changed)
