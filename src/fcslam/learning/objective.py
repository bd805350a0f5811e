"""The objective of a training step: the losses of one batch, and their weighted sum."""

from dataclasses import dataclass
from typing import Final, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from fcslam.features.codes import CODE_BITS
from fcslam.features.dense import CELL_PX
from fcslam.learning import losses
from fcslam.learning.batches import TrainingBatch
from fcslam.learning.code_batches import RevisitBatch
from fcslam.learning.network import Description, Maps, sample_codes
from fcslam.learning.settings import Encoder, Losses

MIN_NEGATIVE_DISTANCE_PX = float(CELL_PX)
"""Points closer to a match than this are not negatives, because their codes should be similar."""
SHARPNESS = 2.0
"""Log odds of a bit for one standard deviation of a teacher's projection, or for a code's logit of 1: 88 %."""
MIN_NEGATIVE_DISTANCE_M = 0.3
"""The same in a map, for points in images of two places; positions are some centimetres off."""
_STILL = 1e-6
"""Least variance by which the change of the keypoints' context is divided."""


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of the losses, each of which is a mean, and their parameters."""

    triplet: float = 1.0
    """Weight of eq. (2)."""
    margin: float = 1.0
    """Margin of eq. (2) at the end of training, to which it rises; 0 in the paper."""
    rounding: float = 0.01
    """Added under the root of eq. (3); 0 in the paper."""
    contrastive: float = 1.0
    """Weight of the InfoNCE loss of the descriptors before they become binary."""
    temperature: float = 0.05
    """Temperature of the InfoNCE loss, for similarities in [-1, 1]."""
    distillation: float = 30.0
    """Weight of a teacher's descriptors; falls to a quarter during training."""
    balance: float = 0.1
    detector: float = 1.0
    agreement: float = 1.0


LOSSES: Final[dict[Losses, LossWeights]] = {
    "default": LossWeights(),
    "paper": LossWeights(margin=0.0, rounding=1e-6, contrastive=0.0, distillation=0.0, balance=0.0, agreement=0.0),
}
"""By the setting."""
KEYPOINTS_WEIGHT: Final = 100.0
"""Weight of the loss that keeps keypoints in place while the layers of the codes are trained."""
REHEARSAL_WEIGHT: Final = 4.0
"""Weight of the loss that keeps the codes of distorted views of a robot's images, so that less is forgotten."""


class TeacherBits(NamedTuple):
    """A fixed projection of a teacher's float descriptors to 256 values whose signs are its bits."""

    mean: Tensor
    """Shape (D,)."""
    projection: Tensor
    """Shape (D, 256); its outputs have unit variance on the training set."""

    def probabilities(self, descriptors: Tensor) -> Tensor:
        """Probability that each bit is 1, shape (..., 256), for descriptors (..., D)."""
        return torch.sigmoid(SHARPNESS * ((descriptors - self.mean) @ self.projection))


