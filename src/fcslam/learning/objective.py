"""The objective of a training step: the losses of one batch, and their weighted sum."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from fcslam.features.codes import CODE_BITS
from fcslam.features.dense import CELL_PX
from fcslam.learning import losses
from fcslam.learning.batches import TrainingBatch
from fcslam.learning.network import Maps, sample_codes
from fcslam.learning.settings import Encoder, LossSettings

APART_PX = 8.0
"""Points this close to a match are no negatives: their codes should be alike."""
TEACHER_SHARPNESS = 2.0
"""A bit the teacher is one standard deviation sure of is 1 with 88 %."""
_SEEN = 0.999


@dataclass(frozen=True, slots=True)
class TeacherBits:
    """A fixed projection of a teacher's float descriptors to 256 values whose signs are its bits."""

    mean: Tensor
    """Shape (D,)."""
    projection: Tensor
    """Shape (D, 256); its outputs have unit variance on the training set."""

    def to(self, device: torch.device) -> "TeacherBits":
        """The same on another device."""
        return TeacherBits(self.mean.to(device), self.projection.to(device))

    def probabilities(self, descriptors: Tensor) -> Tensor:
        """How likely each bit is 1, for descriptors (..., D)."""
        return torch.sigmoid(TEACHER_SHARPNESS * ((descriptors - self.mean) @ self.projection))


def objective(
    maps: Maps,
    batch: TrainingBatch,
    weights: LossSettings,
    progress: float,
    grid_shift: tuple[int, int],
    bits: TeacherBits | None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The sum to minimise and its parts by name.

    Args:
        maps: what the network says of ``batch.images``.
        batch: what is true.
        weights: of the parts.
        progress: share of the training that is behind, in [0, 1].
        grid_shift: rows and columns by which the detector's cells are shifted, 0 to 7: a network that may find a point
            anywhere must not learn one grid of cells.
        bits: the teacher's, if there is one.
    """
    logits = sample_codes(maps.code_logits.float(), batch.points)
    first, second = logits.chunk(2)
    candidates = negatives(batch.points, batch.valid)
    codes = losses.binary_activation(first), losses.binary_activation(second)
    margin = weights.margin * (0.3 + 0.7 * progress)
    points = (maps.point_logits.float(), batch.targets, batch.seen)
    parts = {
        "triplet": losses.triplet_loss(losses.code_distances(*codes), candidates, batch.valid, margin),
        "contrastive": losses.contrastive_loss(
            torch.tanh(first), torch.tanh(second), candidates, batch.valid, weights.temperature
        ),
        "balance": losses.balance_loss(torch.tanh(logits), batch.valid.repeat(2, 1)),
        "detector": losses.detector_loss(*shift_grid(points, grid_shift)),
        "agreement": losses.agreement_loss(*views_aligned(points[0].sigmoid(), batch)),
    }
    factors = {name: getattr(weights, name) for name in parts}
    if bits is not None:
        taught = sample_codes(maps.code_logits.float(), batch.taught_points)
        wanted = bits.probabilities(batch.taught).repeat(2, 1, 1)
        parts["distillation"] = losses.distillation_loss(taught, wanted, batch.taught_valid.repeat(2, 1))
        factors["distillation"] = weights.distillation * 0.25**progress
    total = sum((factors[name] * part for name, part in parts.items()), start=torch.zeros_like(parts["detector"]))
    return total, parts


def views_aligned(maps: Tensor, batch: TrainingBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Maps (2B, H, W) of the first views, of the second ones as the first ones' pixels see them, and where both see."""
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
    return first, moved, seen_first & (seen > _SEEN)


def negatives(points: Tensor, valid: Tensor) -> Tensor:
    """Which points (B, N) may be compared as different ones: both valid, and far apart in both views; (B, N, N)."""
    first, second = points.chunk(2)
    apart = (torch.cdist(first, first) > APART_PX) & (torch.cdist(second, second) > APART_PX)
    return apart & valid[:, :, None] & valid[:, None, :]


def shift_grid(maps: tuple[Tensor, ...], shift: tuple[int, int]) -> tuple[Tensor, ...]:
    """Maps (B, H, W) without their first rows and columns, cut to whole cells."""
    row, column = shift
    height = (maps[0].shape[-2] - row) // CELL_PX * CELL_PX
    width = (maps[0].shape[-1] - column) // CELL_PX * CELL_PX
    return tuple(each[..., row : row + height, column : column + width] for each in maps)


def grid_shift(encoder: Encoder, seed: int, step: int) -> tuple[int, int]:
    """Shift of the cells at a step; the paper's head has one grid, the other none."""
    if encoder == "vgg":
        return 0, 0
    mixed = (seed * 7919 + step * 104729) % CELL_PX**2
    return mixed // CELL_PX, mixed % CELL_PX


def teacher_bits(descriptors: Tensor, seed: int) -> TeacherBits:
    """Random projections of descriptors (N, D), orthogonal in blocks, centred and scaled to unit variance."""
    size = descriptors.shape[1]
    generator = torch.Generator().manual_seed(seed)
    blocks = []
    for _ in range(-(-CODE_BITS // size)):
        square = torch.randn(size, size, generator=generator, dtype=torch.float64)
        blocks.append(torch.linalg.qr(square).Q)
    projection = torch.cat(blocks, dim=1)[:, :CODE_BITS].to(descriptors.dtype)
    mean = descriptors.mean(0)
    return TeacherBits(mean, projection / ((descriptors - mean) @ projection).std(0).clamp(min=1e-6))
