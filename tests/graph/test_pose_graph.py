"""Edges check themselves; chi-square and components against plain loops."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import gammaincinv

from fcslam.geometry import se2
from fcslam.geometry.groups import SE2, SE3
from fcslam.graph.pose_graph import MAXIMUM_INFORMATION, Edge, PoseGraph
from tests.graph.graph_worlds import INFORMATION, manhattan


def edge(i: int, j: int, information: np.ndarray = INFORMATION) -> Edge:
    return Edge(i, j, np.array([1.0, 0.0, 0.1]), information, robust=False)


def test_chi2_is_the_residuals_squared_mahalanobis_length() -> None:
    graph, truth, _ = manhattan(0, steps=20, closures=5)
    for number, known in enumerate(graph.edges):
        residual = se2.log(se2.between(known.T_i_j, se2.between(truth[known.i], truth[known.j])))
        assert graph.chi2(truth)[number] == pytest.approx(residual @ known.information @ residual)


def test_chi2_of_true_motions_is_zero_and_in_the_frame_of_j() -> None:
    information = np.diag([100.0, 1.0, 1.0])
    graph = PoseGraph([(0, 0, 0), (0, 0, 0)], [Edge(0, 1, np.array([0.0, 0.0, np.pi / 2]), information, False)])
    assert graph.chi2([(0, 0, 0), (0, 0, np.pi / 2)]) == pytest.approx([0.0], abs=1e-12)
    assert graph.chi2([(0, 0, 0), (0.0, 0.5, np.pi / 2)]) == pytest.approx([25.0])
    assert graph.chi2([(0, 0, 0), (0.5, 0.0, np.pi / 2)]) == pytest.approx([0.25])


def test_rounding_is_symmetrised_and_more_is_refused() -> None:
    rounded = INFORMATION.copy()
    rounded[0, 1] *= 1.0 + 1e-9
    assert np.array_equal(edge(0, 1, rounded).information, edge(0, 1, rounded).information.T)
    rounded[0, 1] += 0.01 * rounded.max()
    with pytest.raises(ValueError, match="not symmetric"):
        edge(0, 1, rounded)


@pytest.mark.parametrize(
    ("ends", "information", "reason"),
    [
        *(((3, 4), np.diag(bad), r"edge 3 -> 4.*positive definite") for bad in ((1, 1, 0), (1, 1, -1), (0, 0, 0))),
        *(((0, 1), np.full((3, 3), bad), "information must be finite") for bad in (np.nan, np.inf)),
        ((0, 1), np.eye(2), "information must be finite"),
        ((1, 1), INFORMATION, "two different variables"),
        ((-1, 0), INFORMATION, "two different variables"),
    ],
)
def test_what_is_no_edge_is_refused(ends: tuple[int, int], information: np.ndarray, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        edge(*ends, information)


def test_an_edge_names_variables_of_the_graph() -> None:
    with pytest.raises(ValueError, match="variables 0 to 1"):
        PoseGraph(np.zeros((2, 3)), [edge(1, 2)])
    with pytest.raises(ValueError, match="finite"):
        PoseGraph([(0.0, np.inf, 0.0)])


def test_stiff_information_is_bounded_in_the_arrays_only() -> None:
    stiff = np.diag([1e12, 10.0, 50.0])
    graph = PoseGraph(np.zeros((2, 3)), [edge(0, 1, stiff)])
    assert graph.edges[0].information[0, 0] == 1e12
    assert graph.arrays().information[0] == pytest.approx(np.diag([MAXIMUM_INFORMATION, 10.0, 50.0]))
    assert np.array_equal(graph.edges[0].information, graph.given().information[0])
    assert graph.edges[-1].information[0, 0] > MAXIMUM_INFORMATION, "as it was given"


def test_arrays_grow_with_the_graph() -> None:
    whole, _, _ = manhattan(1, steps=12, closures=4)
    grown = PoseGraph(whole.poses())
    for known in whole.edges:
        grown.add_edge(known)
        assert len(grown.arrays().i) == len(grown.edges)
    for name in ("i", "j", "T_i_j", "information", "robust"):
        assert np.array_equal(getattr(grown.arrays(), name), getattr(whole.arrays(), name))


def test_components_are_numbered_by_their_first_variable() -> None:
    graph = PoseGraph(np.zeros((6, 3)), [edge(1, 4), edge(5, 2), edge(0, 3)])
    assert graph.components().tolist() == [0, 1, 2, 0, 1, 2]
    assert graph.components([True, False, True]).tolist() == [0, 1, 2, 0, 1, 5]
    assert PoseGraph(np.zeros((2, 3))).components().tolist() == [0, 1]
    assert PoseGraph().components().tolist() == []


def test_components_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        count = int(rng.integers(2, 40))
        graph = PoseGraph(np.zeros((count, 3)))
        pairs = [rng.choice(count, 2, replace=False).tolist() for _ in range(int(rng.integers(0, count)))]
        for i, j in pairs:
            graph.add_edge(edge(i, j))
        links = coo_array((np.ones(len(pairs)), np.array(pairs, int).reshape(-1, 2).T), shape=(count, count))
        label = connected_components(links, directed=False)[1]
        first = [label.tolist().index(own) for own in label]
        assert graph.components().tolist() == first


def test_limit_of_chi_square_is_its_quantile() -> None:
    for group in (SE2, SE3):
        assert pytest.approx(float(2.0 * gammaincinv(group.freedom / 2.0, 0.99)), rel=1e-12) == group.chi2_limit
