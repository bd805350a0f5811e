"""Routes of robots in a floor plan, and their poses over time."""

from dataclasses import dataclass
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.lab.simulation.drivable_space import DrivableSpace
from fcslam.lab.simulation.floorplan import FloorPlan
from fcslam.lab.simulation.odometry import READING_RATE_HZ
from fcslam.records import FloatArray, frozen

SPEED_M_S = 0.5
TURN_RATE_RAD_S = 0.9
"""The usual rate of a turn."""
_RAMP_S = 0.3
_RAMP_STEP_S = 1.0 / READING_RATE_HZ
"""Time in which an eased drive changes its speed, and the time between its poses."""
_STRETCH, _SHIFT = 0.85, 0.55
"""Length of a robot's part of the common walk, and offset of the next robot's part, as shares of the path length."""
_SWAY_M = 0.2
"""Largest random shift of a corner in x and y, so that no two passes follow the same line."""


def draw_goals(plan: FloorPlan, robots: int, length_m: float, rng: np.random.Generator) -> list[FloatArray]:
    """Draw goals (G, 2) for each robot: overlapping parts of one walk through rooms and corridors.

    Another robot changes nothing for those before it. ``length_m``: path length of each robot.
    """
    space = DrivableSpace(plan)
    spots = _draw_spots(plan, space, rng)
    _check_spread(space.points[spots])
    wanted_m = (_STRETCH + _SHIFT * (robots - 1)) * length_m
    walk, driven = [int(rng.integers(len(spots)))], [0.0]
    while driven[-1] < wanted_m:
        costs = space.costs(spots[walk[-1]])[spots]
        costs[walk[-max(1, 3 * len(spots) // 4) :]] = np.inf
        nearest = np.argsort(costs, kind="stable")[: min(2, int(np.sum(np.isfinite(costs))))]
        walk.append(int(rng.choice(nearest)))
        driven.append(driven[-1] + float(costs[walk[-1]]))
    goals = space.points[[spots[k] for k in walk]]
    begins = np.searchsorted(driven, _SHIFT * length_m * np.arange(robots), side="right") - 1
    ends = np.searchsorted(driven, length_m * (_SHIFT * np.arange(robots) + _STRETCH), side="right")
    ends = np.maximum(ends, begins + 2)
    return [frozen(goals[begin:end]) for begin, end in zip(begins, ends, strict=True)]


def plan_route(plan: FloorPlan, goals: FloatArray, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Plan waypoints (K, 2) of a path of ``length_m`` metres that visits goals (G, 2) in a cycle.

    The start and the direction are random. Goals that furniture occupies move to the nearest drivable point.
    """
    space = DrivableSpace(plan)
    goals = space.points[[space.nearest(goal) for goal in goals]]
    _check_spread(goals)
    goals = np.roll(goals, rng.integers(len(goals)), axis=0)[:: rng.choice((-1, 1))]
    here, driven_m = space.nearest(goals[0]), 0.0
    waypoints = [space.points[here]]
    for goal in cycle([*goals[1:], goals[0]]):
        there = space.nearest(goal + rng.uniform(-_SWAY_M, _SWAY_M, 2))
        leg = _swayed(space.path(here, there), space, rng)
        waypoints.extend(leg[1:])
        driven_m += float(np.sum(np.linalg.norm(np.diff(leg, axis=0), axis=1)))
        here = there
        if driven_m >= length_m:
            break
    return _cut(np.array(waypoints), length_m)


@dataclass(frozen=True, slots=True)
class Schedule:
    """Poses over time of a robot that turns at each waypoint and drives straight to the next."""

    times_s: FloatArray
    """Shape (K,), from zero; a time may repeat."""
    poses: FloatArray
    """Poses in ``building`` at these times, shape (K, 3), linear in between; headings are unwrapped."""

    @property
    def duration_s(self) -> float:
        """Duration of the drive."""
        return float(self.times_s[-1])

    def at(self, times_s: FloatArray) -> FloatArray:
        """Poses (N, 3) in ``building`` at times (N,)."""
        poses = np.column_stack([np.interp(times_s, self.times_s, column) for column in self.poses.T])
        poses[:, 2] = se2.wrap_angle(poses[:, 2])
        return poses

    def eased(self) -> "Schedule":
        """The same drive with speeds that change steadily, not at once: the mean pose of the last ``_RAMP_S``."""
        times = np.arange(0.0, self.duration_s + _RAMP_S + _RAMP_STEP_S, _RAMP_STEP_S)
        last = times[:, None] - np.arange(0.5 * _RAMP_STEP_S, _RAMP_S, _RAMP_STEP_S)
        return Schedule(
            frozen(times),
            frozen(np.stack([np.interp(last, self.times_s, axis).mean(axis=1) for axis in self.poses.T], axis=1)),
        )


def schedule(waypoints: FloatArray, turn_rate_rad_s: float = TURN_RATE_RAD_S) -> Schedule:
    """Schedule a drive along waypoints (K, 2), metres in ``building``."""
    legs = np.diff(waypoints, axis=0)
    legs = legs[np.linalg.norm(legs, axis=1) > 1e-9]
    headings = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    turns_s = np.abs(np.diff(headings, prepend=headings[0])) / turn_rate_rad_s
    straights_s = np.linalg.norm(legs, axis=1) / SPEED_M_S
    times = np.insert(np.cumsum(np.column_stack((turns_s, straights_s)).ravel()), 0, 0.0)
    corners = np.vstack((waypoints[:1], waypoints[0] + np.cumsum(legs, axis=0)))
    positions = np.vstack((np.repeat(corners[:-1], 2, axis=0), corners[-1:]))
    angles = np.append(headings[:1], np.repeat(headings, 2))
    return Schedule(frozen(times), frozen(np.column_stack((positions, angles))))


def _draw_spots(plan: FloorPlan, space: DrivableSpace, rng: np.random.Generator) -> NDArray[np.intp]:
    """Numbers (S,) of grid points to visit: one in each room, and some along each corridor."""
    spots = []
    for room in plan.rooms:
        inside = np.flatnonzero(np.all((space.points > room.low) & (space.points < room.high), axis=1))
        if len(inside):
            spots.append(int(rng.choice(inside)))
    for start, end in plan.lanes:
        count = max(1, round(float(np.linalg.norm(end - start)) / 15.0))  # one every 15 m
        shares = (np.arange(count) + rng.uniform(0.1, 0.9, count)) / count
        spots += [space.nearest(start + share * (end - start)) for share in shares]
    return np.unique(np.array(spots, dtype=np.intp))


def _check_spread(points: FloatArray) -> None:
    if not len(points) or np.ptp(points, axis=0).max() < 1.0:
        raise InputError("the building's free space is too small or too divided to drive in; take a larger one")


def _swayed(leg: FloatArray, space: DrivableSpace, rng: np.random.Generator) -> FloatArray:
    """Move the corners of a leg (K, 2) a little, if the leg stays free of collisions."""
    swayed = leg.copy()
    for k in range(1, len(leg) - 1):
        corner = leg[k] + rng.uniform(-_SWAY_M, _SWAY_M, 2)
        if np.all(np.isfinite(space.leg_costs(corner, np.array([swayed[k - 1], leg[k + 1]])))):
            swayed[k] = corner
    return swayed


def _cut(waypoints: FloatArray, length_m: float) -> FloatArray:
    """The first ``length_m`` of an open polygon."""
    ends = np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))
    last = int(np.searchsorted(ends, length_m))
    before = ends[last - 1] if last else 0.0
    share = (length_m - before) / (ends[last] - before)
    end = waypoints[last] + share * (waypoints[last + 1] - waypoints[last])
    return np.vstack((waypoints[: last + 1], end))
