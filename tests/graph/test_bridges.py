"""Robots that leave a map if one robot alone joins others whose maps contradict each other."""

import pytest

from fcslam.graph.bridges import contradicted_bridges
from fcslam.graph.evidence import MapFit

AGREES = MapFit(support=90.0, expected=80.0, compared_m=50.0)
CONTRADICTS = MapFit(support=-40.0, expected=80.0, compared_m=50.0)
NOTHING = MapFit(compared_m=2.0)


def against(*pairs, other=NOTHING):
    """Compares maps: those of the pairs contradict each other."""
    return lambda a, b: CONTRADICTS if {(a, b), (b, a)} & set(pairs) else other


def found(ties, compare, senders=range(5)):
    return set(contradicted_bridges(ties, list(senders), compare))


# Robots 0 and 1, robots 3 and 4, and robot 2 between them.
CHAIN = [(0, 1), (0, 2), (1, 2), (2, 3), (2, 4), (3, 4)]
BETWEEN = [(0, 2), (1, 2), (2, 3), (2, 4)]


def test_several_on_both_sides_contradict_the_robot_between_them_which_leaves_both():
    assert found(CHAIN, against((0, 3), (1, 4))) == set(BETWEEN)


@pytest.mark.parametrize(
    ("ties", "compare", "senders"),
    [
        (CHAIN, against((0, 3)), range(5)),
        (CHAIN, against((0, 3), (1, 3)), range(5)),
        (CHAIN, against((0, 3), (1, 4), other=AGREES), range(5)),
        ([*CHAIN, (1, 3)], against((0, 3), (1, 4)), range(5)),
        (CHAIN, against((0, 3), (1, 4)), [0, 0, 2, 3, 4]),
        (CHAIN, against(), range(5)),
    ],
    ids=[
        "one against one",
        "one of a group",
        "maps agree",
        "another tie",
        "two sessions of one robot",
        "nothing contradicts",
    ],
)
def test_nobody_leaves_without_need(ties, compare, senders):
    assert found(ties, compare, senders) == set()


def test_sessions_of_one_robot_are_one_bridge():
    """Robots 2 and 5 are sessions of one sender: one in each building, and a closure between them."""
    ties = [(0, 1), (0, 2), (1, 2), (2, 5), (3, 5), (4, 5), (3, 4)]
    assert found(ties, against((0, 3), (1, 4)), [0, 1, 2, 3, 4, 2]) == {(0, 2), (1, 2), (3, 5), (4, 5)}
