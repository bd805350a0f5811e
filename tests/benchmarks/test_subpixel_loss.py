"""The localization loss: zero for the same points, the Huber loss of a known shift, and a gradient that undoes it."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs fcslam[train]")

from evaluation.subpixel_loss import HUBER_PX, MOST_PEAKS, localization_loss, peaks  # noqa: E402

from fcslam.features.dense import find_peaks  # noqa: E402
from fcslam.features.detector import OnnxConfig  # noqa: E402

HEIGHT, WIDTH = 96, 120
WIDTH_OF_A_POINT_PX = 1.5
IDENTITY = np.eye(3, dtype=np.float32)


def points_apart(seed, count=12):
    """Points at least 14 px apart, so that suppression keeps all of them."""
    cells = np.stack(np.meshgrid(np.arange(5), np.arange(4)), -1).reshape(-1, 2)
    rng = np.random.default_rng(seed)
    return 12.0 + 22.0 * rng.permutation(cells)[:count] + rng.uniform(-2.0, 2.0, (count, 2))


def drawn(points, shift=(0.0, 0.0)):
    """A map of keypoints (H, W) with a parabola's top, cut at 0, at each point plus the shift."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    bumps = [
        1.0 - ((x - u) ** 2 + (y - v) ** 2) / (2.0 * WIDTH_OF_A_POINT_PX) ** 2 for u, v in points + np.array(shift)
    ]
    return torch.from_numpy(0.9 * np.clip(np.max(bumps, axis=0), 0.0, 1.0).astype(np.float32))


def loss_of(first, second, homography=IDENTITY):
    return localization_loss(torch.stack((first, second)), torch.from_numpy(homography)[None])


@pytest.mark.parametrize("seed", range(3))
def test_peaks_are_those_that_a_robot_finds(seed):
    scores = drawn(points_apart(seed))
    config = OnnxConfig()
    found, _ = find_peaks(scores.numpy(), config.least_score, config.nms_px, MOST_PEAKS)
    positions, there = peaks(scores[None])
    assert positions[there].numpy() == pytest.approx(found, abs=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_same_points_cost_nothing(seed):
    points = points_apart(seed)
    assert float(loss_of(drawn(points), drawn(points))) == pytest.approx(0.0, abs=1e-6)


def test_a_shift_of_the_second_view_costs_nothing_with_its_homography():
    points = points_apart(1)
    shift = np.array([[1, 0, 1.3], [0, 1, -0.6], [0, 0, 1]], np.float32)
    assert float(loss_of(drawn(points), drawn(points, (1.3, -0.6)), shift)) == pytest.approx(0.0, abs=1e-3)


def test_a_known_shift_costs_its_huber_loss():
    points = points_apart(2)
    near, far = 0.4, 1.6
    wanted = 0.5 * near**2 / HUBER_PX + far - 0.5 * HUBER_PX
    assert float(loss_of(drawn(points), drawn(points, (near, far)))) == pytest.approx(wanted, abs=0.02)
