"""Laws of the group SE(3), against matrices and their exponential, and against SE(2) in the plane."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from fcslam.geometry import se2, se3

length, turn = st.floats(-50.0, 50.0), st.floats(-1.7, 1.7)
tangents = st.tuples(length, length, length, turn, turn, turn)
poses = tangents.map(se3.exp)


def hat(tangent: np.ndarray) -> np.ndarray:
    """Element of the Lie algebra as a matrix."""
    (x, y, z), (a, b, c) = tangent[:3], tangent[3:]
    return np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]])


def matrix(T: np.ndarray) -> np.ndarray:
    homogeneous = np.eye(4)
    homogeneous[:3, :3], homogeneous[:3, 3] = se3.rotation(T), T[:3]
    return homogeneous


def close(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-9) -> bool:
    return bool(np.allclose(matrix(a), matrix(b), rtol=0.0, atol=tolerance))


@given(poses, poses, poses)
def test_group_axioms(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    assert close(se3.compose(se3.compose(a, b), c), se3.compose(a, se3.compose(b, c)))
    assert close(se3.compose(a, se3.IDENTITY), a)
    assert close(se3.compose(se3.IDENTITY, a), a)
    assert close(se3.compose(a, se3.inverse(a)), se3.IDENTITY)
    assert close(se3.between(a, b), se3.compose(se3.inverse(a), b))


@given(poses, poses)
def test_composing_multiplies_matrices(a: np.ndarray, b: np.ndarray) -> None:
    assert matrix(se3.compose(a, b)) == pytest.approx(matrix(a) @ matrix(b), abs=1e-9)
    assert close(se3.from_matrix(matrix(a)), a)
    assert np.linalg.norm(se3.compose(a, b)[3:]) == pytest.approx(1.0)


@given(poses, poses, st.integers(0, 1000))
def test_transform_is_an_action(a: np.ndarray, b: np.ndarray, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-10.0, 10.0, (5, 3))
    assert se3.transform(se3.compose(a, b), points) == pytest.approx(
        se3.transform(a, se3.transform(b, points)), abs=1e-8
    )


@given(tangents)
def test_exp_is_the_exponential_of_the_matrix_and_log_its_inverse(tangent: tuple[float, ...]) -> None:
    v = np.array(tangent)
    assert matrix(se3.exp(v)) == pytest.approx(expm(hat(v)), abs=1e-8)
    assert close(se3.exp(se3.log(se3.exp(v))), se3.exp(v), 1e-8)
    if np.linalg.norm(v[3:]) < 3.1:
        assert se3.log(se3.exp(v)) == pytest.approx(v, abs=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0499, 0.0501, 1.0, 3.0, np.pi])
def test_small_and_large_angles_are_exact(angle: float) -> None:
    v = np.array([3.0, -2.0, 5.0, 0.6 * angle, 0.0, -0.8 * angle])
    assert matrix(se3.exp(v)) == pytest.approx(expm(hat(v)), abs=1e-12)
    assert np.abs(se3.log(se3.exp(v))) == pytest.approx(np.abs(v), abs=1e-9)
    if 0.0 < angle < 3.0:
        assert hat(se3.log(se3.exp(v))) == pytest.approx(np.real(logm(expm(hat(v)))), abs=1e-7)


@given(tangents, st.integers(0, 1000))
def test_log_jacobian_is_the_derivative(tangent: tuple[float, ...], seed: int) -> None:
    v, d = np.array(tangent), 1e-6 * np.random.default_rng(seed).normal(size=6)
    if np.linalg.norm(v[3:]) < 3.0:
        there, back = (se3.log(se3.compose(se3.exp(v), se3.exp(sign * d))) for sign in (1, -1))
        assert (there - back) / 2e-6 == pytest.approx(se3.log_jacobian(v) @ d / 1e-6, abs=2e-5 * (1 + np.abs(v).max()))


@given(poses, st.integers(0, 1000))
def test_adjoint_moves_a_twist(a: np.ndarray, seed: int) -> None:
    v = np.random.default_rng(seed).normal(size=6)
    moved = se3.compose(a, se3.compose(se3.exp(v), se3.inverse(a)))
    assert close(moved, se3.exp(se3.adjoint(a) @ v), 1e-7)


def test_a_batch_is_its_rows() -> None:
    v = np.random.default_rng(3).normal(size=(2, 4, 6))
    a, points = se3.exp(v), np.random.default_rng(4).normal(size=(2, 4, 5, 3))
    assert se3.compose(a, a[0, 1])[1, 2] == pytest.approx(se3.compose(a[1, 2], a[0, 1]))
    assert se3.transform(a, points)[1, 2] == pytest.approx(se3.transform(a[1, 2], points[1, 2]))
    for function in (se3.log, se3.inverse, se3.adjoint, se3.rotation, se3.to_plane):
        assert function(a)[1, 3] == pytest.approx(function(a[1, 3]))
    assert se3.log_jacobian(v)[1, 3] == pytest.approx(se3.log_jacobian(v[1, 3]))


@given(st.tuples(length, length, st.floats(-3.1, 3.1)), st.tuples(length, length, st.floats(-3.1, 3.1)))
def test_the_plane_is_a_subgroup(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    lifted = se3.compose(se3.from_plane(a), se3.from_plane(b))
    assert close(lifted, se3.from_plane(se2.compose(a, b)), 1e-8)
    assert se2.between(se3.to_plane(se3.from_plane(a)), a) == pytest.approx(0.0, abs=1e-9)
    of_plane = se3.log(se3.from_plane(a))
    assert of_plane[[0, 1, 5]] == pytest.approx(se2.log(a), abs=1e-7)
    assert se3.log_jacobian(of_plane)[np.ix_([0, 1, 5], [0, 1, 5])] == pytest.approx(
        se2.log_jacobian(se2.log(a)), abs=1e-7
    )
