"""Non-maximum suppression against its own definition, pair by pair."""

import numpy as np
import pytest

from fcslam.features.nms import MOST_OVERLAP, box_nms


def overlap(a, b, side):
    """Intersection over union of two squares around points."""
    width, height = side - abs(a[0] - b[0]), side - abs(a[1] - b[1])
    if width <= 0 or height <= 0:
        return 0.0
    return width * height / (2 * side * side - width * height)


def greedy(points, side):
    kept = []
    for i, point in enumerate(points):
        if all(overlap(point, points[j], side) <= MOST_OVERLAP for j in kept):
            kept.append(i)
    return kept


@pytest.mark.parametrize("side", [1.0, 4, 8, 13.7])
@pytest.mark.parametrize("whole", [True, False])
def test_the_grid_finds_what_comparing_all_pairs_finds(side, whole):
    rng = np.random.default_rng(3)
    points = rng.uniform(-20, 60, (500, 2))
    if whole:
        points = np.rint(points)
    kept = box_nms(points, side)
    assert kept.tolist() == greedy(points, side)
    assert np.array_equal(box_nms(points[kept], side), np.arange(len(kept)))


def test_side_zero_keeps_everything_and_nothing_stays_nothing():
    assert box_nms([(1, 1), (1, 1)], 0).tolist() == [0, 1]
    assert box_nms(np.empty((0, 2)), 4).tolist() == []
