"""Batches of points that were seen again and of views for rehearsal, and what the objective asks of their codes."""

import numpy as np
import pytest
import torch

from fcslam.learning.code_batches import (
    STEP_IMAGES,
    STEP_POINTS,
    VIEWS,
    RevisitExamples,
    RevisitPair,
    draw_rehearsal,
    draw_revisits,
    draw_views,
)
from fcslam.learning.objective import (
    KEYPOINTS_WEIGHT,
    MIN_NEGATIVE_DISTANCE_M,
    MIN_NEGATIVE_DISTANCE_PX,
    rehearsal_loss,
    revisit_negatives,
    revisit_objective,
)
from tests.learning.textures import textured

SIZE = 96
RNG = np.random.default_rng(2)
POINTS = RNG.uniform(8, SIZE - 8, (40, 2)).astype(np.float32)
POSITIONS = RNG.uniform(0, 5, (40, 3))
IMAGES = [textured(seed)[:SIZE, :SIZE] for seed in range(3)]
WIDE = [image[:64] for image in IMAGES]
PAIR = RevisitPair((0, 1), (POINTS, POINTS[::-1].copy()), POSITIONS)


def test_a_batch_holds_pairs_of_views():
    batch = draw_revisits(RevisitExamples(IMAGES, [PAIR]), 1, 5)
    assert batch.images.tolist() == [0, 0, 1, 1]
    assert batch.points.shape == (STEP_IMAGES, STEP_POINTS, 2)
    assert batch.valid.sum(1).tolist() == [40, 40]
    firsts, seconds = batch.points.chunk(2)
    for k in range(STEP_IMAGES // 2):  # the points of a pair stay together, and with their positions
        rows = (firsts[k, :40], seconds[k, :40], batch.positions[k, :40])
        both = {(*a, *b, *c) for a, b, c in zip(*(each.tolist() for each in rows), strict=True)}
        wanted = (*PAIR.points, PAIR.positions.astype(np.float32))
        assert both == {(*a, *b, *c) for a, b, c in zip(*(each.tolist() for each in wanted), strict=True)}
    again = draw_revisits(RevisitExamples(IMAGES, [PAIR]), 1, 5)
    assert torch.equal(batch.points, again.points)


def test_points_of_two_pairs_differ_if_they_are_far_apart_in_the_map_and_of_one_pair_if_in_both_images():
    batch = draw_revisits(RevisitExamples(IMAGES, [PAIR]), 1, 5)
    found = revisit_negatives(batch).numpy()
    first, second = (side[batch.valid].numpy() for side in batch.points.chunk(2))
    places, of = batch.positions[batch.valid].numpy(), np.repeat([0, 1], 40)

    def far(values, least):
        return np.linalg.norm(values[:, None] - values[None], axis=2) > least

    same = of[:, None] == of[None]
    apart = far(first, MIN_NEGATIVE_DISTANCE_PX) & far(second, MIN_NEGATIVE_DISTANCE_PX)
    assert np.array_equal(found[same], apart[same])
    assert np.array_equal(found[~same], far(places, MIN_NEGATIVE_DISTANCE_M)[~same])
    assert not found[~same].all()  # both pairs show the same points
    unknown = batch._replace(positions=torch.full_like(batch.positions, torch.nan))
    assert not revisit_negatives(unknown).numpy()[~same].any()


def objective(code_logits, batch, context=0.0):
    still = torch.randn(len(code_logits), 16, 4, 4, generator=torch.Generator().manual_seed(1))
    before = code_logits, still
    return revisit_objective((code_logits, still + context), before, batch)


def test_codes_that_agree_cost_least_and_equal_codes_of_all_points_do_not_pay():
    batch = draw_revisits(RevisitExamples(IMAGES, [PAIR]), 1, 5)
    columns = torch.randn(4, 256, SIZE // 8, SIZE // 8, generator=torch.Generator().manual_seed(1))
    # In a pair of an image with itself, the two codes of a point agree.
    agreeing = batch._replace(points=batch.points[:2].repeat(2, 1, 1))
    _, good = objective(4.0 * torch.cat((columns[:2], columns[:2])), agreeing)
    _, other = objective(4.0 * columns, agreeing)
    _, collapsed = objective(torch.full_like(columns, 4.0), agreeing)
    assert good["contrastive"] < 0.5 * other["contrastive"]
    assert collapsed["contrastive"] > 2.0 * good["contrastive"]
    assert collapsed["balance"] > 0.9 > good["balance"]


def test_keypoints_that_move_cost():
    batch = draw_revisits(RevisitExamples(IMAGES, [PAIR]), 1, 5)
    columns = torch.randn(4, 256, 12, 12, generator=torch.Generator().manual_seed(1))
    total, same = objective(columns, batch)
    moved_total, moved = objective(columns, batch, context=0.5)
    assert same["keypoints"] == 0.0
    assert moved["keypoints"] == pytest.approx(0.25, rel=0.1)
    assert float(moved_total - total) == pytest.approx(KEYPOINTS_WEIGHT * float(moved["keypoints"]), rel=1e-3)


def test_codes_that_leave_the_earlier_ones_cost_in_rehearsal():
    points = torch.rand(2, 5, 2, generator=torch.Generator().manual_seed(1)) * (SIZE - 8.0) + 4.0
    columns = torch.randn(2, 256, 12, 12, generator=torch.Generator().manual_seed(2))
    former = columns, columns[:, :16]
    same = rehearsal_loss(former, former, points)
    opposite = rehearsal_loss((-columns, columns[:, :16]), former, points)
    assert opposite > 2.0 * same


def test_views_have_the_size_of_the_images_and_show_them_otherwise():
    views = draw_views(WIDE, 3)
    assert len(views) == VIEWS
    assert all(view.shape == (64, 96) and view.dtype == np.uint8 for view in views)
    assert not any(np.array_equal(view, image) for view in views for image in WIDE)
    assert len({view.tobytes() for view in views}) == VIEWS


def test_views_and_batches_depend_on_the_seed_and_the_step_alone():
    assert all(map(np.array_equal, draw_views(WIDE, 3), draw_views(WIDE, 3)))
    assert not all(map(np.array_equal, draw_views(WIDE, 3), draw_views(WIDE, 4)))
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
