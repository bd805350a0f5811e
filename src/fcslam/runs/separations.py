"""Why maps of a run are separate: for every two maps, the closures between them and the binding reason."""

from collections import Counter, defaultdict
from dataclasses import dataclass
from itertools import combinations

from fcslam.records import ClosureStatus, Reason, ReasonCode
from fcslam.runs.folder import Run
from fcslam.runs.records import ClosureRow

_GATES = (
    ReasonCode.ASYMMETRIC,
    ReasonCode.NOT_ENOUGH_EXPLAINED,
    ReasonCode.IN_FREE_SPACE,
    ReasonCode.FEW_POINTS,
    ReasonCode.LITTLE_OVERLAP,
)
"""Tests of verification in their order: a candidate that fails a later one came closer."""


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

    def __str__(self) -> str:
        first, second = (f"map {k} ({', '.join(robots)})" for k, robots in zip(self.maps, self.robots, strict=True))
        if self.reason is None:
            return f"{first} and {second}: no two of their places look alike"
        if self.verified:
            return f"{first} and {second}: {_count(self.verified, 'verified closure')}, but {self.reason}"
        return f"{first} and {second}: {_count(self.candidates, 'candidate')}, none verified: {self.reason}"


def separations(run: Run) -> list[Separation]:
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
        _separation((a, b), (tuple(members[a]), tuple(members[b])), between[a, b])
        for a, b in combinations(sorted(members), 2)
        if floors[a] == floors[b]
    ]


def _separation(
    maps: tuple[int, int], robots: tuple[tuple[str, ...], tuple[str, ...]], closures: list[ClosureRow]
) -> Separation:
    verified = [closure for closure in closures if closure.status is not ClosureStatus.CANDIDATE]
    candidates = len(closures) - len(verified)
    reason = _reason_of_verified(verified) if verified else _reason_of_candidates(closures)
    return Separation(maps, robots, candidates, len(verified), reason)


def _reason_of_verified(closures: list[ClosureRow]) -> Reason:
    """The most frequent reason of the two robots with the most verified closures."""
    pairs = Counter(frozenset((closure.robot_i, closure.robot_j)) for closure in closures)
    strongest = pairs.most_common(1)[0][0]
    reasons = Counter(closure.reason for closure in closures if {closure.robot_i, closure.robot_j} == strongest)
    return reasons.most_common(1)[0][0]


def _reason_of_candidates(closures: list[ClosureRow]) -> Reason | None:
    """The reason of the candidate that came closest to being verified."""
    return min((closure.reason for closure in closures), key=_distance, default=None)


def _distance(reason: Reason) -> tuple[int, float]:
    stage = _GATES.index(reason.code) if reason.code in _GATES else len(_GATES)
    return -stage, abs((reason.value or 0.0) - (reason.limit or 0.0))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
