import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from fcslam.features.birdseye import describe, likelihood_picture, pixels_to_metres
from fcslam.features.codes import mutual_matches
from fcslam.geometry import se2
from tests.rooms import asymmetric_room


def test_the_picture_is_the_likelihood_of_the_nearest_point():
    rng = np.random.default_rng(0)
    points = (rng.integers(-200, 200, (60, 2)) + 0.5) * 0.025  # where a quarter of a cell has its middle
    inside = points[(np.abs(points) < 4.0).all(axis=1)]
    columns, rows = np.meshgrid(np.arange(80), np.arange(80))
    centres = (np.stack((columns, rows), axis=-1) + 0.5) * 0.1 - 4.0
    distances_m = cKDTree(inside).query(centres)[0]
    field = 255.0 * np.exp(-(distances_m**2) / (2.0 * 0.35**2))
    np.testing.assert_allclose(likelihood_picture(points, 80), field, atol=0.51)


def test_a_point_lies_in_the_middle_of_its_likelihood():
    point = np.array([[1.05, -3.45]])
    row, column = np.unravel_index(likelihood_picture(point).argmax(), (300, 300))
    np.testing.assert_allclose(pixels_to_metres(np.array([[column, row]])), point, atol=1e-9)


def test_turning_by_a_right_angle_moves_the_keypoints_and_keeps_the_descriptors():
    points = asymmetric_room(np.random.default_rng(1))
    centred = (np.floor(points / 0.025) + 0.5) * 0.025
    turned = se2.transform((0.0, 0.0, np.pi / 2), centred)
    (before_m, before), (after_m, after) = describe(centred), describe(turned)
    nearest, index = cKDTree(after_m).query(se2.transform((0.0, 0.0, np.pi / 2), before_m))
    seen = nearest < 1e-3
    assert seen.mean() > 0.95
    distances = np.bitwise_count(before[seen] ^ after[index[seen]]).sum(axis=1)
    assert np.median(distances) <= 2


@pytest.mark.parametrize("angle", [0.4, 1.1, 2.3, -2.7])
def test_matched_keypoints_lie_where_the_motion_puts_them(angle):
    rng = np.random.default_rng(2)
    points = asymmetric_room(rng)
    T_a_b = (0.63, -0.41, angle)
    keypoints_a, a = describe(se2.transform(T_a_b, points))
    keypoints_b, b = describe(points)
    matches = mutual_matches(a, b, max_distance=40)
    moved = se2.transform(T_a_b, keypoints_b[matches.pairs[:, 1]])
    errors = np.linalg.norm(keypoints_a[matches.pairs[:, 0]] - moved, axis=1)
    assert np.sum(errors < 0.15) >= 25
    assert np.median(errors[errors < 0.3]) < 0.1


def test_the_strongest_are_kept_and_the_order_of_points_does_not_matter():
    rng = np.random.default_rng(3)
    points = asymmetric_room(rng)
    keypoints_m, descriptors = describe(points, 50)
    shuffled = describe(rng.permutation(points), 50)
    assert len(keypoints_m) == 50
    assert keypoints_m.dtype == np.float32
    assert descriptors.shape == (50, 32)
    np.testing.assert_array_equal(keypoints_m, shuffled[0])
    np.testing.assert_array_equal(descriptors, shuffled[1])


def test_the_thread_count_is_neither_set_nor_needed():
    points = asymmetric_room(np.random.default_rng(4))
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        _, first = describe(points)
        assert cv2.getNumThreads() == 2
        cv2.setNumThreads(1)
        _, alone = describe(points)
    finally:
        cv2.setNumThreads(threads)
    np.testing.assert_array_equal(first, alone)


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 2)),
        np.array([[100.0, 0.0]]),
        np.array([[15.0, 0.0], [0.0, -15.001]]),
        np.array([[np.nan, 0.0], [np.inf, 1.0], [1e300, -1e300]]),
    ],
)
def test_nothing_to_see_gives_no_features(points):
    keypoints_m, descriptors = describe(points)
    assert keypoints_m.shape == (0, 2)
    assert descriptors.shape == (0, 32)


def test_features_are_read_only():
    for values in describe(asymmetric_room(np.random.default_rng(4))):
        assert not values.flags.writeable
