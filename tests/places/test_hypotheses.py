import numpy as np
import pytest

from fcslam.features.birdseye import describe
from fcslam.features.codes import Matches, mutual_matches
from fcslam.geometry import se2
from fcslam.places.motions import LEAST_INLIERS, rigid_hypotheses
from tests.rooms import asymmetric_room


def matched(T_a_b, rng, inliers, outliers, noise_m=0.05):
    """Keypoints of two places, the matches in random order, and which of them are right."""
    b = rng.uniform(-10.0, 10.0, (inliers + outliers, 2))
    a = se2.transform(T_a_b, b) + rng.normal(0.0, noise_m, b.shape)
    a[inliers:] = rng.uniform(-10.0, 10.0, (outliers, 2))
    count = len(b)
    order_a, order_b, order = rng.permutation(count), rng.permutation(count), rng.permutation(count)
    pairs = np.stack((np.argsort(order_a), np.argsort(order_b)), axis=1)[order]
    distances = rng.integers(10, 60, count).astype(np.uint16)
    return a[order_a].astype(np.float32), b[order_b].astype(np.float32), Matches(pairs, distances), order < inliers


def assert_close(T, expected, metres, radians):
    error = se2.between(expected, T)
    assert np.hypot(error[0], error[1]) < metres
    assert abs(error[2]) < radians


@pytest.mark.parametrize("seed", range(8))
def test_a_motion_among_many_false_matches_is_found(seed):
    rng = np.random.default_rng(seed)
    T_a_b = np.array([*rng.uniform(-5.0, 5.0, 2), rng.uniform(-np.pi, np.pi)])
    a, b, matches, right = matched(T_a_b, rng, inliers=15, outliers=45)
    motion, inliers = rigid_hypotheses(a, b, matches)[0]
    assert_close(motion, T_a_b, metres=0.06, radians=0.02)
    assert set(np.flatnonzero(right)) <= set(inliers)
    assert len(inliers) <= 17


def test_the_result_is_the_least_squares_fit_of_its_inliers():
    rng = np.random.default_rng(11)
    a, b, matches, _ = matched((1.0, 2.0, 0.7), rng, inliers=20, outliers=10)
    motion, inliers = rigid_hypotheses(a, b, matches)[0]
    source = b[matches.pairs[inliers, 1]].astype(float)
    target = a[matches.pairs[inliers, 0]].astype(float)
    u, _, vt = np.linalg.svd((target - target.mean(0)).T @ (source - source.mean(0)))  # Kabsch, the oracle
    rotation = u @ np.diag([1.0, np.linalg.det(u @ vt)]) @ vt
    theta = np.arctan2(rotation[1, 0], rotation[0, 0])
    shift = target.mean(0) - rotation @ source.mean(0)
    np.testing.assert_allclose(motion, [*shift, theta], atol=1e-9)


def test_two_motions_in_the_matches_give_two_hypotheses_the_larger_first():
    rng = np.random.default_rng(12)
    first, second = np.array([1.0, -2.0, 0.5]), np.array([-4.0, 3.0, -2.0])
    a1, b1, m1, _ = matched(first, rng, inliers=20, outliers=0)
    a2, b2, m2, _ = matched(second, rng, inliers=12, outliers=0)
    pairs = np.concatenate((m2.pairs + 20, m1.pairs))
    matches = Matches(pairs, np.concatenate((m2.distances, m1.distances)))
    found = rigid_hypotheses(np.concatenate((a1, a2)), np.concatenate((b1, b2)), matches)
    assert len(found) == 2
    assert_close(found[0][0], first, metres=0.06, radians=0.02)
    assert_close(found[1][0], second, metres=0.08, radians=0.03)


def test_a_mirror_image_is_no_rigid_motion():
    rng = np.random.default_rng(13)
    b = rng.uniform(-10.0, 10.0, (40, 2)).astype(np.float32)
    matches = Matches(np.stack((np.arange(40),) * 2, axis=1), np.zeros(40, np.uint16))
    mirrored = b * np.float32([1.0, -1.0])
    assert all(len(inliers) < 12 for _, inliers in rigid_hypotheses(mirrored, b, matches))


def test_exchanging_the_places_inverts_the_motion():
    rng = np.random.default_rng(14)
    a, b, matches, _ = matched((3.0, 1.0, 2.5), rng, inliers=15, outliers=20)
    forward, _ = rigid_hypotheses(a, b, matches)[0]
    backward, _ = rigid_hypotheses(b, a, Matches(matches.pairs[:, ::-1], matches.distances))[0]
    np.testing.assert_allclose(se2.compose(forward, backward), 0.0, atol=1e-6)


@pytest.mark.parametrize("count", [0, 1, LEAST_INLIERS - 1])
def test_too_few_matches_propose_nothing(count):
    points = np.arange(2 * count, dtype=np.float32).reshape(count, 2) * 3
    matches = Matches(np.stack((np.arange(count),) * 2, axis=1), np.zeros(count, np.uint16))
    assert rigid_hypotheses(points, points, matches) == []


def test_coincident_keypoints_propose_nothing():
    points = np.zeros((10, 2), np.float32)
    matches = Matches(np.stack((np.arange(10),) * 2, axis=1), np.zeros(10, np.uint16))
    assert rigid_hypotheses(points, points, matches) == []


@pytest.mark.parametrize("angle", [0.0, 0.35, np.pi / 2, 1.9, np.pi, -2.6, -0.8])
def test_a_room_moved_by_T_is_found_moved_by_T(angle):
    rng = np.random.default_rng(16)
    T_a_b = np.array([0.8, -0.6, angle])
    here = asymmetric_room(rng)
    (keypoints_a, a), (keypoints_b, b) = describe(se2.transform(T_a_b, here)), describe(here)
    motion, inliers = rigid_hypotheses(keypoints_a, keypoints_b, mutual_matches(a, b, max_distance=60))[0]
    assert_close(motion, T_a_b, metres=0.06, radians=0.01)
    assert len(inliers) >= 25