def objective(
    maps: Maps,
    batch: TrainingBatch,
    weights: LossWeights,
    progress: float,
    grid_shift: tuple[int, int],
    bits: TeacherBits | None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The sum to minimise, and the losses in it by name.

    ``progress`` is the share of the training that is done, in [0, 1]. ``grid_shift``: rows and columns by which the
    detector's cells are shifted, 0 to 7, so that the network does not learn one grid of cells. ``bits`` are a
    teacher's.
    """
    logits = sample_codes(maps.code_logits.float(), batch.points)
    first, second = logits.chunk(2)
    candidates = negatives(batch.points, batch.valid)
    codes = losses.binary_activation(first), losses.binary_activation(second)
    distances = losses.code_distances(*codes, weights.rounding)
    margin = weights.margin * (0.3 + 0.7 * progress)
    points = (maps.point_logits.float(), batch.targets, batch.seen)
    parts = {
        "triplet": losses.triplet_loss(distances, candidates, batch.valid, margin),
        "contrastive": losses.contrastive_loss(
            torch.tanh(first), torch.tanh(second), candidates, batch.valid, weights.temperature
        ),
        "balance": losses.balance_loss(torch.tanh(logits), batch.valid.repeat(2, 1)),
        "detector": losses.detector_loss(*shift_grid(points, grid_shift)),
        "agreement": losses.agreement_loss(*views_aligned(points[0].sigmoid(), batch)),
    }
    factors = {name: getattr(weights, name) for name in parts}
    if bits is not None:
        logits = sample_codes(maps.code_logits.float(), batch.teacher_points)
        wanted = bits.probabilities(batch.teacher_descriptors).repeat(2, 1, 1)
        parts["distillation"] = losses.distillation_loss(logits, wanted, batch.teacher_valid.repeat(2, 1))
        factors["distillation"] = weights.distillation * 0.25**progress
    total = sum((factors[name] * part for name, part in parts.items()), start=torch.zeros_like(parts["detector"]))
    return total, parts


def revisit_objective(
    described: Description, before: Description, batch: RevisitBatch
) -> tuple[Tensor, dict[str, Tensor]]:
    """The sum to minimise for points that were seen again, and the losses in it by name.

    The codes of a point in both views must agree and differ from those of all other points of the batch, also in images
    of other places. The balance of the bits, and the negatives, keep codes from becoming all the same. ``before`` is
    described by the network that training started from.
    """
    weights = LOSSES["default"]
    (code_logits, context), (_, context_before) = described, before
    soft = torch.tanh(sample_codes(code_logits.float(), batch.points))
    first, second = (side[batch.valid] for side in soft.chunk(2))
    every = torch.ones(len(first), dtype=torch.bool, device=first.device)
    moved = (context.float() - context_before.float()).square().mean()
    parts = {
        "contrastive": losses.contrastive_loss(first, second, revisit_negatives(batch), every, weights.temperature),
        "balance": losses.balance_loss(soft, batch.valid.repeat(2, 1)),
        "keypoints": moved / context_before.float().var().clamp(min=_STILL),
    }
    factors = {"contrastive": weights.contrastive, "balance": weights.balance, "keypoints": KEYPOINTS_WEIGHT}
    total = sum((factors[name] * part for name, part in parts.items()), start=torch.zeros_like(moved))
    return total, parts


def rehearsal_loss(described: Description, before: Description, points: Tensor) -> Tensor:
    """Cross entropy of the bits at points (R, N, 2) of views against those of the initial network."""
    logits, wanted = (SHARPNESS * sample_codes(code_logits.float(), points) for code_logits, _ in (described, before))
    everywhere = torch.ones(points.shape[:2], dtype=torch.bool, device=points.device)
    return losses.distillation_loss(logits, torch.sigmoid(wanted), everywhere)


def revisit_negatives(batch: RevisitBatch) -> Tensor:
    """Which valid points of a batch differ for certain, shape (V, V), bool.

    Points of one pair differ if they are far apart in both views, those of two pairs if they are so in the map.
    """
    valid = batch.valid
    first, second = (side[valid] for side in batch.points.chunk(2))
    apart = (torch.cdist(first, first) > MIN_NEGATIVE_DISTANCE_PX) & (
        torch.cdist(second, second) > MIN_NEGATIVE_DISTANCE_PX
    )
    pair = torch.arange(len(valid), device=valid.device).repeat_interleave(valid.sum(1))
    # Distances by differences: the usual expansion loses centimetres in a large building.
    gaps = torch.cdist(batch.positions[valid], batch.positions[valid], compute_mode="donot_use_mm_for_euclid_dist")
    return torch.where(pair[:, None] == pair, apart, gaps > MIN_NEGATIVE_DISTANCE_M)


def views_aligned(maps: Tensor, batch: TrainingBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Split maps (2B, H, W) into first views, second views warped onto them, and where both show the image (bool)."""
    first, second = maps.chunk(2)
    seen_first, seen_second = batch.seen.chunk(2)
    height, width = maps.shape[-2:]
    size = maps.new_tensor([width, height])
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack((x, y, torch.ones_like(x)), dim=-1).to(maps).reshape(-1, 3)
    there = pixels @ batch.homographies.transpose(-1, -2)
    grid = (2.0 * there[..., :2] / there[..., 2:] + 1.0) / size - 1.0
    grid = grid.reshape(-1, height, width, 2)
    both = torch.stack((second, seen_second.to(maps.dtype)), dim=1)
    moved, seen = F.grid_sample(both, grid, mode="bilinear", padding_mode="zeros", align_corners=False).unbind(1)
    return first, moved, seen_first & (seen > losses.WHOLE)


def negatives(points: Tensor, valid: Tensor) -> Tensor:
    """Which pairs of points are negatives, shape (B, N, N), bool: both valid, and far apart in both views.

    ``points`` (2B, N, 2) [px]: first views before second views; ``valid``: shape (B, N).
    """
    first, second = points.chunk(2)
    apart = (torch.cdist(first, first) > MIN_NEGATIVE_DISTANCE_PX) & (
        torch.cdist(second, second) > MIN_NEGATIVE_DISTANCE_PX
    )
    return apart & valid[:, :, None] & valid[:, None, :]


def shift_grid(maps: tuple[Tensor, ...], shift: tuple[int, int]) -> tuple[Tensor, ...]:
    """Maps (B, H, W) without the first rows and columns, cropped to whole cells."""
    row, column = shift
    height = (maps[0].shape[-2] - row) // CELL_PX * CELL_PX
    width = (maps[0].shape[-1] - column) // CELL_PX * CELL_PX
    return tuple(each[..., row : row + height, column : column + width] for each in maps)


def grid_shift(encoder: Encoder, seed: int, step: int) -> tuple[int, int]:
    """Rows and columns by which cells are shifted at a step; `vgg` as in the paper has one fixed grid of cells."""
    if encoder == "vgg":
        return 0, 0
    mixed = (seed * 7919 + step * 104729) % CELL_PX**2
    return mixed // CELL_PX, mixed % CELL_PX


def teacher_bits(descriptors: Tensor, seed: int) -> TeacherBits:
    """Random projections fitted to descriptors (N, D): orthogonal in blocks, centred, outputs of unit variance."""
    size = descriptors.shape[1]
    generator = torch.Generator().manual_seed(seed)
    blocks = []
    for _ in range(-(-CODE_BITS // size)):
        square = torch.randn(size, size, generator=generator, dtype=torch.float64)
        blocks.append(torch.linalg.qr(square).Q)
    projection = torch.cat(blocks, dim=1)[:, :CODE_BITS].to(descriptors.dtype)
    mean = descriptors.mean(0)
    return TeacherBits(mean, projection / ((descriptors - mean) @ projection).std(0).clamp(min=1e-6))
