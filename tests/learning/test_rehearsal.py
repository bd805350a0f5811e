"""Views for rehearsal: they are drawn from a robot's own images, the same ones each time, and differ from these."""

import numpy as np
import pytest

from tests.learning.textures import textured

pytest.importorskip("torch", reason="needs fcslam[train]")

from fcslam.learning.code_batches import STEP_IMAGES, STEP_POINTS, VIEWS, draw_rehearsal, draw_views

IMAGES = [textured(1)[:64, :96], textured(2)[:64, :96]]


def test_views_have_the_size_of_the_images_and_show_them_otherwise():
    views = draw_views(IMAGES, 3)
    assert len(views) == VIEWS
    assert all(view.shape == (64, 96) and view.dtype == np.uint8 for view in views)
    assert not any(np.array_equal(view, image) for view in views for image in IMAGES)
    assert len({view.tobytes() for view in views}) == VIEWS


def test_views_and_batches_depend_on_the_seed_and_the_step_alone():
    assert all(map(np.array_equal, draw_views(IMAGES, 3), draw_views(IMAGES, 3)))
    assert not all(map(np.array_equal, draw_views(IMAGES, 3), draw_views(IMAGES, 4)))
    one, again, other = (draw_rehearsal((96, 64), 3, step) for step in (5, 5, 6))
    assert all(first.equal(second) for first, second in zip(one, again, strict=True))
    assert not one[1].equal(other[1])


def test_a_batch_has_points_within_its_views():
    numbers, points = draw_rehearsal((96, 64), 3, 5)
    assert points.shape == (STEP_IMAGES, STEP_POINTS, 2)
    assert numbers.shape == (STEP_IMAGES,)
    assert int(numbers.min()) >= 0
    assert int(numbers.max()) < VIEWS
    x, y = points.unbind(-1)
    assert float(points.min()) >= 4.0
    assert float(x.max()) <= 91.0
    assert float(y.max()) <= 59.0
