"""Where a robot drives in a floor plan, and when it is where."""

from dataclasses import dataclass

import numpy as np

from fcslam.geometry import se2
from fcslam.records import FloatArray, frozen
from fcslam.simulation.floorplan import FloorPlan, Room

SPEED_M_S = 0.5
TURN_RATE_RAD_S = 0.9
SWAY_M = 0.2
"""No two passes through a corridor follow the same line."""
DOOR_SWAY_M = 0.08


@dataclass(frozen=True, slots=True)
class _Stop:
    """A corner of a loop, or a door on it."""

    position_m: float
    """Along the loop from its first corner."""
    point: FloatArray
    room: Room | None


def plan_route(plan: FloorPlan, loop: int, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Waypoints (K, 2) of a robot that walks round loop ``loop`` and visits rooms until it has driven ``length_m``.

    It starts anywhere on the loop, in either direction; whoever drives longer than one round sees its start again.
    """
    corners = plan.loops[loop]
    perimeter = float(np.sum(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)))
    stops = _stops(plan, corners)
    doors = [stop.room for stop in stops if stop.room is not None]
    visits = int(np.clip((length_m - 1.15 * perimeter) / _visit_length(doors), 1, len(doors)))
    start, forward = rng.uniform(0.0, perimeter), rng.random() < 0.5
    stops.sort(key=lambda stop: ((stop.position_m - start) if forward else (start - stop.position_m)) % perimeter)
    waypoints = [_point_on(corners, start)]
    while _length(waypoints) < length_m:
        visited = {id(doors[k]) for k in rng.choice(len(doors), visits, replace=False)}
        for stop in stops:
            waypoints += _pass(stop, id(stop.room) in visited, rng)
    return _cut(np.array(waypoints), length_m)


@dataclass(frozen=True, slots=True)
class Schedule:
    """Where a robot is when: it turns at each waypoint and drives straight to the next."""

    times_s: FloatArray
    """Shape (K,), from zero; twice the same while nothing happens."""
    poses: FloatArray
    """Shape (K, 3) at these times; headings are unwrapped, in between everything changes evenly."""

    @property
    def duration_s(self) -> float:
        """How long the whole drive takes."""
        return float(self.times_s[-1])

    def at(self, times_s: FloatArray) -> FloatArray:
        """Poses (N, 3) at times (N,)."""
        poses = np.column_stack([np.interp(times_s, self.times_s, column) for column in self.poses.T])
        poses[:, 2] = se2.wrap_angle(poses[:, 2])
        return poses


def schedule(waypoints: FloatArray) -> Schedule:
    """The drive along waypoints (K, 2)."""
    legs = np.diff(waypoints, axis=0)
    legs = legs[np.linalg.norm(legs, axis=1) > 1e-9]
    headings = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    turns_s = np.abs(np.diff(headings, prepend=headings[0])) / TURN_RATE_RAD_S
    straights_s = np.linalg.norm(legs, axis=1) / SPEED_M_S
    times = np.insert(np.cumsum(np.column_stack((turns_s, straights_s)).ravel()), 0, 0.0)
    corners = np.vstack((waypoints[:1], waypoints[0] + np.cumsum(legs, axis=0)))
    positions = np.vstack((np.repeat(corners[:-1], 2, axis=0), corners[-1:]))
    angles = np.append(headings[:1], np.repeat(headings, 2))
    return Schedule(frozen(times), frozen(np.column_stack((positions, angles))))


def drive(waypoints: FloatArray, period_s: float) -> tuple[FloatArray, FloatArray]:
    """Times (N,) from zero and poses (N, 3) of a drive along waypoints, every ``period_s``."""
    plan = schedule(waypoints)
    stamps = np.arange(0.0, plan.duration_s, period_s)
    return stamps, plan.at(stamps)


def _stops(plan: FloorPlan, corners: FloatArray) -> list[_Stop]:
    stops: list[_Stop] = []
    position = 0.0
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        stops.append(_Stop(position, start, None))
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        for room in plan.rooms:
            offset = room.doorway - start
            ahead = float(offset @ along)
            if abs(float(along[0] * offset[1] - along[1] * offset[0])) < 1e-6 and 0.0 < ahead < length:
                stops.append(_Stop(position + ahead, room.doorway, room))
        position += length
    return stops


def _pass(stop: _Stop, visit: bool, rng: np.random.Generator) -> list[FloatArray]:
    """Waypoints at a stop: round the corner, past the door, or in and out again."""
    if stop.room is None:
        return [stop.point + rng.uniform(-SWAY_M, SWAY_M, 2)]
    if not visit:
        return []
    inward = np.sign(stop.room.inside[1] - stop.point[1])
    sway = np.array([rng.uniform(-DOOR_SWAY_M, DOOR_SWAY_M), 0.0])
    before = stop.point + sway + [0.0, inward * rng.uniform(-SWAY_M, SWAY_M)]
    return [before, stop.room.inside + sway, before]


def _visit_length(rooms: list[Room]) -> float:
    return float(np.mean([2.0 * np.linalg.norm(room.inside - room.doorway) for room in rooms]))


def _length(waypoints: list[FloatArray]) -> float:
    return float(np.sum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1)))


def _point_on(corners: FloatArray, position_m: float) -> FloatArray:
    """The point that lies ``position_m`` along a closed polygon."""
    closed = np.vstack((corners, corners[:1]))
    positions = np.insert(np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1)), 0, 0.0)
    return np.array([np.interp(position_m, positions, closed[:, axis]) for axis in (0, 1)])


def _cut(waypoints: FloatArray, length_m: float) -> FloatArray:
    """The first ``length_m`` of an open polygon."""
    ends = np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))
    last = int(np.searchsorted(ends, length_m))
    before = ends[last - 1] if last else 0.0
    share = (length_m - before) / (ends[last] - before)
    end = waypoints[last] + share * (waypoints[last + 1] - waypoints[last])
    return np.vstack((waypoints[: last + 1], end))
