"""The localization loss: keypoints that two views of an image share must lie at the same point, to a part of a pixel.

The cross entropy of the keypoint maps knows whole pixels only. This loss differentiates the parabola by which a
detector refines its peaks, so it moves them by parts of a pixel.
"""

from typing import Final

import torch
from torch import Tensor
from torch.nn import functional as F

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
_NOWHERE_PX: Final = 1e6
"""Where a peak lies that there is not."""


def localization_loss(scores: Tensor, homographies: Tensor) -> Tensor:
    """Mean Huber loss of the distances [px] between keypoints that both views of a pair show; 0 if they share none.

    Keypoints are the same if they are mutual nearest neighbours within ``SAME_POINT_PX`` in the second view.

    Args:
        scores: shape (2B, H, W), probability of a keypoint at each pixel, first views before second views.
        homographies: shape (B, 3, 3), map pixels of the first view to pixels of the second.
    """
    (here, there), (found, found_there) = (each.chunk(2) for each in peaks(scores))
    moved = torch.cat((here, torch.ones_like(here[..., :1])), dim=-1) @ homographies.transpose(-1, -2)
    moved = moved[..., :2] / moved[..., 2:]
    nowhere = torch.full_like(moved, _NOWHERE_PX)
    gaps = torch.cdist(
        torch.where(found[..., None], moved, nowhere).detach(),
        torch.where(found_there[..., None], there, -nowhere).detach(),
        compute_mode="donot_use_mm_for_euclid_dist",
    )
    closest, nearest = gaps.min(-1)
    back = gaps.argmin(-2).gather(-1, nearest)
    shared = (back == torch.arange(moved.shape[1], device=gaps.device)) & (closest < SAME_POINT_PX)
    partner = there.gather(1, nearest[..., None].expand(-1, -1, 2))
    terms = F.smooth_l1_loss(moved, partner, beta=HUBER_PX, reduction="none").sum(-1)
    return torch.where(shared, terms, 0.0).sum() / shared.sum().clamp(min=1)


def peaks(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Keypoints of maps (B, H, W): positions (B, K, 2) [px], differentiable by the maps, and which there are (B, K).

    They are the strongest maxima over ``least_score`` of a robot's default settings that no stronger pixel is near,
    without the ones at the border.
    """
    config = OnnxConfig()
    width = scores.shape[-1]
    levels = scores.detach()
    side = 2 * round(config.nms_px) - 1
    strongest = F.max_pool2d(levels.unsqueeze(1), side, 1, side // 2).squeeze(1)
    inner = torch.zeros_like(levels, dtype=torch.bool)
    inner[:, BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    strength = torch.where((levels == strongest) & (levels > config.least_score) & inner, levels, 0.0).flatten(1)
    strength, pixels = strength.topk(min(MOST_PEAKS, strength.shape[1]))
    found = strength > 0.0
    pixels = torch.where(found, pixels, BORDER_PX * (width + 1))  # any inner pixel, so that it has neighbours
    flat = scores.flatten(1)

    def level(step: int) -> Tensor:
        return flat.gather(1, pixels + step)

    offsets = [_vertex(level(-step), level(0), level(step)) for step in (1, width)]
    whole = torch.stack((pixels % width, pixels // width), dim=-1)
    return whole + torch.stack(offsets, dim=-1), found


def _vertex(before: Tensor, middle: Tensor, behind: Tensor) -> Tensor:
    """Where the parabola through three values has its top, as an offset from the middle one [px]."""
    bend = 2.0 * middle - before - behind
    vertex = 0.5 * (behind - before) / bend.clamp(min=_FLAT)
    return torch.where(bend > _FLAT, vertex, 0.0).clamp(-LONGEST_OFFSET_PX, LONGEST_OFFSET_PX)
