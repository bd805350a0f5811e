"""Whether to use a map: one decision for each map of a run, from all that the run says about it."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, NamedTuple

from fcslam.errors import InputError
from fcslam.graph.evidence import MapFit, refutation
from fcslam.metrics.trajectory import find_jumps
from fcslam.records import ClosureStatus, ReasonCode
from fcslam.runs.records import Join, RobotTrajectory, RunTables
from fcslam.runs.separations import Separation, separations

QUALITY: Final = "quality.json"
"""Name of the file of the certificates."""
LEAST_PATH_M: Final = 5.0
"""A map of a shorter drive shows a room at most."""
MOST_BARS: Final = 5.0
"""A map whose error is more times that which its certificate asks for is of no use."""
LOOK_ALIKE: Final = 0.5
"""Maps that fit so well elsewhere, as a share, may show places that only look alike."""
MOST_JOINS: Final = 6
"""Joins that are named; all are in joins.csv."""
_BY_HAND: Final = (ReasonCode.PINNED, ReasonCode.MADE_BY_HAND)

Point = tuple[float, float]


class Use(StrEnum):
    """What to do with a map."""

    USE = "use"
    RESERVE = "reserve"
    WAIT = "wait"


class Concern(NamedTuple):
    """Something that speaks against a map."""

    use: Use
    why: str
    remedy: str = ""
    """What to do about it; empty: nothing."""
    where: tuple[Point, ...] = ()
    """Places of the map to look at, metres."""

    def __str__(self) -> str:
        return self.why + (f"; {self.remedy}" if self.remedy else "")


_SENTENCES: Final = {Use.USE: "use this map", Use.RESERVE: "use this map, but", Use.WAIT: "do not use this map yet:"}


@dataclass(frozen=True, slots=True)
class MapVerdict:
    """Whether to use one map, and why."""

    map_index: int
    robots: tuple[str, ...]
    use: Use
    concerns: tuple[Concern, ...]
    """The gravest one first."""
    joined: tuple[str, ...]
    """On what evidence its robots share it, the joins from fewest places first."""
    accuracy: str
    coverage: str

    def __str__(self) -> str:
        """One sentence: the decision, its reason, and what to do next."""
        return " ".join((_SENTENCES[self.use], *map(str, self.concerns[:1])))

    @property
    def details(self) -> tuple[str, ...]:
        """The further concerns, and what the decision rests on, one line each."""
        return tuple(filter(None, (*map(str, self.concerns[1:]), *self.joined, self.accuracy, self.coverage)))


def verdicts(run: RunTables, quality: bytes) -> tuple[MapVerdict, ...]:
    """The verdict of each map of a run, in the order of their numbers; ``quality`` as in ``Run``.

    Raises:
        InputError: quality.json is broken.
    """
    apart = separations(run)
    try:
        certificates = dict(json.loads(quality or b"{}"))
        return tuple(
            _verdict(run, k, certificates.get(str(k)), [one for one in apart if k in one.maps])
            for k in sorted({trajectory.map_index for trajectory in run.trajectories.values()})
        )
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        raise InputError(f"{QUALITY} is broken ({error})") from error


def _verdict(run: RunTables, k: int, certificate: Mapping[str, Any] | None, apart: list[Separation]) -> MapVerdict:
    members = [trajectory for trajectory in run.trajectories.values() if trajectory.map_index == k]
    names = {trajectory.robot for trajectory in members}
    joins = sorted((j for j in run.joins if {j.robot_i, j.robot_j} <= names), key=lambda join: join.places)
    concerns = [
        *_of_paths(members),
        *_of_recordings(certificate),
        *_of_joins(run, joins),
        *_of_accuracy(certificate),
        *_of_separations(k, apart),
    ]
    grave = list(Use)
    concerns.sort(key=lambda concern: -grave.index(concern.use))  # stable
    use = concerns[0].use if concerns else Use.USE
    joined = [f"joined: {join}" for join in joins[:MOST_JOINS]]
    if len(joins) > MOST_JOINS:
        joined.append(f"{len(joins) - MOST_JOINS} more joins, from more places (joins.csv)")
    accuracy, coverage = _facts(certificate)
    return MapVerdict(k, tuple(t.robot for t in members), use, tuple(concerns), tuple(joined), accuracy, coverage)


def _of_paths(members: list[RobotTrajectory]) -> Iterator[Concern]:
    driven_m = sum(trajectory.path_length_m for trajectory in members)
    if driven_m < LEAST_PATH_M:
        yield Concern(Use.WAIT, f"it shows {driven_m:.1f} m of path", f"drive at least {LEAST_PATH_M:g} m")
    for trajectory in members:
        jumps = find_jumps(trajectory.stamps, trajectory.T_map_base)
        if jumps is not None:
            why = f"{trajectory.robot} cannot have moved so: {jumps}"
            yield Concern(Use.WAIT, why, "look at its walls there", (_at(trajectory, jumps.stamp),))


def _of_joins(run: RunTables, joins: list[Join]) -> Iterator[Concern]:
    by_hand = {
        frozenset((closure.robot_i, closure.robot_j)): closure
        for closure in run.closures
        if closure.reason.code in _BY_HAND and closure.status is ClosureStatus.ACCEPTED
    }
    for join in joins:
        pair = frozenset((join.robot_i, join.robot_j))
        both, pinned = f"{join.robot_i} and {join.robot_j}", by_hand.get(pair)
        where = () if pinned is None else (_at(run.trajectories[pinned.robot_i], pinned.stamp_i),)
        undo = "" if pinned is None else "take back what joined them by hand: fcslam edit undo"
        if math.isnan(join.seen_m):
            if pinned is not None:
                yield Concern(Use.WAIT, f"{both} are joined by hand, and no wall confirms it", undo, where)
            continue
        fit = MapFit(join.likeness, 1.0, join.elsewhere * join.likeness, join.seen_m, join.contradicting_m)
        refuted = refutation(fit)
        if refuted is not None:
            yield Concern(Use.WAIT, f"the walls of {both} do not fit: {refuted}", undo, where)
        elif join.elsewhere >= LOOK_ALIKE:
            why = f"the walls of {both} fit elsewhere {join.elsewhere:.2f} times as well"
            yield Concern(Use.RESERVE, why, "check on the spot that both saw one place, or give --start")


def _of_recordings(certificate: Mapping[str, Any] | None) -> Iterator[Concern]:
    yield from (Concern(Use.WAIT, str(doubt)) for doubt in (certificate or {}).get("doubts", []))


def _of_accuracy(certificate: Mapping[str, Any] | None) -> Iterator[Concern]:
    if certificate is None or certificate.get("good_share") is None:
        yield Concern(Use.RESERVE, "its accuracy is not known")
        return
    bar_m, error_m, cells = certificate["bar"], certificate["error_95"], certificate["cells"]
    bad = [cell for cell in cells if not cell["good"]]
    if not bad:
        return
    worst = max(bad, key=lambda cell: cell["bound_95"])
    where: tuple[Point, ...] = ((worst["x"], worst["y"]),)
    remedy = "another drive does not help there; a tag does, or a scanner that sees farther"
    if certificate["drives"]:
        first = certificate["drives"][0]
        where = tuple((x, y) for x, y in (first["from"], first["to"]))
        remedy = "drive from ({}, {}) to ({}, {}) again, which makes about {} m2 good".format(
            *where[0], *where[1], first["gain_m2"]
        )
    why = f"{len(bad)} of {len(cells)} m2 around {_place(where[-1])} may be off by more than {_centimetres(bar_m)}"
    if worst["bound_95"] >= certificate["within"]:
        why = f"its length around {_place(where[-1])} is not known, as neither wheels nor scans show it"
    yield Concern(Use.WAIT if error_m > MOST_BARS * bar_m else Use.RESERVE, why, remedy, where)


def _of_separations(k: int, apart: list[Separation]) -> Iterator[Concern]:
    if not apart:
        return
    nearest = max(apart, key=lambda one: (one.verified, one.candidates, -sum(one.maps)))
    others = nearest.robots[nearest.maps[0] == k]
    why = f"{_listed(others)} {'has' if len(others) == 1 else 'have'} another map ({nearest.why})"
    where = (nearest.near,) if nearest.near is not None and nearest.maps[0] == k else ()
    yield Concern(Use.RESERVE, why, nearest.remedy, where)


def _facts(certificate: Mapping[str, Any] | None) -> tuple[str, str]:
    if certificate is None or certificate.get("error_95") is None:
        return "", ""
    known = f"accurate to {_centimetres(max(0.01, certificate['error_95']))} within {certificate['within']:g} m"
    accuracy = known if certificate["error_95"] < certificate["within"] else ""
    coverage, ends = f"{len(certificate['cells'])} m2 are known", certificate.get("open_ends", [])
    if ends:
        at = _place((ends[0]["x"], ends[0]["y"]))
        coverage += f"; the map is open at {len(ends)} place{'' if len(ends) == 1 else 's'}, most at {at}"
    return accuracy, coverage


def _place(point: Point) -> str:
    return f"({point[0]:.1f}, {point[1]:.1f})"


def _centimetres(length_m: float) -> str:
    return f"{100.0 * length_m:.2g} cm"


def _at(trajectory: RobotTrajectory, stamp: float) -> Point:
    x, y, _ = trajectory.T_map_base[trajectory.nearest(stamp)].tolist()
    return round(x, 2), round(y, 2)


def _listed(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
