"""Which robot explores which frontier."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from fcslam.maps.frontiers import SAME_M, VIEW_M, Frontier

GAIN_M_PER_M2: Final = 0.5
"""Metres of path that one square metre of unknown area is worth."""
KEEPING_M: Final = 3.0 * SAME_M
"""Metres of path that another frontier must save before a robot turns to it."""
REACHED_M: Final = 0.5 * SAME_M
"""A robot this near to a frontier sees what can be seen from there."""
SHARING_M: Final = 4.0 * VIEW_M
"""Metres of path that a frontier costs more for each robot that goes there already."""
UNREACHABLE: Final = 1e9
"""Cost of a frontier without a path, metres; more than any path."""


class Explorer:
    """Sends the robots of one map to its frontiers: one frontier a robot, at the least total cost.

    A frontier costs the path, less what the unknown area there is worth. A robot keeps its frontier unless another one
    saves much. A frontier that remains after a robot was there is not assigned again: nothing more is seen.
    """

    def __init__(self) -> None:
        self._goals: dict[str, tuple[float, float]] = {}
        self._visited: list[tuple[float, float]] = []

    def assign(self, found: Sequence[Frontier], robots: Mapping[str, tuple[float, float]]) -> dict[str, Frontier]:
        """The frontier of each robot that can reach one.

        The frontiers of the present map have a distance for each robot, in order; positions in metres, in its frame.
        """
        for robot, at in robots.items():
            goal = self._goals.get(robot)
            if goal is not None and math.dist(goal, at) <= REACHED_M:
                self._visited.append(goal)
        left = [one for one in found if not any(math.dist(one.point, seen) <= REACHED_M for seen in self._visited)]
        cost = np.array([one.distances_m for one in left]).reshape(len(left), len(robots)).T
        for row, robot in zip(cost, robots, strict=True):
            row -= [
                GAIN_M_PER_M2 * one.gain_m2
                + KEEPING_M * (robot in self._goals and math.dist(one.point, self._goals[robot]) <= SAME_M)
                for one in left
            ]
        # If there are more robots than frontiers, some go to the same one.
        shared = np.hstack([cost + SHARING_M * others for others in range(len(robots))]) if robots else cost
        reachable = np.isfinite(shared)
        pairs = zip(*linear_sum_assignment(np.where(reachable, shared, UNREACHABLE)), strict=True)
        names = list(robots)
        chosen = {names[k]: left[number % len(left)] for k, number in pairs if reachable[k, number]}
        self._goals = {robot: one.point for robot, one in chosen.items()}
        return chosen
