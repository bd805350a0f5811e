"""Robots that contradict others leave their map, whatever precision they claim; the others are as they were without."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.graph.consistency import ConsistencySettings
from fcslam.graph.contradiction import contradictions, leaving
from fcslam.graph.joint import JointEvidence, solve_jointly
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.records import ReasonCode
from tests.scripted import CLOSURE_INFORMATION, MOTION_INFORMATION, rectangle

TRUTH = rectangle()
LIMIT = 0.3


@pytest.mark.parametrize(
    ("pairs", "senders", "left"),
    [
        ({}, (0, 1), {}),
        ([(0, 3), (1, 3), (2, 3)], (0, 1, 2, 3), {3: 3}),
        ([(0, 1)], (0, 1), {0: 1, 1: 1}),
        ([(0, 1)], (0, 1, 2), {0: 1, 1: 1}),
        # two sessions of one robot against two robots: neither outvotes the robots
        ([(0, 2), (0, 3), (1, 2), (1, 3)], (0, 1, 2, 2), {2: 2, 3: 2}),
        # two against two
        ([(0, 2), (0, 3), (1, 2), (1, 3)], (0, 1, 2, 3), {0: 2, 1: 2, 2: 2, 3: 2}),
    ],
    ids=["none", "one against three", "two", "two and a third", "one robot twice", "two against two"],
)
def test_who_leaves(pairs, senders, left):
    found = dict.fromkeys(pairs, 1.0)
    assert leaving(found, found, senders) == left


@pytest.mark.parametrize(("third", "left"), [(0.25, {1: 1}), (0.04, {0: 1, 1: 1})], ids=["clearly", "hardly"])
def test_of_two_that_contradict_the_one_leaves_that_fits_a_third_worse(third, left):
    contradicting = {(0, 1): 0.7}
    assert leaving(contradicting, {**contradicting, (0, 2): 0.02, (1, 2): third}, (0, 1, 2)) == left


@pytest.mark.parametrize(
    ("found", "kept"),
    [
        ({(0, 1): 0.5}, []),
        ({(0, 1): 0.7}, [(0, 1)]),
        ({(0, 2): 0.4, (1, 2): 0.5}, [(0, 2), (1, 2)]),
        ({(0, 2): 0.4, (0, 3): 0.5}, []),
    ],
    ids=["one pair", "one clear pair", "two robots against one", "two sessions of one robot"],
)
def test_a_slight_contradiction_counts_if_a_third_robot_confirms_it(found, kept):
    assert list(contradictions(found, (0, 1, 2, 2), LIMIT)) == kept


def world(*scales: float, senders=None) -> JointEvidence:
    """Robots on the same way, each scaled: what it measures, closures between submaps included, holds locally."""
    count, edges, poses = len(TRUTH), [], []
    for robot, scale in enumerate(scales):
        steps = se2.between(TRUTH[:-1], TRUTH[1:]) * (scale, scale, 1.0)
        path = [np.zeros(3)]
        for k, step in enumerate(steps):
            edges.append(Edge(robot * count + k, robot * count + k + 1, step, MOTION_INFORMATION, False))
            path.append(se2.compose(path[-1], step))
        poses += path
        edges += [
            Edge(other * count + k, robot * count + k, np.zeros(3), CLOSURE_INFORMATION, True)
            for other in range(robot)
            for k in range(0, count, 4)
        ]
    robots = tuple(np.arange(count) + robot * count for robot in range(len(scales)))
    ones, none = np.ones(len(edges), bool), np.zeros(len(edges), bool)
    return JointEvidence(PoseGraph(poses, edges), robots, ones, ones, none, senders)


def solved(*scales: float, senders=None, limit: float = LIMIT):
    return solve_jointly(world(*scales, senders=senders), ConsistencySettings(), contradiction=limit)


@pytest.mark.parametrize("scale", [0.97, 0.98, 1.02, 1.03])
def test_a_scaled_copy_gets_a_map_of_its_own_and_bends_nobody(scale):
    alone, found = solved(1.0, 1.0, 1.0), solved(1.0, 1.0, 1.0, scale)
    assert found.maps == (0, 0, 0, 1)
    honest = 3 * len(TRUTH)
    np.testing.assert_allclose(found.poses[:honest], alone.poses, atol=1e-6)
    assert {found.apart[k, 3].code for k in range(3)} == {ReasonCode.PATHS_CONTRADICT}
    assert all(reason.value > reason.limit == LIMIT for reason in found.apart.values())
    bent = solved(1.0, 1.0, 1.0, scale, limit=np.inf)
    assert bent.maps == (0, 0, 0, 0)
    assert np.abs(bent.poses[:honest] - alone.poses).max() > 0.05, "without the rule it bends them"


def test_with_nobody_else_two_that_contradict_have_a_map_each():
    assert solved(1.0, 1.04).maps == (0, 1)


def test_two_sessions_of_one_robot_do_not_outvote_two_robots():
    assert solved(1.0, 1.0, 1.04, 1.04, senders=(0, 1, 2, 2)).maps == (0, 0, 1, 1)


def test_two_against_two_stay_two_by_two():
    assert solved(1.0, 1.0, 1.04, 1.04).maps == (0, 0, 1, 1)


def test_robots_that_measure_alike_share_a_map():
    found = solved(1.0, 1.001, 0.999)
    assert found.maps == (0, 0, 0)
    assert not found.apart
