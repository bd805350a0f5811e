"""A graph without the inside of its chains has the optimum of the whole graph."""

import numpy as np

from fcslam.geometry import se2
from fcslam.graph.chains import LONGEST, find_chains
from fcslam.graph.factors import FactorCache
from fcslam.graph.optimizer import optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.records import FloatArray


def loops(seed: int, steps: int = 200, every: int = 10) -> PoseGraph:
    """Four rounds of a circle, each variable with odometry, some with a closure to the round before."""
    rng = np.random.default_rng(seed)
    step = np.array((0.5, 0.0, 8.0 * np.pi / steps))
    sigma = np.array((0.01, 0.01, 0.002))
    noisy = step + sigma * rng.normal(size=(steps - 1, 3))
    poses = [np.zeros(3)]
    for motion in noisy:
        poses.append(se2.compose(poses[-1], motion))
    graph = PoseGraph(np.array(poses))
    for k, motion in enumerate(noisy):
        graph.add_edge(Edge(k, k + 1, motion, np.diag(sigma**-2.0), robust=False))
    round_steps = steps // 4
    for k in range(round_steps, steps, every):
        graph.add_edge(Edge(k - round_steps, k, 0.02 * rng.normal(size=3), 2500.0 * np.eye(3), robust=True))
    return graph


def apart_m(a: FloatArray, b: FloatArray) -> float:
    return float(np.abs(se2.between(a, b)).max())


def test_every_trusted_edge_is_in_one_chain_and_only_passed_variables_are_inside() -> None:
    graph = loops(0)
    chains, edges = find_chains(graph), graph.arrays()
    assert sum(len(members) for members, *_ in chains.steps) == np.count_nonzero(~edges.robust)
    closed = set(edges.i[edges.robust]) | set(edges.j[edges.robust])
    assert closed <= set(chains.kept.tolist())
    assert {0, len(graph) - 1} <= set(chains.kept.tolist())
    assert len(chains.kept) < 0.3 * len(graph)


def test_a_long_chain_is_cut_and_composes_its_motions() -> None:
    graph = loops(1, steps=4 * LONGEST + 4, every=1000)
    chains = find_chains(graph)
    poses = graph.poses()
    np.testing.assert_allclose(se2.between(poses[chains.i], poses[chains.j]), chains.T_i_j, atol=1e-12)
    assert (chains.j - chains.i).max() == LONGEST


def test_the_optimum_is_that_of_the_whole_graph() -> None:
    graph = loops(2)
    whole = optimize(graph).poses
    for solve in (optimize, optimize_gnc):
        contracted = solve(graph, factors=FactorCache(graph, find_chains(graph)))
        assert apart_m(contracted.poses, whole) < 2e-4  # standard deviations are a hundred times that
        assert abs(contracted.cost / optimize(graph).cost - 1.0) < 1e-3
    assert apart_m(whole, graph.poses()) > 0.05


def test_branches_and_reversed_edges_end_a_chain() -> None:
    graph = loops(3, steps=40, every=1000)
    branch = graph.add_variable(se2.compose(graph.poses()[5], np.array((1.0, 0.0, 0.0))))
    graph.add_edge(Edge(5, branch, np.array((1.0, 0.0, 0.0)), np.eye(3), robust=False))
    graph.add_edge(Edge(22, 21, np.array((-0.5, 0.0, 0.0)), np.eye(3), robust=False))
    assert {5, 21, 22, branch} <= set(find_chains(graph).kept.tolist())


def test_a_contracted_graph_keeps_the_closures_it_is_given() -> None:
    graph = loops(4)
    chains = find_chains(graph)
    small = chains.contract(PoseGraph(graph.poses(), [edge for edge in graph.edges if not edge.robust or edge.j < 150]))
    edges = small.arrays()
    assert len(small) == len(chains.kept)
    assert np.count_nonzero(edges.robust) == sum(edge.robust and edge.j < 150 for edge in graph.edges)
    np.testing.assert_array_equal(small.poses(), graph.poses()[chains.kept])
    assert chains.kept[edges.j[edges.robust]].max() < 150


def test_a_graph_without_edges_has_no_chains() -> None:
    chains = find_chains(PoseGraph(np.zeros((3, 3))))
    assert len(chains.i) == 0
    np.testing.assert_array_equal(chains.kept, np.arange(3))
