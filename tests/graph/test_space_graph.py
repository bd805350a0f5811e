"""Poses in space: the optimum of GTSAM, false closures, and the same result as in the plane for what is in a plane."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from fcslam.geometry import se2, se3
from fcslam.geometry.groups import SE2, SE3
from fcslam.graph.cluster import relative_frame
from fcslam.graph.consistency import Closures, pairwise_consistency
from fcslam.graph.g2o import g2o_text
from fcslam.graph.initialization import initialize
from fcslam.graph.least_squares import Loss, minimize
from fcslam.graph.optimizer import optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.graph.single_robot import solve_single_robot
from fcslam.graph.trajectory import build_trajectory
from tests.graph.graph_worlds import gtsam_optimum, manhattan

pytestmark = pytest.mark.slow

SIGMAS = np.array([0.03, 0.02, 0.04, 0.005, 0.008, 0.006])


def spiral(seed: int, steps: int, false: int = 0) -> tuple[PoseGraph, np.ndarray]:
    """A graph at its odometry's poses of a drive that rises in circles of 20 steps, and the true poses."""
    rng = np.random.default_rng(seed)
    root = rng.uniform(-1.0, 1.0, (6, 6))
    covariance = np.outer(SIGMAS, SIGMAS) * (0.2 * root @ root.T + np.eye(6))
    information = np.linalg.inv(covariance)
    step = se3.exp((1.0, 0.0, 0.05, 0.02, 0.01, np.pi / 10.0))
    truth = [se3.IDENTITY]
    for _ in range(steps):
        truth.append(se3.compose(truth[-1], step))
    pairs = [(k, k + 1) for k in range(steps)] + [(k, k + 20) for k in range(0, steps - 19, 3)]
    noise = rng.multivariate_normal(np.zeros(6), covariance, len(pairs))
    edges = [
        Edge(i, j, se3.compose(se3.between(truth[i], truth[j]), se3.exp(noise[n])), information, j - i > 1)
        for n, (i, j) in enumerate(pairs)
    ]
    drifted = [se3.IDENTITY]
    for edge in edges[:steps]:
        drifted.append(se3.compose(drifted[-1], edge.T_i_j))
    for _ in range(false):
        i, j = sorted(rng.choice(steps + 1, 2, replace=False).tolist())
        edges.append(Edge(i, j, se3.exp(rng.normal(0.0, 1.0, 6)), information, True))
    return PoseGraph(np.array(drifted), edges, SE3), np.array(truth)


@pytest.mark.parametrize("loss", Loss)
def test_the_optimum_is_that_of_gtsam(loss):
    graph, _ = spiral(0, 60, false=4 if loss is Loss.CAUCHY else 0)
    oracle, cost = gtsam_optimum(graph, graph.poses(), loss)
    held = np.arange(len(graph)) == 0
    poses, _, found = minimize(SE3, graph.arrays(), graph.poses(), held, loss=loss, tolerance=0.0)
    assert np.abs(se3.log(se3.between(poses, oracle))).max() < 1e-6
    assert found == pytest.approx(cost, rel=1e-8)


def test_exact_measurements_give_the_truth_without_a_start():
    graph, truth = spiral(2, 70)
    edges = graph.given()
    exact = replace(edges, T_i_j=se3.between(truth[edges.i], truth[edges.j]))
    lost = PoseGraph.restored(np.tile(se3.IDENTITY, (len(graph), 1)), exact)
    assert np.abs(se3.log(se3.between(truth, initialize(lost)))).max() < 1e-9


@pytest.mark.parametrize("solve", [optimize_gnc, solve_single_robot])
def test_false_closures_are_rejected_and_true_ones_kept(solve):
    graph, truth = spiral(3, 100, false=15)
    solution = solve(graph)
    robust = graph.arrays().robust
    assert np.count_nonzero(solution.weights[:-15] == 0.0) <= 1, "of a hundred true ones, the limit takes one"
    assert not solution.weights[-15:].any()
    assert robust[-15:].all()
    assert SE3.shift_m(se3.between(truth, solution.poses)).max() < 0.5
    assert solve(graph).poses.tobytes() == solution.poses.tobytes()


def test_what_lies_in_a_plane_has_the_optimum_of_the_plane():
    graph, _, _ = manhattan(1, steps=80, closures=30)
    edges = graph.given()
    information = np.tile(1e4 * np.eye(6), (graph.edge_count, 1, 1))
    information[:, [[0], [1], [5]], [0, 1, 5]] = edges.information
    lifted = replace(edges, T_i_j=se3.from_plane(edges.T_i_j), information=information)
    in_space = PoseGraph.restored(se3.from_plane(graph.poses()), lifted)
    planar, space = optimize(graph).poses, optimize(in_space).poses
    assert np.abs(space[:, 2:5]).max() < 1e-9
    assert np.abs(se2.between(planar, SE3.to_plane(space))).max() < 1e-4
    back = in_space.to_plane().given()
    np.testing.assert_allclose(back.information, edges.information, rtol=1e-9)
    np.testing.assert_allclose(back.T_i_j, edges.T_i_j, atol=1e-12)


def test_true_closures_between_two_paths_agree_and_give_their_frame():
    _, truth = spiral(4, 60)
    T_b_a = se3.exp((4.0, -2.0, 1.5, 0.1, -0.2, 2.0))
    other = se3.compose(T_b_a, truth)
    paths = build_trajectory(truth), build_trajectory(other)
    ends = np.arange(0, 60, 10)
    noise = se3.exp(np.random.default_rng(0).normal(0.0, 0.5, (6, 6)) * SIGMAS)
    T_i_j = se3.compose(np.tile(se3.IDENTITY, (6, 1)), noise)
    information = np.tile(np.diag(SIGMAS**-2.0), (6, 1, 1))
    closures = Closures(ends, ends, T_i_j, information)
    assert pairwise_consistency(*paths, closures).all()
    T_a_b = se3.inverse(T_b_a)
    assert np.abs(se3.log(se3.between(T_a_b, relative_frame(*paths, closures)))).max() < 0.05
    lifted = replace(closures, T_i_j=T_i_j + np.eye(7)[2] * 0.6 * (ends[:, None] == 20))
    consistent = pairwise_consistency(*paths, lifted)
    assert not consistent[2, [1, 3]].any(), "a closure 0.6 m higher agrees with none near by"
    turned = closures.reversed(ends == 20).reversed(ends == 20)
    np.testing.assert_allclose(turned.information, closures.information, rtol=1e-9, atol=1e-6)


def test_a_graph_in_space_is_written_as_g2o(tmp_path):
    graph, _ = spiral(5, 25)
    path = tmp_path / "graph.g2o"
    path.write_text(g2o_text(graph, range(len(graph))))
    problem, values = gtsam.readG2o(str(path), True)
    assert (problem.size(), values.size()) == (graph.edge_count, len(graph))
    read = np.array([se3.from_matrix(values.atPose3(k).matrix()) for k in range(len(graph))])
    np.testing.assert_allclose(se3.log(se3.between(graph.poses(), read)), 0.0, atol=1e-9)


def test_information_of_a_plane_leaves_the_rest_free():
    covariance = np.diag(np.arange(1.0, 7.0))
    covariance[0, 5] = covariance[5, 0] = 0.3
    planar = SE3.planar_information(np.linalg.inv(covariance))
    np.testing.assert_allclose(np.linalg.inv(planar), covariance[np.ix_((0, 1, 5), (0, 1, 5))], atol=1e-12)
    assert SE2.planar_information(planar) is planar
