"""The objective of a step: it compares keypoint maps of two views where both see the same thing."""

import numpy as np
import pytest
import torch

from fcslam.learning.batches import collate
from fcslam.learning.homography import warp
from fcslam.learning.labels import Labels
from fcslam.learning.objective import views_aligned
from fcslam.learning.pairs import TrainingExample, draw_pair
from tests.learning.textures import textured

SIZE = (120, 96)


def batch(seed):
    keypoints = np.random.default_rng(seed).uniform(5, 150, (60, 2)).astype(np.float32)
    example = TrainingExample(textured(seed), Labels(keypoints, np.linspace(1, 0.1, 60, dtype=np.float32)))
    return collate([draw_pair(example, SIZE, 32, 8, np.random.default_rng([seed, index])) for index in range(4)])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_linear_map_is_read_where_the_homography_says(seed):
    """Bilinear sampling is exact on a map that is linear in x and y."""
    pairs = batch(seed)
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    linear = torch.from_numpy((2.0 * columns - 3.0 * rows).astype(np.float32)).expand(8, -1, -1)
    _, moved, both = views_aligned(linear, pairs)
    for index, homography in enumerate(pairs.homographies.numpy().astype(np.float64)):
        places = warp(homography, np.stack((columns, rows), -1).reshape(-1, 2).astype(np.float64))
        expected = (2.0 * places[:, 0] - 3.0 * places[:, 1]).reshape(rows.shape)
        mask = both[index].numpy()
        assert moved[index].numpy()[mask] == pytest.approx(expected[mask], abs=0.4)  # a thousandth of zeros


def test_only_what_both_views_see_counts():
    pairs = batch(1)
    _, _, both = views_aligned(torch.ones(8, SIZE[1], SIZE[0]), pairs)
    assert both.any()
    assert not (both & ~pairs.seen[:4]).any()
    pairs.seen[4:] = False
    assert not views_aligned(torch.ones(8, SIZE[1], SIZE[0]), pairs)[2].any()
