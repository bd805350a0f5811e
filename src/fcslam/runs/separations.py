"""Why maps of a run are separate: for every two maps, the closures between them and the binding reason."""

from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from itertools import combinations

from fcslam.records import ClosureStatus, Reason, ReasonCode
from fcslam.runs.records import ClosureRow, RunTables

_GATES = (
    ReasonCode.ASYMMETRIC,
    ReasonCode.NOT_ENOUGH_EXPLAINED,
    ReasonCode.IN_FREE_SPACE,
    ReasonCode.FEW_POINTS,
    ReasonCode.LITTLE_OVERLAP,
)
"""Tests of verification in their order: a candidate that fails a later one came closer."""
_FINAL = (ReasonCode.MAPS_CONTRADICT, ReasonCode.FALSE_BRIDGE, ReasonCode.VETOED)
"""More drives do not help against these."""
_JOINS_NONE = "\n  join_maps: false\n"
"""Line of the configuration ``fleet.join_maps``, as ``fcslam.config.dump`` writes it."""


@dataclass(frozen=True, slots=True)
class Separation:
    """Two maps that no closure joins."""

    maps: tuple[int, int]
    robots: tuple[tuple[str, ...], tuple[str, ...]]
    """Robots of each map."""
    candidates: int
    """Closures between the maps that failed verification."""
    verified: int
    """Closures between the maps that passed it."""
    reason: Reason | None
    """The condition that keeps the maps apart; None if no two of their places are similar."""
    near: tuple[float, float] | None = None
    """Where a closure that failed by it ends in the first map, metres."""

    @property
    def why(self) -> str:
        """What keeps the maps apart, a clause."""
        if self.reason is None:
            return "no two of their places look alike"
        has = _count(self.verified, "verified closure") if self.verified else _count(self.candidates, "candidate")
        return f"{has}, {'but' if self.verified else 'none verified:'} {replace(self.reason, setting='')}"

    @property
    def remedy(self) -> str:
        """What to drive so that the maps may join; empty if no drive helps."""
        driver, k = self.robots[1][0], self.maps[0]
        if self.reason is None:
            return f"drive {driver} through a part of map {k}"
        if self.near is None or self.reason.code in _FINAL:
            return ""
        x, y = self.near
        return f"drive {driver} through map {k} around ({x:.1f}, {y:.1f}) again, and beyond"

    def __str__(self) -> str:
        first, second = (f"map {k} ({', '.join(robots)})" for k, robots in zip(self.maps, self.robots, strict=True))
        return f"{first} and {second}: {self.why}" + (f"; {self.remedy}" if self.remedy else "")


def separations(run: RunTables) -> list[Separation]:
    """One record for every two maps of one floor, in the order of their numbers; none if no maps were to be joined."""
    if _JOINS_NONE in run.config_yaml:
        return []
    members: dict[int, list[str]] = defaultdict(list)
    for trajectory in run.trajectories.values():
        members[trajectory.map_index].append(trajectory.robot)
    floors = {trajectory.map_index: trajectory.floor for trajectory in run.trajectories.values()}
    between: dict[tuple[int, ...], list[ClosureRow]] = defaultdict(list)
    for closure in run.closures:
        ends = {run.trajectories[robot].map_index for robot in (closure.robot_i, closure.robot_j)}
        between[tuple(sorted(ends))].append(closure)
    return [
        _separation(run, (a, b), (tuple(members[a]), tuple(members[b])), between[a, b])
        for a, b in combinations(sorted(members), 2)
        if floors[a] == floors[b]
    ]


def _separation(
    run: RunTables, maps: tuple[int, int], robots: tuple[tuple[str, ...], tuple[str, ...]], closures: list[ClosureRow]
) -> Separation:
    verified = [closure for closure in closures if closure.status is not ClosureStatus.CANDIDATE]
    candidates = len(closures) - len(verified)
    if not closures:
        return Separation(maps, robots, 0, 0, None)
    closure = _typical(verified) if verified else min(closures, key=lambda each: _distance(each.reason))
    return Separation(maps, robots, candidates, len(verified), closure.reason, _end_in(run, closure, robots[0]))


def _end_in(run: RunTables, closure: ClosureRow, robots: tuple[str, ...]) -> tuple[float, float]:
    """Position of the closure's end on the path of one of the robots."""
    ends = ((closure.robot_i, closure.stamp_i), (closure.robot_j, closure.stamp_j))
    robot, stamp = next(end for end in ends if end[0] in robots)
    path = run.trajectories[robot]
    x, y, _ = path.T_map_base[path.nearest(stamp)].tolist()
    return x, y


def _typical(closures: list[ClosureRow]) -> ClosureRow:
    """The first with the most frequent reason, of the two robots with the most closures.

    A veto goes before all others: without it, the closures that are left might be enough.
    """
    pairs = Counter(frozenset((closure.robot_i, closure.robot_j)) for closure in closures)
    strongest = pairs.most_common(1)[0][0]
    between = [closure for closure in closures if {closure.robot_i, closure.robot_j} == strongest]
    reasons = Counter(closure.reason for closure in between)
    reason = max(reasons, key=lambda reason: (reason.code is ReasonCode.VETOED, reasons[reason]))
    return next(closure for closure in between if closure.reason == reason)


def _distance(reason: Reason) -> tuple[int, float]:
    stage = _GATES.index(reason.code) if reason.code in _GATES else len(_GATES)
    return -stage, abs((reason.value or 0.0) - (reason.limit or 0.0))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
