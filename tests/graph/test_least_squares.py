"""The linear solver beside a dense one, and the derivatives of the group."""

import numpy as np
import pytest

from fcslam.geometry.groups import SE2, SE3, Group
from fcslam.graph.cholesky import find_structure, solve
from fcslam.graph.least_squares import Loss


@pytest.mark.parametrize("size", [1, 2, 3, 6])
@pytest.mark.parametrize("edges", [1, 30, 300])
def test_the_sparse_solution_is_the_dense_one(edges: int, size: int) -> None:
    rng = np.random.default_rng(edges + size)
    count, height, damping = 40, size + 1, 0.1
    i = rng.integers(0, count, edges)
    j = (i + rng.integers(1, count, edges)) % count
    of_i, of_j = rng.normal(size=(2, edges, height, size))
    residual, held = rng.normal(size=(edges, height)), rng.random(count) < 0.1
    root = rng.normal(size=(edges, height, height))
    dense = np.zeros((edges, height, count, size))
    dense[np.arange(edges), :, i], dense[np.arange(edges), :, j] = of_i, of_j
    dense[:, :, held] = 0.0
    rows = (root @ dense.reshape(edges, height, -1)).reshape(-1, count * size)
    right = np.einsum("eab,eb->ea", root, residual).ravel()
    expected = np.linalg.solve(rows.T @ rows + damping * np.eye(count * size), -rows.T @ right)
    structure = find_structure(i, j, count)
    x, gradient = solve(structure, (of_i, of_j), root.swapaxes(1, 2) @ root, residual, held, damping)
    assert x.ravel() == pytest.approx(expected, abs=1e-9)
    assert gradient.ravel() == pytest.approx(rows.T @ right, abs=1e-9)


def test_singular_equations_have_no_solution() -> None:
    i, j, unit = np.array([0, 1]), np.array([1, 2]), np.tile(np.eye(3), (2, 1, 1))
    free, ends = np.zeros(3, bool), find_structure(i, j, 3)
    assert np.isnan(solve(ends, (-unit, unit), unit, np.ones((2, 3)), free)[0]).all()
    x, _ = solve(ends, (-unit, unit), unit, np.ones((2, 3)), np.arange(3) == 0)
    assert x == pytest.approx(np.array([[0.0], [-1.0], [-2.0]]) * np.ones(3))


@pytest.mark.parametrize("group", [SE2, SE3], ids=["SE2", "SE3"])
def test_jacobians_are_the_derivatives_of_the_residual(group: Group) -> None:
    rng = np.random.default_rng(0)
    T_i_j, x_i, x_j = group.exp(rng.normal(0.0, 0.7, (3, 200, group.freedom)))
    T_i_j[:50] = group.between(x_i[:50], x_j[:50])  # small residuals
    T_i_j[:50] = group.compose(T_i_j[:50], group.exp(rng.normal(0.0, 1e-4, (50, group.freedom))))
    residual, step = group.residual(T_i_j, x_i, x_j), 1e-6
    for jacobian, moved in zip(group.jacobians(residual, x_i, x_j), (0, 1), strict=True):
        for axis in range(group.freedom):
            off = step * np.eye(group.freedom)[[axis] * 200]
            before, after = (
                group.residual(
                    T_i_j, *(group.retract(x, sign * off) if k == moved else x for k, x in enumerate((x_i, x_j)))
                )
                for sign in (-1.0, 1.0)
            )
            assert (after - before) / (2.0 * step) == pytest.approx(jacobian[:, :, axis], rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("loss", Loss)
def test_weights_are_the_derivative_of_the_loss(loss: Loss) -> None:
    chi2 = np.array([0.0, 1.0, 30.0, 1e4])
    slope = (loss.values(chi2 + 1e-4) - loss.values(chi2)) / 1e-4
    assert loss.weights(chi2) == pytest.approx(slope, rel=1e-4)
