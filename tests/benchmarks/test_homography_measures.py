"""Measures between two images of a plane: laws of framing and warping, counts by hand and by loops."""

import numpy as np
import pytest
from evaluation.detectors import Framing
from evaluation.homography import (
    HomographyGroundTruth,
    Marks,
    estimate_homography,
    framed_homography,
    mark_error,
    matching_score,
)

from fcslam.learning.homography import inside, inverse, match_errors, warp

H = np.array([[1.1, 0.1, -8.0], [-0.05, 0.95, 6.0], [2e-4, -1e-4, 1.0]])
SIZE = (320, 240)


def points(count, seed=0):
    return np.random.default_rng(seed).uniform((0, 0), SIZE, (count, 2))


def test_what_lies_behind_the_image_is_nowhere_in_both_directions():
    steep = np.array([[1.0, 0, 0], [0, 1.0, 0], [-0.01, 0, 1.0]])  # x = 100 lies at infinity
    seen, behind = np.array([[50.0, 10.0]]), np.array([[150.0, 10.0]])
    assert np.isfinite(warp(steep, seen)).all()
    assert np.isnan(warp(steep, behind)).all()
    assert np.allclose(warp(inverse(steep), warp(steep, seen)), seen)
    assert match_errors(behind, behind, steep).tolist() == [np.inf]
    assert not inside(warp(steep, behind), SIZE).any()


def test_the_framed_homography_is_the_homography_of_framed_points():
    first, second = Framing.of((640, 448), SIZE), Framing.of((500, 700), SIZE)
    framed = framed_homography(H, first, second, HomographyGroundTruth.CORRECTED)
    here = points(20)
    there = warp(H, here)
    assert np.allclose(
        warp(framed, here * first.scale - first.crop_px), there * second.scale - second.crop_px, atol=1e-9
    )


def test_the_legacy_homography_forgets_the_crop_and_the_second_scale():
    """As published: the identity stays right, whatever the crop, and all else goes wrong."""
    first, second = Framing.of((640, 448), SIZE), Framing.of((500, 700), SIZE)
    assert np.allclose(framed_homography(np.eye(3), first, first, HomographyGroundTruth.LEGACY), np.eye(3))
    s = first.scale
    by_hand = np.diag([s, s, 1]) @ H @ np.diag([1 / s, 1 / s, 1])
    assert np.allclose(framed_homography(H, first, second, HomographyGroundTruth.LEGACY), by_hand)
    corrected = framed_homography(H, first, second, HomographyGroundTruth.CORRECTED)
    assert mark_error(by_hand, Marks.corners(corrected, SIZE)) > 20.0
    uncut = Framing.of((640, 480), SIZE)
    pair = [framed_homography(H, uncut, uncut, truth) for truth in HomographyGroundTruth]
    assert np.allclose(pair[0], pair[1])


def test_ransac_finds_the_homography_among_wrong_matches():
    here = points(200)
    there = warp(H, here)
    there[:80] = points(80, seed=1)
    assert mark_error(estimate_homography(here, there), Marks.corners(H, SIZE)) < 0.1
    assert estimate_homography(here[:3], there[:3]) is None
    assert estimate_homography(np.ones((9, 2)), np.ones((9, 2))) is None


def test_the_error_is_the_mean_over_corners():
    shift = np.array([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
    assert mark_error(shift, Marks.corners(np.eye(3), SIZE)) == pytest.approx(5.0)
    assert mark_error(None, Marks.corners(np.eye(3), SIZE)) == np.inf
    scale = np.diag([2.0, 1.0, 1.0])
    assert mark_error(scale, Marks.corners(np.eye(3), SIZE)) == pytest.approx((319 + 319) / 4)
    folded = np.array([[1.0, 0, 0], [0, 1.0, 0], [-0.01, 0, 1.0]])
    assert mark_error(folded, Marks.corners(np.eye(3), SIZE)) == np.inf


def test_the_matching_score_is_that_of_the_loops():
    rng = np.random.default_rng(4)
    first, second = points(60), np.vstack((warp(H, points(60))[:40] + rng.normal(0, 2, (40, 2)), points(30, seed=9)))
    to_second, to_first = rng.integers(0, 70, 60), rng.integers(0, 60, 70)
    to_second[:25], to_first[:25] = np.arange(25), np.arange(25)
    shares = []
    for here, there, nearest, matrix in ((first, second, to_second, H), (second, first, to_first, inverse(H))):
        right = seen = 0
        for k, point in enumerate(here):
            x, y, w = matrix @ [*point, 1.0]
            place = np.array([x / w, y / w])
            if 0 <= place[0] < 320 and 0 <= place[1] < 240:
                seen += 1
                right += np.hypot(*(place - there[nearest[k]])) < 3.0
        shares.append(right / seen)
    score = matching_score((first, second), (to_second, to_first), H, SIZE)
    assert score == pytest.approx(np.mean(shares))
    assert 0.1 < score < 0.9
