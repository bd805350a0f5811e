"""Validation of a network on pairs of images that it was not trained on, and checks for collapsing codes."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fcslam.features.codes import CODE_BITS, hamming_matrix, mutual_matches
from fcslam.features.dense import find_peaks, sample_codes
from fcslam.features.detector import OnnxConfig
from fcslam.learning.homography import (
    CORRECT_PX,
    in_common_view,
    inverse,
    match_errors,
    matching_accuracy,
    repeatability,
)
from fcslam.learning.labels import Points
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample, ViewPair, draw_pair
from fcslam.records import Codes

VALIDATION_PAIRS: Final = 24
VALIDATION_VIEW: Final = (320, 240)
"""Width and height of a view [px]."""
ROBOT: Final = OnnxConfig(least_score=0.001)
"""Keypoints are found as robots do, but also fainter ones."""
LEAST_SPREAD_BITS: Final = 0.3 * CODE_BITS
"""Codes of different points that differ in fewer bits on average are collapsing; chance gives a half of all bits."""
LARGEST_BIAS: Final = 0.25
"""Bits whose mean is farther from a half than this carry little information."""


def validation_pairs(held_out: Sequence[TrainingExample]) -> list[ViewPair]:
    """Pairs of views of held-out images, spread over all of them; always the same."""
    pairs = []
    count = min(VALIDATION_PAIRS, len(held_out))
    for index in range(count):
        rng = np.random.default_rng([2026, index])
        example = held_out[index * len(held_out) // count]
        # Validation uses no points of a pair, but drawing 16 of them is part of the random sequence.
        pairs.append(draw_pair(example, VALIDATION_VIEW, 16, 0, rng))
    return pairs


@torch.inference_mode()
def detect(network: KeypointNetwork, image: Tensor, config: OnnxConfig) -> tuple[Points, NDArray[np.float32], Codes]:
    """Keypoints (N, 2) [px] of one image (1, 1, H, W), strongest first, their strengths, and their codes (N, 32)."""
    maps = network(image)
    scores = network.scores(maps)[0].cpu().numpy()
    points, strengths = find_peaks(scores, config.least_score, config.nms_px, config.most_features)
    return points, strengths, sample_codes(maps.code_logits[0].cpu().numpy(), points)


def validate(network: KeypointNetwork, pairs: Sequence[ViewPair], device: torch.device) -> dict[str, float]:
    """Metrics of a network, means over pairs of views of images that it was not trained on.

    Returns:
        ``repeatability`` and ``mma_3px`` in [0, 1]; ``bit_bias``, the mean distance of a bit's mean from a half, in
        [0, 0.5]; ``code_spread_bits``, the mean distance between codes in a view [bits].
    """
    training = network.training
    network.eval()
    rows = [_validate_pair(network, pair, device) for pair in pairs]
    network.train(training)
    return {name: _mean([row[name] for row in rows]) for name in rows[0]}


def collapse_warnings(figures: dict[str, float]) -> list[str]:
    """Warnings of collapsing codes; empty if there is nothing to report."""
    found = []
    if figures["code_spread_bits"] < LEAST_SPREAD_BITS:
        found.append(f"codes collapse: codes of different points differ in {figures['code_spread_bits']:.0f} bits")
    if figures["bit_bias"] > LARGEST_BIAS:
        found.append(f"bits are stuck: their means are {figures['bit_bias']:.2f} from a half")
    return found


def _validate_pair(network: KeypointNetwork, pair: ViewPair, device: torch.device) -> dict[str, float]:
    images = [torch.from_numpy(view.image)[None, None].to(device) for view in pair.views]
    (first, _, first_codes), (second, _, second_codes) = (detect(network, image, ROBOT) for image in images)
    first, second = first.astype(np.float64), second.astype(np.float64)
    size = (images[0].shape[-1], images[0].shape[-2])
    here, there = in_common_view(first, pair.homography, size), in_common_view(second, inverse(pair.homography), size)
    matches = mutual_matches(first_codes[here], second_codes[there]).pairs
    errors = match_errors(first[here][matches[:, 0]], second[there][matches[:, 1]], pair.homography)
    bits = np.unpackbits(first_codes, axis=1)
    pairs = len(first) * (len(first) - 1)
    return {
        "repeatability": repeatability(first, second, pair.homography, size, ROBOT.most_features).repeatability,
        "mma_3px": float(matching_accuracy(errors, [CORRECT_PX])[0]),
        "bit_bias": float(np.abs(bits.mean(axis=0) - 0.5).mean()) if len(first) else np.nan,
        "code_spread_bits": float(hamming_matrix(first_codes, first_codes).sum()) / pairs if pairs else np.nan,
    }


def _mean(values: Sequence[float]) -> float:
    """Mean of the values that are not NaN; NaN if all are."""
    numbers = [value for value in values if not np.isnan(value)]
    return sum(numbers) / len(numbers) if numbers else float("nan")
