"""What a network can do, on pairs from images it never trained on; and whether its codes collapse."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from fcslam.features.codes import CODE_BITS, hamming_matrix, mutual_matches
from fcslam.learning.network import KeypointNetwork, sample_codes
from fcslam.learning.pairs import Pair
from fcslam.learning.warps import inside, inverse, project
from fcslam.records import FloatArray

SUPPRESSION_PX: Final = 4
CORRECT_PX: Final = 3.0
MOST_POINTS: Final = 300
SHIFTS: Final = ((1, 0), (0, 2), (3, 3), (4, 1), (5, 0), (2, 6), (7, 7))
LEAST_SPREAD_BITS: Final = 0.3 * CODE_BITS
"""Codes of different points closer than this on average (a half of all bits would be chance) are collapsing."""
LARGEST_BIAS: Final = 0.25
"""A mean bit farther from a half than this carries little."""


@torch.inference_mode()
def detect(
    network: KeypointNetwork, image: Tensor, most: int = MOST_POINTS
) -> tuple[FloatArray, NDArray[np.uint8], Tensor]:
    """Keypoints (N, 2) [px], their packed codes (N, 32) and logits (N, 256) of one image (1, 1, H, W)."""
    maps = network(image)
    points = best_points(network.scores(maps)[0], most)
    logits = sample_codes(maps.code_logits, points[None])[0]
    codes = np.packbits((logits >= 0).cpu().numpy(), axis=1)
    return points.cpu().numpy().astype(np.float64), codes, logits


def best_points(scores: Tensor, most: int) -> Tensor:
    """The strongest local maxima of (H, W), a few pixels from the rim, shape (N, 2)."""
    around = F.max_pool2d(scores[None, None], 2 * SUPPRESSION_PX + 1, 1, SUPPRESSION_PX)[0, 0]
    peaks = torch.where(scores >= around, scores, 0.0)
    rim = torch.zeros_like(peaks)
    rim[SUPPRESSION_PX:-SUPPRESSION_PX, SUPPRESSION_PX:-SUPPRESSION_PX] = 1.0
    values, places = (peaks * rim).flatten().topk(most)
    places = places[values > 0.0]
    width = scores.shape[1]
    return torch.stack((places % width, places // width), dim=1).float()


def validate(network: KeypointNetwork, pairs: Sequence[Pair], device: torch.device) -> dict[str, float]:
    """Means over pairs: repeatability, MMA at 3 px by bits, shift, bits' bias and spread."""
    training = network.training
    network.eval()
    rows = [_validate_pair(network, pair, device) for pair in pairs]
    network.train(training)
    return {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}


def alarms(figures: dict[str, float]) -> list[str]:
    """What is wrong with the codes, in words; empty while they are sound."""
    found = []
    if figures["code_spread_bits"] < LEAST_SPREAD_BITS:
        found.append(f"codes collapse: those of different points differ in {figures['code_spread_bits']:.0f} bits")
    if figures["bit_bias"] > LARGEST_BIAS:
        found.append(f"bits are stuck: their means are {figures['bit_bias']:.2f} from a half")
    return found


def _validate_pair(network: KeypointNetwork, pair: Pair, device: torch.device) -> dict[str, float]:
    images = [torch.from_numpy(view.image)[None, None].to(device) for view in pair.views]
    (points_a, codes_a, logits_a), (points_b, codes_b, _) = (detect(network, image) for image in images)
    height, width = pair.views[0].image.shape
    there = project(points_a, pair.homography)
    back = project(points_b, inverse(pair.homography))
    common_a, common_b = inside(there, width, height, 0.0), inside(back, width, height, 0.0)
    distances = np.linalg.norm(there[common_a][:, None] - points_b[common_b][None], axis=2)
    found = 0
    if distances.size:
        found = int((distances.min(1) <= CORRECT_PX).sum() + (distances.min(0) <= CORRECT_PX).sum())
    matches = mutual_matches(codes_a[common_a], codes_b[common_b]).pairs
    errors = distances[matches[:, 0], matches[:, 1]] if len(matches) else np.empty(0)
    bits = (logits_a >= 0).float().mean(0)
    spread = hamming_matrix(codes_a, codes_a).astype(np.float64)
    return {
        "repeatability": found / max(common_a.sum() + common_b.sum(), 1),
        "mma_3px": float((errors <= CORRECT_PX).mean()) if len(matches) else 0.0,
        "matching_score": float((errors <= CORRECT_PX).sum()) / max(min(common_a.sum(), common_b.sum()), 1),
        "shift_repeatability": shift_repeatability(network, images[0]),
        "bit_bias": float((bits - 0.5).abs().mean()),
        "code_spread_bits": float(spread.sum() / max(len(codes_a) * (len(codes_a) - 1), 1)),
    }


def shift_repeatability(network: KeypointNetwork, image: Tensor, most: int = 200) -> float:
    """Share of the best points found within 1 px again after the image was rolled by 1 to 7 px."""
    points = detect(network, image, most)[0]
    height, width = image.shape[-2:]
    shares = []
    for row, column in SHIFTS:
        rolled = detect(network, image.roll((row, column), (-2, -1)), most)[0]
        expected = points + np.array([column, row])
        kept = inside(expected, width, height, 8.0 + SUPPRESSION_PX)
        if kept.any() and len(rolled):
            nearest = np.linalg.norm(expected[kept][:, None] - rolled[None], axis=2).min(1)
            shares.append(float((nearest <= 1.0).mean()))
    return float(np.mean(shares)) if shares else 0.0
