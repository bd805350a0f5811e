"""Robots without a common frame, most closures between them false: who joins, what holds, what each part is for."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.graph.evidence import ConsistencySettings
from fcslam.graph.joint import JointEvidence, JointSolution, is_confirmed, solve_jointly
from fcslam.graph.optimizer import Solution, optimize
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.graph.trajectory import build_trajectory
from tests.graph.graph_worlds import INFORMATION, measured, walk

pytestmark = pytest.mark.slow

SETTINGS = ConsistencySettings()
STEPS = 100
ROBOTS = 3
STARTS = np.array([(0.0, 0.0, 0.0), (40.0, 5.0, 2.0), (-30.0, 80.0, -1.0)])
"""Where each robot believes to be: says nothing of how they lie to each other."""
ALIAS = np.array([5.0, 3.0, 0.0])


class World:
    """Three robots in one town, each with some closures of its own; closures between them are added by a test."""

    def __init__(self, seed: int, own: int = 15) -> None:
        self.generator = np.random.default_rng(seed)
        self.truth = [walk(seed * 10 + robot, STEPS) for robot in range(ROBOTS)]
        self.edges: list[Edge] = []
        self.true: list[bool] = []
        poses = []
        for robot, truth in enumerate(self.truth):
            poses.append(STARTS[robot])
            for k in range(STEPS):
                step = measured(self.generator, se2.between(truth[k], truth[k + 1]))
                self._add(Edge(self.variable(robot, k), self.variable(robot, k + 1), step, INFORMATION, False), True)
                poses.append(se2.compose(poses[-1], step))
            for i, j in self.near(robot, robot, own):
                if j > i + 5:
                    self.close(robot, i, robot, j)
        self.poses = np.array(poses)

    @staticmethod
    def variable(robot: int, k: int) -> int:
        return robot * (STEPS + 1) + k

    def meet(self, a: int, b: int, count: int, shift=None) -> None:
        """Closures where two robots were near each other, or, shifted, where an alias would have them near."""
        for i, j in self.near(a, b, count, shift):
            self.close(a, i, b, j, shift)

    def close(self, a: int, i: int, b: int, j: int, shift=None) -> None:
        there = self.truth[b][j] if shift is None else se2.compose(shift, self.truth[b][j])
        T = measured(self.generator, se2.between(self.truth[a][i], there))
        self._add(Edge(self.variable(a, i), self.variable(b, j), T, INFORMATION, True), shift is None)

    def lie(self, a: int, b: int, count: int) -> None:
        """Closures between random places that measure anything."""
        for i, j in self.generator.integers(0, STEPS + 1, (count, 2)):
            T = np.append(self.generator.normal(0.0, 1.0, 2), self.generator.uniform(-np.pi, np.pi))
            self._add(Edge(self.variable(a, int(i)), self.variable(b, int(j)), T, INFORMATION, True), False)

    def near(self, a: int, b: int, count: int, shift=None) -> list[tuple[int, int]]:
        moved = self.truth[b] if shift is None else se2.compose(shift, self.truth[b])
        distance = np.hypot(*np.moveaxis(self.truth[a][:, None, :2] - moved[None, :, :2], -1, 0))
        near = np.argwhere(distance < 1.5)
        chosen = self.generator.choice(len(near), min(count, len(near)), replace=False)
        return [(int(i), int(j)) for i, j in near[chosen]]

    def _add(self, edge: Edge, true: bool) -> None:
        self.edges.append(edge)
        self.true.append(true)

    def evidence(self) -> JointEvidence:
        count = len(self.edges)
        robots = tuple(np.arange(STEPS + 1) + robot * (STEPS + 1) for robot in range(ROBOTS))
        graph = PoseGraph(self.poses, self.edges)
        return JointEvidence(graph, robots, np.ones(count, bool), np.ones(count, bool), np.zeros(count, bool))

    def error_m(self, solution: JointSolution) -> float:
        """Largest distance from the optimum without a false closure, both seen from the first pose."""
        clean = PoseGraph(
            np.concatenate([se2.between(self.truth[0][0], truth) for truth in self.truth]),
            [edge for edge, true in zip(self.edges, self.true, strict=True) if true],
        )
        best = optimize(clean).poses
        apart = se2.between(best[0], best)[:, :2] - se2.between(solution.poses[0], solution.poses)[:, :2]
        return float(np.hypot(*apart.T).max())


def lying_world(seed: int, share: float) -> World:
    """Between every two robots ``share`` of the closures are false, a third of them in groups that agree."""
    world = World(seed)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        world.meet(a, b, 30)
        false = round(30 * share / (1.0 - share))
        world.lie(a, b, false - 2 * (false // 6))
        for _ in range(2):
            shift = np.append(world.generator.uniform(3.0, 6.0, 2), world.generator.uniform(-1.0, 1.0))
            world.meet(a, b, false // 6, shift)
    return world


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.1, 0.7])
def test_false_closures_are_found_out_and_true_ones_kept(seed: int, share: float) -> None:
    world = lying_world(seed, share)
    solution = solve_jointly(world.evidence(), SETTINGS)
    robust, true = world.evidence().graph.arrays().robust, np.array(world.true)
    assert solution.maps == (0, 0, 0)
    assert world.error_m(solution) < (0.1 if share < 0.5 else 0.2), "among liars a lone true closure is not believed"
    assert solution.weights[robust & ~true].sum() == 0.0
    assert solution.weights[robust & true].mean() > 0.9


def test_a_group_of_liars_as_large_as_the_truth_joins_nobody() -> None:
    world = World(1)
    world.meet(0, 1, 12)
    world.meet(0, 1, 12, ALIAS)
    solution = solve_jointly(world.evidence(), SETTINGS)
    assert solution.maps == (0, 1, 2)
    (link,) = solution.links
    assert link.decision.contested
    robust = world.evidence().graph.arrays().robust
    between = robust & (np.arange(len(robust)) >= len(robust) - 24)
    assert solution.weights[between].sum() == 0.0


@pytest.mark.parametrize("liars", [0, 60])
def test_among_liars_a_lone_closure_counts_only_if_the_rest_predicts_it(liars: int) -> None:
    """It ties down the end of a path, 0.4 m from where it should be: the odometry of 40 m could be that wrong."""
    world = World(1, own=0)
    meetings = [(i, j) for i, j in world.near(0, 1, 10_000) if i <= 60]
    for k in world.generator.choice(len(meetings), 25, replace=False):
        world.close(0, meetings[k][0], 1, meetings[k][1])
    world.lie(0, 1, liars)
    world.close(0, 100, 1, 50, np.array([0.3, -0.3, 0.0]))
    solution = solve_jointly(world.evidence(), SETTINGS)
    assert solution.maps[:2] == (0, 0)
    assert solution.weights[-1] == (0.0 if liars else 1.0)


def test_robots_that_never_met_are_mapped_each_in_its_own_frame() -> None:
    world = World(3)
    world.lie(0, 1, 40)
    solution = solve_jointly(world.evidence(), SETTINGS)
    assert solution.maps == (0, 1, 2)
    for robot in range(ROBOTS):
        assert np.allclose(solution.poses[world.variable(robot, 0)], STARTS[robot])


@pytest.mark.parametrize("column", ["informative", "independent", "excluded"])
def test_evidence_that_does_not_count_joins_nobody(column: str) -> None:
    world = World(2)
    world.meet(0, 1, 15)
    evidence = world.evidence()
    changed = ~getattr(evidence, column)
    solution = solve_jointly(replace(evidence, **{column: changed}), SETTINGS)
    assert solution.maps == (0, 1, 2)
    assert solution.weights[-15:].sum() == 0.0


def test_excluded_closures_of_a_robots_own_do_not_hold() -> None:
    world = World(2)
    world.close(0, 0, 0, 50, ALIAS)
    evidence = world.evidence()
    evidence.excluded[-2:] = True
    assert solve_jointly(evidence, SETTINGS).weights[-2:].sum() == 0.0


@pytest.mark.parametrize(("dropped", "lasts"), [(0, True), (1, True), (2, False), (3, False)])
def test_a_link_lasts_on_most_of_its_cluster_from_enough_places(dropped: int, lasts: bool) -> None:
    """Eight closures from four places; without the last two of them it would join nobody, however many remain."""
    truth = np.array([(4.0 * k, 0.0, 0.0) for k in range(4)])
    pairs = [0, 0, 0, 1, 1, 1, 2, 3]
    robots = np.arange(4), np.arange(4, 8)
    edges = [Edge(r[k], r[k] + 1, np.array([4.0, 0.0, 0.0]), INFORMATION, False) for r in robots for k in range(3)]
    edges += [Edge(k, k + 4, np.zeros(3), INFORMATION, True) for k in pairs]
    graph = PoseGraph(np.tile(truth, (2, 1)), edges)
    ones, zeros = np.ones(len(edges), bool), np.zeros(len(edges), bool)
    evidence = JointEvidence(graph, robots, ones, ones, zeros)
    (link,) = solve_jointly(evidence, SETTINGS).links
    assert link.decision.evidence.separate_places == 4
    weights = np.ones(len(edges))
    weights[len(edges) - dropped :] = 0.0
    own = [build_trajectory(truth)] * 2
    solution = Solution(graph.poses(), weights, 0, 0.0)
    assert is_confirmed(link, own, solution, ones, SETTINGS) is lasts
    one_place = np.ones(len(edges))
    one_place[-5:] = 0.0
    assert not is_confirmed(link, own, replace(solution, weights=one_place), ones, SETTINGS)
