"""A building that changes: what moved stays there for later robots, and doors close."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fcslam.lab.simulation.floorplan import DOOR_M, FloorPlan, Piece, PieceKind, move_furniture, segments_of
from fcslam.lab.simulation.simulated_fleet import SimulatedRobot, World
from fcslam.records import FloatArray

_DRIVEN_BY_M = 4.0
"""Distance up to which a robot sees whether a door is closed."""
_DOORS = 7
"""Stream of random numbers that a fleet does not use."""


class ChangingBuilding(World):
    """Furniture moves only in rooms that the robot then visits, so that every change is seen; it stays there."""

    _left: FloorPlan | None = None
    """The plan as the robot before left it."""

    def changed(self, plan: FloorPlan, goals: FloatArray, share: float, rng: np.random.Generator) -> FloorPlan:
        self._left = move_furniture(self._left or plan, share, rng, goals)
        return self._left


def close_doors(robots: Sequence[SimulatedRobot], share: float) -> list[SimulatedRobot]:
    """The robots in the building with closed doors, one after the other: a ``share`` of those that each drives by."""
    closed, changed = frozenset[int](), []
    for robot in robots:
        rng = np.random.default_rng(np.random.SeedSequence(robot.seed, spawn_key=(_DOORS, robot.number, 0)))
        closed = doors_after(robot.plan, closed, share, robot.T_building_base[:, :2], rng)
        changed.append(replace(robot, plan=with_closed_doors(robot.plan, closed)))
    return changed


def doors_after(
    plan: FloorPlan, closed: frozenset[int], share: float, route: FloatArray, rng: np.random.Generator
) -> frozenset[int]:
    """Which doors are closed while a robot drives, by their number in ``doors_of``.

    The doors that it drives through are open. Of those that it drives by, a ``share`` is closed; the others stay as
    they were. ``closed``: doors that were closed before; ``route``: positions of the robot, shape (N, 2).
    """
    after: set[int] = set()
    for number, door in enumerate(doors_of(plan)):
        distance = np.linalg.norm(route - door.centre, axis=1).min()
        is_closed = bool(rng.random() < share) if distance < _DRIVEN_BY_M else number in closed
        if is_closed and distance > DOOR_M:
            after.add(number)
    return frozenset(after)


def with_closed_doors(plan: FloorPlan, closed: frozenset[int]) -> FloorPlan:
    """The building with these doors closed."""
    doors = doors_of(plan)
    pieces = (*plan.pieces, *(Piece(PieceKind.WALL, doors[number].outline) for number in sorted(closed)))
    return replace(plan, pieces=pieces, segments=segments_of(pieces))


def doors_of(plan: FloorPlan) -> list[Piece]:
    """The lintels of all doors."""
    return [piece for piece in plan.pieces if piece.kind is PieceKind.LINTEL]
