"""The losses of training: the paper's triplet loss of binary codes, eqs. (1)-(3), and others beside it.

Codes are rows: logits (..., N, 256). ``candidates`` (..., N, N) says which codes of the other image may be compared
with a point: those that are valid, and neither its match nor too close to it. All losses are means, so that they do
not depend on how many points there are.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from fcslam.features.dense import CELL_PX
from fcslam.learning.network import cell_log_probabilities

AGREEMENT_WINDOW_PX = 16
"""Side of the windows in which keypoint maps are compared."""
_FAR = 1e4
"""Distance that excludes a code from the hardest negatives; codes are at most 16 apart."""
_FAINT = 1e-4
"""Mean square of a keypoint map below which a window counts as empty."""
WHOLE = 0.999
"""Least valid share of a window, or of the neighbours of a point, that counts as all of them, up to rounding."""


def binary_activation(logits: Tensor) -> Tensor:
    """Eq. (1): 1 where a logit is not negative, else 0; its gradient is that of a smooth step (straight through)."""
    soft = 0.5 + 0.5 * torch.tanh(logits)
    return soft + ((logits >= 0).to(soft.dtype) - soft).detach()


def code_distances(a: Tensor, b: Tensor, rounding: float) -> Tensor:
    """Eq. (3): Euclidean distances of codes (..., N, D) and (..., M, D) of zeros and ones, shape (..., N, M).

    It is the root of the Hamming distance. ``rounding`` is added under the root, because the gradient of the root is
    infinite where two codes are equal; the paper has 0.
    """
    hamming = a.square().sum(-1)[..., :, None] + b.square().sum(-1)[..., None, :] - 2.0 * a @ b.transpose(-1, -2)
    return (hamming.clamp(min=0.0) + rounding).sqrt()


def triplet_loss(distances: Tensor, candidates: Tensor, valid: Tensor, margin: float) -> Tensor:
    """Eq. (2) with the hardest negative of either image, and a margin that the paper lacks (0 there).

    The paper does not say how a negative is drawn.

    Args:
        distances: (..., N, N); the diagonal holds d(c, p).
        candidates: (..., N, N) bool: pairs that may be d(c, n).
        valid: (..., N) bool: points that count.
        margin: by which the negative must be farther away than the match.
    """
    positive = distances.diagonal(dim1=-2, dim2=-1)
    others = distances.masked_fill(~candidates, _FAR)
    terms = [F.relu(margin + positive - others.amin(dim)) for dim in (-1, -2)]
    return masked_mean(torch.stack(terms).mean(0), valid & candidates.any(-1) & candidates.any(-2))


def contrastive_loss(a: Tensor, b: Tensor, candidates: Tensor, valid: Tensor, temperature: float) -> Tensor:
    """Symmetric InfoNCE on smooth codes in [-1, 1] (..., N, D): a point's match against all its candidates."""
    similarity = a @ b.transpose(-1, -2) / (a.shape[-1] * temperature)
    itself = torch.eye(a.shape[-2], dtype=torch.bool, device=a.device)
    similarity = similarity.masked_fill(~(candidates | itself), -_FAR)
    matched = similarity.diagonal(dim1=-2, dim2=-1)
    terms = [dim_sum - matched for dim_sum in (similarity.logsumexp(-1), similarity.logsumexp(-2))]
    return masked_mean(torch.stack(terms).mean(0), valid)


def balance_loss(smooth: Tensor, valid: Tensor) -> Tensor:
    """Mean square of each bit's mean over the batch: 0 where every bit splits the points in halves."""
    weight = valid.to(smooth.dtype)[..., None]
    means = (smooth * weight).flatten(0, -2).sum(0) / weight.sum().clamp(min=1.0)
    return means.square().mean()


def distillation_loss(logits: Tensor, teacher: Tensor, valid: Tensor) -> Tensor:
    """Cross entropy of bits (..., N, 256) against the teacher's probabilities of them."""
    terms = F.binary_cross_entropy_with_logits(logits, teacher, reduction="none").mean(-1)
    return masked_mean(terms, valid)


def detector_loss(point_logits: Tensor, targets: Tensor, valid: Tensor) -> Tensor:
    """Cross entropy over the 65 classes of a cell: a keypoint at one of its 64 pixels, or none.

    ``point_logits`` (B, H, W), and the weight of a keypoint at each pixel. If the weights of a cell sum to less than 1,
    the rest is "none"; if to more, they are scaled to 1. A cell counts if all its pixels are ``valid``.
    """
    log_places, log_none = cell_log_probabilities(point_logits)
    wanted = F.pixel_unshuffle(targets.unsqueeze(1), CELL_PX)
    total = wanted.sum(1, keepdim=True)
    wanted = wanted / total.clamp(min=1.0)
    none = 1.0 - wanted.sum(1)
    terms = -(wanted * log_places).sum(1) - none * log_none
    return masked_mean(terms, F.pixel_unshuffle(valid.unsqueeze(1).float(), CELL_PX).amin(1) > 0.5)


def agreement_loss(first: Tensor, second: Tensor, valid: Tensor) -> Tensor:
    """One minus the cosine of two keypoint maps (B, H, W) of the same pixels, in windows that are valid throughout.

    Only where a window's peaks are and how they compare counts, as in R2D2 (Revaud et al. 2019, eq. 1).
    """

    def mean(values: Tensor) -> Tensor:
        return F.avg_pool2d(values, AGREEMENT_WINDOW_PX, AGREEMENT_WINDOW_PX // 2)

    norms = (mean(first.square()) * mean(second.square()) + _FAINT**2).sqrt()
    return masked_mean(1.0 - mean(first * second) / norms, mean(valid.to(first.dtype)) > WHOLE)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of the values where the mask is set; 0 if it is nowhere."""
    weight = mask.to(values.dtype)
    return (values * weight).sum() / weight.sum().clamp(min=1.0)
