"""The world in which a simulated fleet drives: plans, routes and beams. Equal generators give equal results."""

from typing import Protocol

import numpy as np

from fcslam.lab.simulation.floorplan import FloorPlan, draw_floor_plan, move_furniture
from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.route import draw_goals, plan_route
from fcslam.lab.simulation.scene import bare_model
from fcslam.lab.simulation.sensors import RayCaster
from fcslam.records import FloatArray, LaserModel


class Caster(Protocol):
    """Casts beams on a plan. The pose (3,) is that of the robot, or its poses at each beam, shape (beam_count, 3)."""

    def cast(self, T_building_base: FloatArray, laser: LaserModel) -> FloatArray:
        """Ranges (beam_count,) in metres without any error; ``max_range_m`` without a hit."""

    def scan(self, T_building_base: FloatArray, laser: LaserModel, rng: np.random.Generator) -> FloatArray:
        """Ranges (beam_count,) in metres before noise; ``max_range_m`` without a return."""


class World:
    """A building. For another world, override these methods."""

    def __init__(self, building: Building) -> None:
        self._building = building

    def draw(self, rng: np.random.Generator) -> FloorPlan:
        """The plan as the first robot finds it."""
        return draw_floor_plan(rng, self._building)

    def goals(self, plan: FloorPlan, robots: int, length_m: float, rng: np.random.Generator) -> list[FloatArray]:
        """Goals (G, 2) of each robot. Another robot changes nothing for those before it."""
        return draw_goals(plan, robots, length_m, rng)

    def changed(self, plan: FloorPlan, goals: FloatArray, share: float, rng: np.random.Generator) -> FloorPlan:  # noqa: ARG002
        """The plan after a ``share`` of the furniture has moved, as a robot with these goals finds it."""
        return move_furniture(plan, share, rng)

    def route(self, plan: FloorPlan, goals: FloatArray, length_m: float, rng: np.random.Generator) -> FloatArray:
        """Waypoints (K, 2) of a path of about ``length_m`` metres."""
        return plan_route(plan, goals, length_m, rng)

    def caster(self, plan: FloorPlan) -> Caster:
        """The beams of lasers on ``plan``."""
        return RayCaster(bare_model(plan))
