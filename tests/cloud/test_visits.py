"""Which earlier visits a new place is compared with: the number does not grow with the robots that were there."""

from collections import Counter
from itertools import combinations

import numpy as np
import pytest

from fcslam.cloud.recognition import COMPARED_ROBOTS, TIED_CLOSURES, Visit, visits_near, worth_comparing
from fcslam.records import KeyscanId

MOST = 2


def visit(robot, number, distance_m):
    place = KeyscanId(robot, number)
    return Visit(distance_m, place, (place,))


def fleet(robots, rng):
    names = [f"r{k}" for k in range(robots)]
    return {name: [visit(name, n, rng.uniform(0.0, 6.0)) for n in range(rng.integers(1, 6))] for name in names}


def tied(visits, closures=TIED_CLOSURES):
    return Counter({frozenset(pair): closures for pair in combinations(visits, 2)})


@pytest.mark.parametrize("robots", [1, 2, 3, 8, 30])
def test_tied_robots_cost_no_more_than_two(robots):
    visits = fleet(robots, np.random.default_rng(robots))
    chosen = worth_comparing(visits, tied(visits), MOST)
    assert len(chosen) <= COMPARED_ROBOTS * MOST
    nearest = min((found for group in visits.values() for found in group), key=lambda found: found.distance_m)
    assert nearest in chosen


def test_robots_that_nothing_ties_are_all_compared():
    visits = fleet(9, np.random.default_rng(3))
    for closures in (Counter(), tied(visits, closures=0)):
        chosen = worth_comparing(visits, closures, MOST)
        assert {found.nearest.robot for found in chosen} == set(visits)
        assert len(chosen) == sum(min(MOST, len(found)) for found in visits.values())


def test_a_robot_is_tied_to_a_group_by_closures_to_several_of_it():
    visits = {robot: [visit(robot, 0, 1.0), visit(robot, 1, 2.0)] for robot in "abcde"}
    closures = Counter({frozenset("ab"): 3, frozenset("ca"): 1, frozenset("cb"): 2, frozenset("dc"): 2})
    chosen = worth_comparing(visits, closures, MOST)
    assert sum(found.nearest.robot in "abc" for found in chosen) == COMPARED_ROBOTS * MOST
    assert sum(found.nearest.robot in "de" for found in chosen) == 2 * MOST, "two closures do not tie d"


def test_the_nearest_visits_of_different_robots_come_first():
    visits = {"a": [visit("a", 0, 0.1), visit("a", 1, 0.2)], "b": [visit("b", 0, 3.0)], "c": [visit("c", 0, 4.0)]}
    chosen = worth_comparing(visits, tied(visits), MOST)
    assert [found.nearest for found in chosen[:3]] == [KeyscanId("a", 0), KeyscanId("b", 0), KeyscanId("c", 0)]


def test_consecutive_places_are_one_visit():
    poses = np.array([(0, 0, 0), (1, 0, 0), (20, 0, 0), (2, 0, 0), (0.5, 0, 0), (30, 0, 0)], float)
    found = visits_near("a", np.arange(6), poses, np.zeros(2), 5.0)
    assert [(each.nearest.number, [place.number for place in each.places]) for each in found] == [
        (0, [0, 1]),
        (4, [3, 4]),
    ]
