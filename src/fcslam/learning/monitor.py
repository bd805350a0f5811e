"""What a network can do, on pairs from images it never trained on; and whether its codes collapse."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from fcslam.features.codes import CODE_BITS, hamming_matrix, mutual_matches
from fcslam.features.dense import find_peaks, sample_codes
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import Pair
from fcslam.learning.warps import well_inside
from fcslam.metrics.homography import inverse, match_errors, matching_accuracy
from fcslam.metrics.repeatability import CORRECT_PX, in_common_view, repeatability
from fcslam.records import Codes, FloatArray

NMS_PX: Final = 4.0
LEAST_SCORE: Final = 0.001
ROLLED_RIM_PX: Final = 12.0
"""What was rolled in at one side is seen by points so close to it."""
MOST_POINTS: Final = 300
SHIFTS: Final = ((1, 0), (0, 2), (3, 3), (4, 1), (5, 0), (2, 6), (7, 7))
LEAST_SPREAD_BITS: Final = 0.3 * CODE_BITS
"""Codes of different points closer than this on average (a half of all bits would be chance) are collapsing."""
LARGEST_BIAS: Final = 0.25
"""A mean bit farther from a half than this carries little."""


@torch.inference_mode()
def detect(network: KeypointNetwork, image: Tensor, most: int = MOST_POINTS) -> tuple[FloatArray, Codes]:
    """Keypoints (N, 2) [px] of one image (1, 1, H, W), strongest first, and their codes (N, 32), as on a robot."""
    maps = network(image)
    points, _ = find_peaks(network.scores(maps)[0].cpu().numpy(), LEAST_SCORE, NMS_PX, most)
    return points.astype(np.float64), sample_codes(maps.code_logits[0].cpu().numpy(), points)


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
    if figures["bit_bias": float(np.abs(bits.mean(axis=0) - 0.5).mean()) if len(first) else np.nan,
        "code_spread_bits": float(hamming_matrix(first_codes, first_codes).sum()) / pairs if pairs else np.nan,
    }
