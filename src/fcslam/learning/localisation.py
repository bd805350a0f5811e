"""The localisation loss: keypoints that two views of an image share must lie at the same point, to a part of a pixel.

The cross entropy of the keypoint maps knows whole pixels only. This loss differentiates the parabola by which a
detector refines its peaks, so it moves them by parts of a pixel.
"""

from typing import Final

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from fcslam.features.dense import find_peaks
from fcslam.features.detector import OnnxConfig

SAME_POINT_PX: Final = 2.5
"""Peaks of both views that are farther apart are not taken for one keypoint."""
BORDER_PX: Final = 4
"""Peaks closer to the border of a view are not used."""
MOST_PEAKS: Final = 300
LONGEST_OFFSET_PX: Final = 0.75
"""Farthest that a parabola moves a peak from the middle of its pixel."""
HUBER_PX: Final = 0.5
"""Distance at which the loss turns from square to linear."""
_FLAT: Final = 1e-6
"""A parabola that bends less has no peak."""


def localisation_loss(scores: Tensor, homographies: Tensor) -> Tensor:
    """Mean Huber loss of the distances [px] between keypoints that both views of a pair show; 0 if there are none.

    Keypoints are the same if they are mutual nearest neighbours within ``SAME_POINT_PX`` in the second view.

    Args:
        scores: shape (2B, H, W), probability of a keypoint at each pixel, first views before second views.
        homographies: shape (B, 3, 3), map pixels of the first view to pixels of the second.
    """
    terms = [_distance_loss(*pair) for pair in zip(*scores.chunk(2), homographies, strict=True)]
    every = torch.cat(terms)
    return every.mean() if len(every) else scores.new_zeros(())


def peaks(scores: Tensor) -> Tensor:
    """Positions (N, 2) [px] of the keypoints of a map (H, W), strongest first, differentiable by the map.

    They are those of ``find_peaks`` with a robot's default settings, without the ones at the border.
    """
    config = OnnxConfig()
    found, _ = find_peaks(scores.detach().cpu().numpy(), config.least_score, config.nms_px, MOST_PEAKS)
    pixels = np.rint(found).astype(np.int64)
    last = np.array(scores.shape[::-1]) - 1 - BORDER_PX
    inside = ((pixels >= BORDER_PX) & (pixels <= last)).all(axis=1)
    x, y = torch.from_numpy(pixels[inside]).to(scores.device).unbind(1)
    middle = scores[y, x]
    dx = _vertex(scores[y, x - 1], middle, scores[y, x + 1])
    dy = _vertex(scores[y - 1, x], middle, scores[y + 1, x])
    return torch.stack((x + dx, y + dy), dim=1)


def _distance_loss(first: Tensor, second: Tensor, homography: Tensor) -> Tensor:
    """The loss of each keypoint that two maps (H, W) share, shape (N,)."""
    here, there = peaks(first), peaks(second)
    moved = torch.cat((here, torch.ones_like(here[:, :1])), dim=1) @ homography.T
    moved = moved[:, :2] / moved[:, 2:]
    gaps = torch.cdist(moved.detach(), there.detach())
    if not gaps.numel():
        return gaps.new_zeros(0)
    nearest, back = gaps.argmin(1), gaps.argmin(0)
    rows = torch.arange(len(moved), device=gaps.device)
    shared = (back[nearest] == rows) & (gaps[rows, nearest] < SAME_POINT_PX)
    return F.smooth_l1_loss(moved[shared], there[nearest[shared]], beta=HUBER_PX, reduction="none").sum(1)


def _vertex(before: Tensor, middle: Tensor, behind: Tensor) -> Tensor:
    """Where the parabola through three values has its top, as an offset from the middle one [px]."""
    bend = 2.0 * middle - before - behind
    vertex = 0.5 * (behind - before) / bend.clamp(min=_FLAT)
    return torch.where(bend > _FLAT, vertex, 0.0).clamp(-LONGEST_OFFSET_PX, LONGEST_OFFSET_PX)
