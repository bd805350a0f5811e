"""Laws of the optimum, an independent solver, and false closures."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.geometry.groups import SE2
from fcslam.graph.initialization import initialize, initialize_robust
from fcslam.graph.least_squares import Loss, minimize
from fcslam.graph.optimizer import (
    PosePrior,
    Solution,
    optimize,
    optimize_anchored,
    optimize_gnc,
    refine_inliers,
)
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.graph.single_robot import solve_single_robot
from tests.graph.graph_worlds import INFORMATION, gtsam_optimum, manhattan

pytestmark = pytest.mark.slow


def apart(a: np.ndarray, b: np.ndarray) -> float:
    """Largest coordinate of the motions between two sets of poses."""
    return float(np.abs(se2.between(a, b)).max())


@pytest.mark.parametrize("loss", Loss)
@pytest.mark.parametrize("seed", range(3))
def test_the_optimum_is_that_of_gtsam(seed: int, loss: Loss) -> None:
    graph, _, _ = manhattan(seed, steps=80, closures=30, outlier_share=0.2 if loss is Loss.CAUCHY else 0.0)
    start = initialize_robust(graph)
    oracle, cost = gtsam_optimum(graph, start, loss)
    edges, first = graph.arrays(), np.arange(len(graph)) == 0
    poses, _, found = minimize(SE2, edges, start, first, loss=loss, tolerance=0.0)
    assert apart(poses, oracle) < 1e-6
    assert found == pytest.approx(cost, rel=1e-9)
    assert optimize(graph, start, loss=loss).cost == pytest.approx(cost, rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_the_optimum_with_priors_is_that_of_gtsam(seed: int) -> None:
    graph, truth, _ = manhattan(seed, steps=60, closures=20)
    T = np.array([5.0, 3.0, 1.0])
    priors = [PosePrior(k, se2.compose(T, truth[k]) + 0.02, np.diag((300.0, 50.0, 1e-6))) for k in (3, 20, 55)]
    poses = optimize_anchored(graph, se2.compose(T, graph.poses()), priors)
    oracle, _ = gtsam_optimum(graph, se2.compose(T, graph.poses()), priors=priors)
    assert apart(poses, oracle) < 1e-6


@pytest.mark.parametrize("solve", [optimize, optimize_gnc])
def test_order_of_edges_does_not_matter_and_repetition_gives_the_same_bytes(solve: type[Solution]) -> None:
    graph, _, _ = manhattan(2, steps=80, closures=30, outlier_share=0.3)
    graph = graph if solve is optimize_gnc else manhattan(2, steps=80, closures=30)[0]
    order = np.random.default_rng(0).permutation(len(graph.edges))
    shuffled = PoseGraph(graph.poses(), [graph.edges[k] for k in order])
    first, second = solve(graph), solve(shuffled)
    assert apart(first.poses, second.poses) < 1e-3
    assert np.array_equal(first.weights[order], second.weights)
    again = solve(graph)
    assert first.poses.tobytes() == again.poses.tobytes()
    assert first.weights.tobytes() == again.weights.tobytes()


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("seed", range(3))
def test_a_robot_alone_rejects_false_closures(seed: int, share: float) -> None:
    graph, truth, true = manhattan(seed, closures=60, outlier_share=share)
    solution = solve_single_robot(graph)
    clean = optimize(PoseGraph(graph.poses(), [e for e, known in zip(graph.edges, true, strict=True) if known]))
    assert (solution.weights[~true] == 0.0).all()
    assert (solution.weights[true] == 0.0).sum() <= 4
    assert np.abs(solution.poses[:, :2] - clean.poses[:, :2]).max() < 0.1
    assert np.abs(optimize(graph).poses[:, :2] - truth[:, :2]).max() > 1.0


def test_what_stays_of_the_witnessed_start_is_the_cheaper_solution() -> None:
    """A robot that meets each place but once has no supporting closures: all its closures count nevertheless."""
    truth = np.array([(10.0 * np.cos(a), 10.0 * np.sin(a), a + np.pi / 2) for a in np.linspace(0.0, 2.0 * np.pi, 63)])
    edges = [
        Edge(k, k + 1, se2.compose(se2.between(*truth[k : k + 2]), (0.0, 0.0, 0.002)), INFORMATION, False)
        for k in range(62)
    ]
    edges.append(Edge(0, 62, se2.between(truth[0], truth[62]), INFORMATION, True))
    graph = PoseGraph(truth, edges)
    solution = solve_single_robot(graph)
    assert solution.weights[-1] == 1.0
    assert np.abs(se2.between(solution.poses[0], solution.poses[62])[:2]).max() < 0.05


def test_settling_starts_from_what_is_trusted() -> None:
    """With seven of ten closures false, the true ones as a start find everything; the false ones find no more."""
    graph, _, true = manhattan(1, closures=60, outlier_share=0.7)
    clean = optimize(PoseGraph(graph.poses(), [e for e, known in zip(graph.edges, true, strict=True) if known]))
    settled = refine_inliers(graph, clean.poses, true)
    assert (settled.weights[~true] == 0.0).all()
    assert (settled.weights[true] == 0.0).sum() <= 4
    assert refine_inliers(graph, clean.poses, ~true).cost > settled.cost
    with pytest.raises(ValueError, match="weights must be of shape"):
        refine_inliers(graph, clean.poses, true[:-1])


def test_a_clean_graph_keeps_every_closure_and_its_optimum() -> None:
    graph, _, _ = manhattan(5)
    graph = PoseGraph(graph.poses(), [replace(edge, information=edge.information / 4.0) for edge in graph.edges])
    solution = optimize_gnc(graph)
    assert (solution.weights == 1.0).all()
    assert apart(solution.poses, optimize(graph).poses) < 1e-3


def test_the_cauchy_loss_weighs_false_closures_down() -> None:
    graph, truth, true = manhattan(3, outlier_share=0.2)
    cauchy = optimize(graph, initialize_robust(graph), loss=Loss.CAUCHY)
    assert cauchy.weights[~true].max() < 0.05 < cauchy.weights[true].min()
    assert np.abs(cauchy.poses[:, :2] - truth[:, :2]).max() < 0.5
    assert (cauchy.weights[~graph.arrays().robust] == 1.0).all()


def two_components(T: np.ndarray) -> tuple[PoseGraph, PoseGraph, PoseGraph]:
    """Two graphs, and one of both, the second moved by T (3,)."""
    one, _, _ = manhattan(0, steps=40, closures=15)
    two, _, _ = manhattan(1, steps=50, closures=15)
    offset = len(one)
    second = [Edge(e.i + offset, e.j + offset, e.T_i_j, e.information, e.robust) for e in two.edges]
    return one, two, PoseGraph(np.concatenate((one.poses(), se2.compose(T, two.poses()))), [*one.edges, *second])


def test_components_are_solved_apart_each_in_its_own_gauge() -> None:
    T = np.array([100.0, 5.0, 1.0])
    one, two, both = two_components(T)
    offset = len(one)
    for poses in (optimize(both).poses, optimize_gnc(both).poses):
        assert apart(poses[:offset], optimize(one).poses) < 1e-3
        assert apart(poses[offset:], se2.compose(T, optimize(two).poses)) < 1e-3


def test_a_component_whose_only_link_is_rejected_stays_where_it_was() -> None:
    one, _, _ = manhattan(0, steps=40, closures=0)
    count = len(one)
    copy = [Edge(e.i + count, e.j + count, e.T_i_j, e.information, False) for e in one.edges]
    false = [
        Edge(5, count + 30, np.array([0.0, 3.0, 1.0]), INFORMATION, True),
        Edge(20, count + 2, np.array([9.0, 1.0, 2.0]), INFORMATION, True),
        Edge(9, count + 12, np.array([-7.0, 1.0, -2.0]), INFORMATION, True),
    ]
    graph = PoseGraph(np.tile(one.poses(), (2, 1)), [*one.edges, *copy, *false])
    solution = optimize_gnc(graph)
    kept = graph.components(solution.weights > 0.0)
    assert np.isfinite(solution.poses).all()
    for component in np.unique(kept):
        first = np.flatnonzero(kept == component)[0]
        assert solution.poses[first] == pytest.approx(graph.poses()[first])


@pytest.mark.parametrize("solve", [optimize, optimize_gnc])
def test_small_graphs(solve: type[Solution]) -> None:
    assert solve(PoseGraph()).poses.shape == (0, 3)
    single = solve(PoseGraph([(1.0, 2.0, 3.0)]))
    assert single.poses.tolist() == [[1.0, 2.0, 3.0]]
    assert single.weights.shape == (0,)
    T_0_1 = np.array([1.0, 0.5, 0.2])
    pair = solve(PoseGraph([(1.0, 2.0, 3.0), (0, 0, 0)], [Edge(0, 1, T_0_1, INFORMATION, False)]))
    assert pair.poses[1] == pytest.approx(se2.compose((1.0, 2.0, 3.0), T_0_1), abs=1e-4)


def test_misfits_are_refused() -> None:
    graph, _, _ = manhattan(0, steps=5, closures=0)
    with pytest.raises(ValueError, match=r"shape \(6, 3\)"):
        optimize(graph, np.zeros((5, 3)))
    with pytest.raises(ValueError, match="finite"):
        optimize_gnc(graph, np.full((6, 3), np.nan))


def test_initialisation_needs_no_estimate() -> None:
    graph, _, _ = manhattan(7)
    lost = PoseGraph(np.random.default_rng(0).uniform(-99.0, 99.0, (len(graph), 3)), graph.edges)
    T = se2.compose(lost.poses()[0], se2.inverse(graph.poses()[0]))
    start = initialize(lost)
    optimum = optimize(graph).poses
    assert start[0] == pytest.approx(lost.poses()[0])
    assert apart(start, se2.compose(T, optimum)) < 0.5
    assert apart(optimize(lost, start).poses, se2.compose(T, optimum)) < 1e-3


def test_initialisation_by_odometry_alone_is_the_odometry() -> None:
    graph, _, _ = manhattan(7, outlier_share=0.5)
    lost = PoseGraph(np.zeros((len(graph), 3)), graph.edges)
    assert apart(initialize(lost, ~graph.arrays().robust), graph.poses()) < 1e-6
    assert np.array_equal(initialize(PoseGraph([(1.0, 2.0, 3.0)])), [[1.0, 2.0, 3.0]])


def test_robust_initialisation_ignores_false_closures() -> None:
    graph, _, true = manhattan(8, outlier_share=0.5)
    chi2 = graph.chi2(initialize_robust(graph))
    assert np.median(chi2[true & graph.arrays().robust]) < 10.0
    assert chi2[~true].min() > 100.0
