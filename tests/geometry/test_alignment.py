"""Laws of point alignment, against a general least-squares solver and the paper's printed formula."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.graph.cluster import rotation_eq5, two_point_alignment

coordinate = st.floats(-50.0, 50.0)
poses = st.tuples(coordinate, coordinate, st.floats(-3.1, 3.1))


def cloud(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-10.0, 10.0, (count, 2))


@given(poses, st.integers(0, 1000), st.integers(2, 12))
def test_exact_matches_give_the_pose_back(T_a_b: tuple[float, float, float], seed: int, count: int) -> None:
    b = cloud(seed, count)
    assert se2.between(T_a_b, n_point_alignment(se2.transform(T_a_b, b), b)) == pytest.approx(0.0, abs=1e-8)


@given(poses, st.integers(0, 1000))
def test_two_points_are_the_least_squares_of_two(T_a_b: tuple[float, float, float], seed: int) -> None:
    b = cloud(seed, 2)
    a = se2.transform(T_a_b, b) + np.random.default_rng(seed).normal(0.0, 0.3, (2, 2))
    assert se2.between(two_point_alignment(a, b), n_point_alignment(a, b)) == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_weighted_optimum_is_the_solvers(seed: int) -> None:
    generator = np.random.default_rng(seed)
    b, weights = cloud(seed, 7), generator.uniform(0.1, 3.0, 7)
    a = se2.transform((3.0, -2.0, 2.0), b) + generator.normal(0.0, 0.5, b.shape)
    oracle = least_squares(lambda T: (np.sqrt(weights)[:, None] * (se2.transform(T, b) - a)).ravel(), (3.0, -2.0, 2.0))
    assert se2.between(oracle.x, n_point_alignment(a, b, weights)) == pytest.approx(0.0, abs=1e-5)


def test_a_weight_of_zero_removes_a_point() -> None:
    a, b = cloud(1, 6), cloud(2, 6)
    without = n_point_alignment(a[:5], b[:5])
    assert n_point_alignment(a, b, [1, 1, 1, 1, 1, 0]) == pytest.approx(without)


def test_a_batch_is_its_rows() -> None:
    a, b = cloud(1, 24).reshape(2, 4, 3, 2), cloud(2, 24).reshape(2, 4, 3, 2)
    batch = n_point_alignment(a, b)
    assert batch.shape == (2, 4, 3)
    assert batch[1, 2] == pytest.approx(n_point_alignment(a[1, 2], b[1, 2]))


def test_swapping_the_frames_inverts() -> None:
    a, b = cloud(1, 5), cloud(2, 5)
    assert se2.compose(n_point_alignment(a, b), n_point_alignment(b, a))[2] == pytest.approx(0.0, abs=1e-12)


def test_degenerate_rows_are_nan_and_the_others_are_not() -> None:
    b = np.stack((cloud(1, 3), np.full((3, 2), 7.3)))
    batch = n_point_alignment(b, b)
    assert np.isfinite(batch[0]).all()
    assert np.isnan(batch[1]).all()
    assert np.isnan(n_point_alignment(b[0], b[0], [1.0, 0.0, 0.0])).all()
    assert np.isnan(n_point_alignment(b[0], b[0], [0.0, 0.0, 0.0])).all()


@pytest.mark.parametrize("origin", [(0.0, 0.0), (1e5, 0.0), (453_000.0, 5_411_000.0)])
def test_points_in_a_room_determine_the_pose_however_far_from_the_origin_it_is(origin: tuple[float, float]) -> None:
    b = cloud(3, 50) / 2.0
    T_a_b = (*origin, 0.3)
    a = se2.transform(T_a_b, b)
    assert n_point_alignment(a, b) == pytest.approx(T_a_b, abs=1e-8)
    k, m = np.argmin(b[:, 0]), np.argmax(b[:, 0])
    assert two_point_alignment(a[[k, m]], b[[k, m]]) == pytest.approx(T_a_b, abs=1e-8)
    one_place = np.tile(np.add(origin, (0.1, 0.2)), (50, 1))
    assert np.isnan([n_point_alignment(one_place, one_place), n_point_alignment(one_place, b)]).all()
    with pytest.raises(ValueError, match="coincident"):
        two_point_alignment(one_place[:2], b[:2])


@pytest.mark.parametrize(
    ("a", "b"), [([[1e3, 2.0]] * 2, [[0.0, 0.0], [1.0, 0.0]]), ([[0.0, 0.0], [1.0, 0.0]], [[0.1, 0.2]] * 2)]
)
def test_two_coincident_points_are_refused(a: list[list[float]], b: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="coincident"):
        two_point_alignment(a, b)


def test_misfits_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        n_point_alignment(np.zeros((3, 2)), np.zeros((4, 2)))


def test_eq6_as_printed_is_no_rigid_map_between_two_frames() -> None:
    alpha, shift = -0.7, np.array([[1.0, 0.0, 4.0], [0.0, 1.0, -1.5], [0.0, 0.0, 1.0]])
    b = np.array([[2.0, 1.0], [5.0, -3.0]])
    a = se2.transform((4.0, -1.5, -alpha), b)
    homogeneous = np.column_stack((b, np.ones(2))).T
    R = rotation_eq5(alpha)

    printed = -shift @ R @ shift @ homogeneous
    corrected = shift @ R @ homogeneous

    assert pytest.approx(a) == corrected[:2].T
    assert two_point_alignment(a, b) == pytest.approx((4.0, -1.5, -alpha))
    assert printed[2] == pytest.approx(-1.0)
    for reading in (printed[:2].T, (printed / printed[2])[:2].T):
        assert np.linalg.norm(reading - a, axis=1).min() > 3.0
    twice = -shift @ shift @ homogeneous
    assert (twice / twice[2])[:2].T - b == pytest.approx(np.tile(2.0 * shift[:2, 2], (2, 1)))
