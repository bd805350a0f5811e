"""Pairs: both views see the same thing where they say so, and labels land where the picture shows them."""

import cv2
import numpy as np
import pytest
from learning.textures import textured

from fcslam.learning.labels import Labels, Teacher
from fcslam.learning.pairs import Example, draw_pair, splat
from fcslam.learning.warps import Crop, inside, inverse, project, random_change, random_view, relight, seen, warp

CROP = Crop(96, 80)


def example(seed=0, taught=True):
    image = textured(seed)
    rng = np.random.default_rng(seed)
    keypoints = rng.uniform(5, 150, (120, 2)).astype(np.float32)
    labels = Labels(keypoints, np.linspace(1, 0.1, 120, dtype=np.float32))
    return Example(image, labels, Teacher(keypoints, rng.normal(size=(120, 16)).astype(np.float16)) if taught else None)


def blob(x, y, width, height):
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    return (255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 30)).astype(np.uint8)


@pytest.mark.parametrize("seed", range(4))
def test_points_go_where_the_picture_goes(seed):
    rng = np.random.default_rng(seed)
    image = blob(101, 77, 200, 160)
    homography = random_change(CROP, rng) @ random_view(image, CROP, rng)
    ((x, y),) = project(np.array([[101.0, 77.0]]), homography)
    if 12 < x < CROP.width - 12 and 12 < y < CROP.height - 12:
        warped = warp(image, homography, CROP)
        row, column = np.unravel_index(np.argmax(cv2.GaussianBlur(warped, (5, 5), 0)), warped.shape)
        assert np.hypot(column - x, row - y) < 2.5


def test_a_homography_and_back_is_nothing():
    rng = np.random.default_rng(1)
    homography, points = random_change(CROP, rng), rng.uniform(0, 80, (20, 2))
    assert project(project(points, homography), inverse(homography)) == pytest.approx(points, abs=1e-6)


def test_points_behind_the_view_are_nowhere():
    behind = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 1]])
    assert np.isnan(project(np.array([[5.0, 0.0]]), behind)).all()
    assert not inside(np.array([[np.nan, 1.0]]), 10, 10, 0.0)[0]


def test_what_is_seen_is_the_image():
    rng = np.random.default_rng(3)
    homography = random_change(CROP, rng) @ random_view(textured(0), CROP, rng)
    mask = seen((160, 200), homography, CROP)
    columns, rows = np.meshgrid(np.arange(CROP.width), np.arange(CROP.height))
    places = project(np.stack((columns, rows), -1).reshape(-1, 2).astype(float), inverse(homography))
    expected = inside(places, 200, 160, 2.0).reshape(mask.shape)
    assert (mask != expected).mean() < 0.03


@pytest.mark.parametrize("seed", range(20))
def test_light_keeps_images_images(seed):
    lit = relight(textured(seed), np.random.default_rng(seed))
    assert lit.dtype == np.float32
    assert lit.shape == (160, 200)
    assert (lit.min() >= 0.0) & (lit.max() <= 1.0)


def test_weights_are_shared_among_four_pixels_about_their_point():
    points, weight = np.array([[10.25, 5.5], [30.0, 7.0]]), np.array([0.8, 0.5], np.float32)
    spread = splat(points, weight, CROP)
    assert spread.sum() == pytest.approx(1.3, rel=1e-6)
    assert spread[7, 30] == pytest.approx(0.5)
    assert spread[5, 10] == pytest.approx(0.8 * 0.75 * 0.5)
    assert np.count_nonzero(spread) == 5


def test_points_of_a_pair_belong_together():
    pair = draw_pair(example(), CROP, 64, 32, np.random.default_rng(5))
    first, second = pair.views
    assert pair.valid.sum() > 20
    there = project(first.points[pair.valid].astype(float), pair.homography)
    assert there == pytest.approx(second.points[pair.valid], abs=1e-2)
    for view in pair.views:
        assert inside(view.points[pair.valid].astype(float), CROP.width, CROP.height, 4.0).all()


def test_the_teachers_descriptors_stay_with_their_points():
    source = example()
    pair = draw_pair(source, CROP, 64, 32, np.random.default_rng(5))
    assert pair.taught_valid.any()
    for told in pair.taught[pair.taught_valid]:
        assert (source.teacher.descriptors.astype(np.float32) == told).all(axis=1).any()


def test_without_a_teacher_nothing_is_taught():
    pair = draw_pair(example(taught=False), CROP, 64, 32, np.random.default_rng(5))
    assert pair.taught.shape == (32, 0)


def test_the_same_generator_draws_the_same_pair():
    a, b = (draw_pair(example(), CROP, 64, 32, np.random.default_rng(8)) for _ in range(2))
    assert np.array_equal(a.views[0].image, b.views[0].image)
    assert np.array_equal(a.views[1].targets, b.views[1].targets)
