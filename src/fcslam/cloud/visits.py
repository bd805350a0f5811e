"""Visits of robots to the surroundings of a point, and which of them are worth a comparison with a new place."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter, itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray, KeyscanId

NEAR_VISITS = 2
"""Earlier visits of each robot that are compared with a new place; of robots that closures nearby tie together, two
count."""
TIED_CLOSURES = 3
"""Closures near a place after which the relative pose of two groups of robots is well determined there: together they
are more certain than one more closure, which therefore adds little."""
COMPARED_ROBOTS = 2
"""Number of robots of a group that a new place is compared with, if each was here often enough."""
NEWEST_PLACES = 12
"""Newest places of a robot near a point whose closures are counted."""


class Visit(NamedTuple):
    """Consecutive places of one session near a point."""

    distance_m: float
    """Distance of the nearest one."""
    nearest: KeyscanId
    places: tuple[KeyscanId, ...]


def visits_near(
    session: str, numbers: NDArray[np.int64], T_map_place: FloatArray, xy: FloatArray, within_m: float
) -> list[Visit]:
    """The visits of a session to the surroundings of a point (2,), in their order.

    ``numbers``: of the keyscans of its places (N,), in their order, at the poses (N, 3). Consecutive ones that are near
    are one visit.
    """
    distance = np.hypot(T_map_place[:, 0] - xy[0], T_map_place[:, 1] - xy[1])
    close = np.flatnonzero(distance < within_m)
    stays = np.split(close, np.flatnonzero(np.diff(close) > 1) + 1) if len(close) else []
    visits = []
    for stay in stays:
        nearest = int(np.argmin(distance[stay]))
        places = tuple(KeyscanId(session, number) for number in numbers[stay].tolist())
        visits.append(Visit(float(distance[stay[nearest]]), places[nearest], places))
    return visits


def worth_comparing(visits: Mapping[str, Sequence[Visit]], closures: Counter[frozenset[str]], most: int) -> list[Visit]:
    """The visits that a new place is compared with.

    Robots that closures tie together here are a group. Closures to two robots of a group determine the pose relative to
    all of it, so the number of comparisons does not grow with the number of robots that were here. Within a group, the
    nearest visits of different robots come first. ``closures`` counts the accepted ones near the new place, by pair of
    robots; ``most`` visits of each robot are taken.
    """
    nearest = {robot: sorted(found, key=attrgetter("distance_m"))[:most] for robot, found in visits.items()}
    chosen: list[Visit] = []
    for group in _tied_groups(visits, closures):
        ranked = [(rank, visit.distance_m, visit) for robot in group for rank, visit in enumerate(nearest[robot])]
        ranked.sort(key=itemgetter(0, 1))
        chosen += [visit for _, _, visit in ranked[: COMPARED_ROBOTS * most]]
    return chosen


def _tied_groups(robots: Iterable[str], closures: Counter[frozenset[str]]) -> list[list[str]]:
    """Groups of robots, each tied to the rest of its group by at least ``TIED_CLOSURES``."""
    groups: list[list[str]] = []
    for robot in robots:
        tied = [g for g in groups if sum(closures[frozenset((robot, other))] for other in g) >= TIED_CLOSURES]
        groups = [group for group in groups if group not in tied]
        groups.append([*(member for group in tied for member in group), robot])
    return groups
