"""Repeatability against the plainest loops, and its laws."""

import numpy as np
import pytest

from fcslam.learning.homography import repeatability, warp
from fcslam.metrics.bootstrap import mean_interval

H = np.array([[0.9, 0.2, 20.0], [-0.2, 0.9, 40.0], [1e-4, 2e-4, 1.0]])
SIZE = (320, 240)


def points(count, seed):
    return np.random.default_rng(seed).uniform((0, 0), SIZE, (count, 2))


def by_loops(first, second, most):
    """As the protocol is written: seen by the other image, then the strongest, then the nearest within 3 px."""

    def place(matrix, point):
        x, y, w = matrix @ [*point, 1.0]
        return x / w, y / w

    def is_seen(point):
        return 0 <= point[0] < SIZE[0] and 0 <= point[1] < SIZE[1]

    back = np.linalg.inv(H)
    here = [place(H, point) for point in first if is_seen(place(H, point))][:most]
    there = [tuple(point) for point in second if is_seen(place(back, point))][:most]
    nearest = [min(np.hypot(a - c, b - d) for c, d in there) for a, b in here]
    nearest += [min(np.hypot(a - c, b - d) for a, b in here) for c, d in there]
    found = [distance for distance in nearest if distance <= 3.0]
    return len(found), len(nearest), sum(found)


@pytest.mark.parametrize("most", [40, 1000])
def test_it_is_that_of_the_loops(most):
    first = points(400, 1)
    rng = np.random.default_rng(2)
    second = np.vstack((warp(H, first[:200]) + rng.normal(0, 1.5, (200, 2)), points(150, 3)))
    second = second[rng.permutation(len(second))]
    result = repeatability(first, second, H, SIZE, most)
    found, count, distance = by_loops(first, second, most)
    assert (result.found, result.points) == (found, count)
    assert result.distance_px == pytest.approx(distance)
    assert result.repeatability == pytest.approx(found / count)
    assert result.localization_error_px == pytest.approx(distance / found)


def test_without_points_there_is_no_share():
    none = np.empty((0, 2))
    assert np.isnan(repeatability(none, none, H, SIZE, 300).repeatability)
    lonely = repeatability(np.array([[100.0, 100.0]]), none, H, SIZE, 300)
    assert lonely.repeatability == 0.0
    assert np.isnan(lonely.localization_error_px)


def test_the_interval_is_that_of_the_mean_of_normal_samples():
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    mean, low, high = mean_interval(values, np.random.default_rng(2))
    assert mean == pytest.approx(values.mean())
    half_width = 1.96 * values.std() / 20.0
    assert (mean - low, high - mean) == (pytest.approx(half_width, rel=0.1), pytest.approx(half_width, rel=0.1))
    assert mean_interval(values, np.random.default_rng(2)) == (mean, low, high)


def test_what_is_not_known_is_left_out_of_the_mean():
    assert mean_interval(np.array([1.0, np.nan, 1.0]), np.random.default_rng(1)) == (1.0, 1.0, 1.0)
    assert np.isnan(mean_interval(np.array([np.nan]), np.random.default_rng(1))).all()
