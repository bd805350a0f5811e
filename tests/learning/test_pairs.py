"""Pairs: both views see the same thing where they say so, and labels land where the picture shows them."""

import cv2
import numpy as np
import pytest

from fcslam.learning.homography import inverse, warp
from fcslam.learning.labels import Labels, Teacher
from fcslam.learning.pairs import TrainingExample, draw_pair, splat_points
from fcslam.learning.warps import random_change, random_view, visible_mask, warp_image, well_inside
from tests.learning.textures import textured

SIZE = (96, 80)


def example(seed=0, taught=True):
    image = textured(seed)
    rng = np.random.default_rng(seed)
    keypoints = rng.uniform(5, 150, (120, 2)).astype(np.float32)
    labels = Labels(keypoints, np.linspace(1, 0.1, 120, dtype=np.float32))
    return TrainingExample(
        image, labels, Teacher(keypoints, rng.normal(size=(120, 16)).astype(np.float16)) if taught else None
    )


def blob(x, y, width, height):
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    return (255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 30)).astype(np.uint8)


@pytest.mark.parametrize("seed", range(4))
def test_points_go_where_the_picture_goes(seed):
    rng = np.random.default_rng(seed)
    image = blob(101, 77, 200, 160)
    homography = random_change(SIZE, rng) @ random_view(image, SIZE, rng)
    ((x, y),) = warp(homography, np.array([[101.0, 77.0]]))
    if 12 < x < SIZE[0] - 12 and 12 < y < SIZE[1] - 12:
        warped = warp_image(image, homography, SIZE)
        row, column = np.unravel_index(np.argmax(cv2.GaussianBlur(warped, (5, 5), 0)), warped.shape)
        assert np.hypot(column - x, row - y) < 2.5


def test_what_is_seen_is_the_image():
    rng = np.random.default_rng(3)
    homography = random_change(SIZE, rng) @ random_view(textured(0), SIZE, rng)
    mask = visible_mask((160, 200), homography, SIZE)
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    places = warp(inverse(homography), np.stack((columns, rows), -1).reshape(-1, 2).astype(float))
    expected = well_inside(places, (200, 160), 2.0).reshape(mask.shape)
    assert (mask != expected).mean() < 0.03


def test_weights_are_shared_among_four_pixels_about_their_point():
    points, weight = np.array([[10.25, 5.5], [30.0, 7.0]]), np.array([0.8, 0.5], np.float32)
    spread = splat_points(points, weight, SIZE)
    assert spread.sum() == pytest.approx(1.3, rel=1e-6)
    assert spread[7, 30] == pytest.approx(0.5)
    assert spread[5, 10] == pytest.approx(0.8 * 0.75 * 0.5)
    assert np.count_nonzero(spread) == 5


def test_points_of_a_pair_belong_together():
    pair = draw_pair(example(), SIZE, 64, 32, np.random.default_rng(5))
    first, second = pair.views
    assert pair.valid.sum() > 20
    there = warp(pair.homography, first.points[pair.valid].astype(float))
    assert there == pytest.approx(second.points[pair.valid], abs=1e-2)
    for view in pair.views:
        assert well_inside(view.points[pair.valid].astype(float), SIZE, 4.0).all()


def test_the_teachers_descriptors_stay_with_their_points():
    source = example()
    pair = draw_pair(source, SIZE, 64, 32, np.random.default_rng(5))
    assert pair.teacher_valid.any()
    for told in pair.teacher_descriptors[pair.teacher_valid]:
        assert (source.teacher.descriptors.astype(np.float32) == told).all(axis=1).any()
