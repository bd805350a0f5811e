"""The test pairs of a study of federated training, and the measures of a network on them."""

import zlib
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from fcslam.errors import InputError
from fcslam.features.codes import mutual_matches
from fcslam.features.detector import FeatureDetector
from fcslam.learning.homography import (
    in_common_view,
    inverse,
    match_errors,
    repeatability,
)
from fcslam.learning.images import ImageFile, is_usable, read_image
from fcslam.learning.labels import Labels
from fcslam.learning.pairs import AugmentedView, TrainingExample, ViewPair, draw_pair
from fcslam.records import Codes, FloatArray

from ..homography import Marks, estimate_homography, mark_error

MEASURES: Final = ("homography_3px", "mma_3px", "repeatability", "mma_3px_former", "mma_3px_between")
"""Shares in [0, 1]. The last two match the measured network in the second view with another one in the first: the
initial network, and the network of another robot, which is the same one where all robots share it.
"""
WITHIN_PX: Final = 3.0
VIEW: Final = (320, 240)
"""Width and height of a view [px]."""
PAIR_SEED: Final = 414
MOST_POINTS: Final = 300
"""Keypoints of each view that are used, the strongest ones."""


class DetectedFeatures(NamedTuple):
    """Keypoints of a view with their codes."""

    points: FloatArray
    """Shape (N, 2) [px]."""
    codes: Codes
    """Shape (N, 32)."""


def held_out_pairs(robot: str, files: Sequence[ImageFile], count: int) -> list[ViewPair]:
    """Pairs of views of a robot's images that no arm trains on; always the same.

    Raises:
        InputError: none of the images is usable.
    """
    images = [image for file in files if (image := read_image(file.path)) is not None and is_usable(image)]
    if not images:
        raise InputError(f"{robot}: none of its {len(files)} test images is usable; give more images")
    unlabelled = Labels(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    pairs = []
    for index in range(count):
        rng = np.random.default_rng([PAIR_SEED, zlib.crc32(robot.encode()), index])
        pairs.append(draw_pair(TrainingExample(images[index % len(images)], unlabelled), VIEW, 16, 0, rng))
    return pairs


def detect_features(detector: FeatureDetector, view: AugmentedView) -> DetectedFeatures:
    """Detect features in a view, with 8 bits a pixel as from a camera."""
    found = detector.detect(np.rint(255.0 * view.image).astype(np.uint8))
    return DetectedFeatures(found.keypoints_px.astype(np.float64), found.descriptors)


def measure_pair(
    detector: FeatureDetector, other: FeatureDetector, pair: ViewPair, legacy: DetectedFeatures
) -> tuple[float, float, float, float, float]:
    """``MEASURES`` of one pair; the homography is correct to 3 px at its corners (0 or 1).

    Without matches MMA is 0, so that a detector that finds nothing does not look good.

    Args:
        detector: to measure.
        other: the detector of another robot, or the same one.
        pair: two views.
        legacy: what the initial network detects in the first view, for the legacy MMA.
    """
    first, second = (detect_features(detector, view) for view in pair.views)
    matched = _matched(first, second, pair)
    error = mark_error(estimate_homography(*matched), Marks.corners(pair.homography, VIEW))
    again = repeatability(first.points, second.points, pair.homography, VIEW, MOST_POINTS).repeatability
    others = first if other is detector else detect_features(other, pair.views[0])
    accuracies = (_accuracy(_matched(features, second, pair), pair) for features in (legacy, others))
    return float(error <= WITHIN_PX), _accuracy(matched, pair), again, *accuracies


def _matched(first: DetectedFeatures, second: DetectedFeatures, pair: ViewPair) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) [px] of both views whose codes are mutual nearest neighbours, among the points in both views."""
    here = in_common_view(first.points, pair.homography, VIEW)
    there = in_common_view(second.points, inverse(pair.homography), VIEW)
    matches = mutual_matches(first.codes[here], second.codes[there]).pairs
    return first.points[here][matches[:, 0]], second.points[there][matches[:, 1]]


def _accuracy(matched: tuple[FloatArray, FloatArray], pair: ViewPair) -> float:
    right = match_errors(*matched, pair.homography) <= WITHIN_PX
    return float(right.mean()) if len(right) else 0.0
