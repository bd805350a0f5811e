"""Robots that contradict others leave their map, whatever precision they claim; the others are as they were without."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.graph.consistency import ConsistencySettings
from fcslam.graph.contradiction import contradicting_robots, shared_chi2, strained_pairs
from fcslam.graph.factors import FactorCache
from fcslam.graph.initialization import initialize
from fcslam.graph.joint import JointEvidence, solve_jointly
from fcslam.graph.optimizer import optimize
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.records import ReasonCode
from tests.scripted import CLOSURE_INFORMATION, MOTION_INFORMATION, rectangle

pytestmark = pytest.mark.slow

TRUTH = rectangle()
LIMIT = 0.08


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


@pytest.mark.parametrize("scales", [(1.0, 1.04), (1.0, 1.0, 1.04, 1.04)], ids=["two", "two against two"])
def test_robots_that_contradict_each_other_share_no_map(scales):
    assert solved(*scales).maps == tuple(int(scale > 1.0) for scale in scales)


def test_robots_that_measure_alike_share_a_map():
    found = solved(1.0, 1.001, 0.999)
    assert found.maps == (0, 0, 0)
    assert not found.apart


def test_a_robot_that_fits_each_other_one_but_not_all_of_them_leaves():
    """It meets one robot at one place and the other one elsewhere, so nothing contradicts it in a pair."""
    honest = world(1.0, 1.0)
    count = len(TRUTH)
    liar = world(1.0, 1.08)
    own = [
        Edge(2 * count + e.i - count, 2 * count + e.j - count, e.T_i_j, e.information, False)
        for e in liar.graph.edges
        if not e.robust and e.i >= count
    ]
    here, there = 0, count // 2
    closures = [Edge(here, 2 * count + here, np.zeros(3), CLOSURE_INFORMATION, True)] * 4
    closures += [Edge(count + there, 2 * count + there, np.zeros(3), CLOSURE_INFORMATION, True)] * 4
    edges = [*honest.graph.edges, *own, *closures]
    poses = np.concatenate((honest.graph.poses(), liar.graph.poses()[count:]))
    solution = optimize(PoseGraph(poses, edges), initialize(PoseGraph(poses, edges)))
    graph, owner, kept = PoseGraph(poses, edges), np.repeat(np.arange(3), count), np.ones(len(edges), bool)
    left = contradicting_robots(FactorCache(graph), owner, solution.poses, kept, LIMIT)
    assert list(left) == [2]
    assert set(left[2]) == {(0, 2), (1, 2)}
    assert set(left[2].values()) == {max(strained_pairs(graph, owner, solution.poses, kept, LIMIT).values())}
    for pair in ((0, 2), (1, 2)):  # each pair without the third robot
        inside = np.array([{owner[e.i], owner[e.j]} <= set(pair) for e in edges])
        alone = optimize(graph, solution.poses, kept=inside).poses
        assert not strained_pairs(graph, owner, alone, inside, LIMIT)


def test_the_robots_that_leave_cost_less_than_any_others():
    """Against every choice of robots, by brute force."""
    evidence = world(1.0, 1.03, 1.0, 0.97, 1.0)
    graph, owner = evidence.graph, np.repeat(np.arange(5), len(TRUTH))
    edges, kept = graph.arrays(), np.ones(len(graph.edges), bool)
    between = edges.robust & (owner[edges.i] != owner[edges.j])
    joint = optimize(graph, initialize(graph)).poses

    def loss(leaving):
        given_up = between & (np.isin(owner[edges.i], leaving) | np.isin(owner[edges.j], leaving))
        poses = optimize(graph, joint, kept=~given_up).poses
        return graph.chi2(poses)[~given_up].sum() + LIMIT * given_up.sum()

    left = contradicting_robots(FactorCache(graph), owner, joint, kept, LIMIT)
    choices = [list(c) for size in range(6) for c in itertools.combinations(range(5), size)]
    assert sorted(left) == min(choices, key=loss) == [1, 3]


def test_noise_is_no_strain_however_large():
    noise = np.random.default_rng(0).normal(size=(200, 40, 3))
    strains = np.array([shared_chi2(residuals) for residuals in noise])
    assert np.mean((noise**2).sum(axis=2)) > 2.9
    assert np.mean(strains > 0.3) < 0.05
    assert shared_chi2(np.ones((40, 3))) == pytest.approx(3.0)
    assert shared_chi2(np.ones((2, 3))) == 0.0


def test_robots_with_a_noisy_scanner_share_a_map():
    """Their closures are as far off as those of a scaled copy, and each in another direction."""
    evidence, rng = world(1.0, 1.0, 1.0), np.random.default_rng(1)
    deviations = 1.0 / np.sqrt(np.diag(CLOSURE_INFORMATION))
    edges = [replace(e, T_i_j=se2.compose(e.T_i_j, rng.normal(0.0, deviations))) if e.robust else e
             for e in evidence.graph.edges]  # fmt: skip
    noisy = replace(evidence, graph=PoseGraph(evidence.graph.poses(), edges))
    found = solve_jointly(noisy, ConsistencySettings(), contradiction=LIMIT)
    assert found.maps == (0, 0, 0)
    assert not found.apart


def test_a_bent_path_is_strain_where_all_closures_hold():
    """Closures of a robot with a stiff path stretch the other robot's, so that no closure shows it."""
    stiff, soft, count = world(1.0, 1.03).graph, 1e-2, len(TRUTH)
    edges = [replace(e, information=e.information * soft) if not e.robust and e.i < count else e for e in stiff.edges]
    graph, owner = PoseGraph(stiff.poses(), edges), np.repeat(np.arange(2), count)
    kept, poses = np.ones(len(edges), bool), optimize(graph, initialize(graph)).poses
    strained = strained_pairs(graph, owner, poses, kept, 0.01)
    assert (0, 1) not in strained
    assert (0, 0) in strained
