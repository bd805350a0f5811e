"""Robots that alone join others whose maps contradict each other.

A robot that sends what others saw in two buildings joins these. Its closures to both sides are as good as true ones,
and robots of different sides share no closure that could contradict it. But where the joint poses lay their maps over
each other, walls of one side stand in free space of the other.
"""

from collections.abc import Callable, Collection, Sequence
from itertools import combinations, product

from fcslam.graph.evidence import MapFit, refutation

Pair = tuple[int, int]
"""Two robots a < b."""


CompareMaps = Callable[[int, int], MapFit]
"""Compares the maps of two robots at the joint poses."""


def contradicted_bridges(ties: Collection[Pair], senders: Sequence[int], compare: CompareMaps) -> dict[Pair, int]:
    """The ties of robots that alone join two sides of a map, although the maps of both sides contradict each other.

    Two robots contradict each other if their maps do not show the same place (``refutation``). If robots of several
    senders on each side contradict the other side, and no two maps agree, the robot between them is wrong and loses its
    ties to both. Otherwise a single sender on a side may be wrong, or has drifted, and everything stays.

    Args:
        ties: pairs of robots between which closures count.
        senders: who sent each robot's packets; robots of one sender, its sessions, count as one.
        compare: called for robots that only one sender connects.

    Returns:
        The ties that are false, and how many pairs of robots contradict each other.
    """
    found: dict[Pair, int] = {}
    for bridge in sorted(set(senders)):
        sides = [side for side in _sides(ties, senders, bridge) if _are_several(side, senders)]
        for side, other in combinations(sides, 2):
            against = _contradicting(side, other, compare)
            if all(_are_several([pair[end] for pair in against], senders) for end in (0, 1)):
                found |= {pair: len(against) for pair in ties if _connects(pair, bridge, (*side, *other), senders)}
    return found


def _sides(ties: Collection[Pair], senders: Sequence[int], bridge: int) -> list[list[int]]:
    """Groups of robots that are tied to the sender's robots, and to those of other groups through these only."""
    group = {robot: robot for robot, sender in enumerate(senders) if sender != bridge}
    for a, b in ties:
        if a in group and b in group and group[a] != group[b]:
            kept, gone = sorted((group[a], group[b]))
            group = {robot: kept if number == gone else number for robot, number in group.items()}
    reached = {group[robot] for pair in ties for robot in pair if robot in group and not group.keys() >= set(pair)}
    return [[robot for robot in group if group[robot] == number] for number in sorted(reached)]


def _are_several(robots: Sequence[int], senders: Sequence[int]) -> bool:
    return len({senders[robot] for robot in robots}) > 1  # one alone may be the one that is wrong


def _contradicting(side: Sequence[int], other: Sequence[int], compare: CompareMaps) -> list[Pair]:
    """Robots of both sides whose maps contradict each other; none if any maps agree."""
    against = []
    for pair in product(side, other):
        fit = compare(*pair)
        if fit.is_compared:
            if refutation(fit) is None:
                return []
            against.append(pair)
    return against


def _connects(pair: Pair, bridge: int, side: Collection[int], senders: Sequence[int]) -> bool:
    return any(senders[a] == bridge and b in side for a, b in (pair, pair[::-1]))
