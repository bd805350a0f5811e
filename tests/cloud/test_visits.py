"""Which earlier visits a new place is compared with: the number does not grow with the robots that were there."""

from types import SimpleNamespace

import numpy as np
import pytest

from fcslam.cloud.closure_log import ClosureLog
from fcslam.cloud.recognition import PlaceRecognition, visits_near, worth_comparing
from fcslam.cloud.settings import FleetConfig
from fcslam.geometry.groups import SE3
from fcslam.lidar.pair_verification import verify_here
from fcslam.records import KeyscanId
from tests.scripted import place

OF_EACH, MOST = 2, 3


def visit(robot, number, distance_m):
    return distance_m, KeyscanId(robot, number)


@pytest.mark.parametrize("robots", [1, 2, 3, 8, 30])
def test_more_robots_cost_no_more_than_a_few(robots):
    rng = np.random.default_rng(robots)
    visits = [
        [visit(f"r{k}", n, rng.uniform(0.0, 6.0)) for n in range(rng.integers(OF_EACH, 6))] for k in range(robots)
    ]
    chosen = worth_comparing(visits, OF_EACH, MOST)
    assert len(chosen) == min(MOST, OF_EACH * robots)
    assert chosen[0] == min(each for found in visits for each in found)


def test_the_nearest_visits_of_different_robots_come_first():
    a, b, c = [visit("a", 0, 0.2), visit("a", 1, 0.1)], [visit("b", 0, 4.0)], [visit("c", 0, 3.0)]
    assert worth_comparing([a, b, c], OF_EACH, 4) == [a[1], c[0], b[0], a[0]]


def test_consecutive_places_are_one_visit():
    poses = np.array([(0, 0, 0), (1, 0, 0), (20, 0, 0), (2, 0, 0), (0.5, 0, 0), (30, 0, 0)], float)
    found = visits_near("a", np.arange(6), poses, np.zeros(2), 5.0)
    assert [nearest.number for _, nearest in found] == [0, 4]


def test_a_place_above_another_is_not_near():
    poses = np.array([(0, 0, 0, 0, 0, 0, 1), (1, 0, 3.2, 0, 0, 0, 1)], float)
    assert [nearest.number for _, nearest in visits_near("a", np.arange(2), poses, np.zeros(3), 3.0)] == [0]


def test_a_session_takes_nobodys_room_on_another_level():
    """The third session of a robot drives above the first two."""
    heights_m, forgotten = {"a": 0.0, "a+1": 3.0, "a+2": 6.0}, []

    class Matcher:
        forget = forgotten.append

        def __len__(self):
            return len(heights_m)

    graph = SimpleNamespace(group=SE3, trajectory=lambda session, _: np.array([(0, 0, heights_m[session], 0, 0, 0, 1)]))
    sessions, config = SimpleNamespace(floor=lambda _: ""), FleetConfig(dimensions=3)
    recognition = PlaceRecognition(config, 0, sessions, graph, None, ClosureLog(), verify_here)
    newest = place("a+2", 0)
    key = recognition._key(newest)
    recognition._matchers[key] = Matcher()
    for session in heights_m:
        recognition._enter(key, KeyscanId(session, 0))
    recognition.thin(newest, heights_m)
    assert forgotten == []
    heights_m["a"] = 6.0
    recognition.thin(newest, heights_m)
    assert forgotten == []
    heights_m["a+1"] = 6.0
    recognition.thin(newest, heights_m)
    assert forgotten == [KeyscanId("a", 0)]
