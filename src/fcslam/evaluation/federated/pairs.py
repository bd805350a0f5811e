"""What networks of a study of federated training are measured on: pairs of views of images that nobody trained on."""

import zlib
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from fcslam.errors import EvaluationError
from fcslam.features.codes import mutual_matches
from fcslam.features.detector import FeatureDetector
from fcslam.learning.images import ImageFile, is_usable, read_image
from fcslam.learning.labels import Labels
from fcslam.learning.pairs import AugmentedView, TrainingExample, ViewPair, draw_pair
from fcslam.metrics.homography import corner_error, estimate_homography, inverse, match_errors
from fcslam.metrics.repeatability import in_common_view, repeatability
from fcslam.records import Codes, FloatArray

MEASURES: Final = ("homography_3px", "mma_3px", "repeatability", "mma_3px_former")
WITHIN_PX: Final = 3.0
VIEW: Final = (320, 240)
PAIR_SEED: Final = 414
MOST_POINTS: Final = 300
"""The best of so many that each view sees are looked for again."""


class DetectedFeatures(NamedTuple):
    """What a detector finds in a view."""

    points: FloatArray
    """Shape (N, 2) [px]."""
    codes: Codes
    """Shape (N, 32)."""


def held_out_pairs(robot: str, files: Sequence[ImageFile], count: int) -> list[ViewPair]:
    """Pairs of views of a robot's images; always the same.

    Raises:
        EvaluationError: none of the images is usable.
    """
    images = [image for file in files if (image := read_image(file.path)) is not None and is_usable(image)]
    if not images:
        raise EvaluationError(f"{robot}: no usable image is among the {len(files)} that are held out to test on")
    unlabelled = Labels(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    pairs = []
    for index in range(count):
        rng = np.random.default_rng([PAIR_SEED, zlib.crc32(robot.encode()), index])
        pairs.append(draw_pair(TrainingExample(images[index % len(images)], unlabelled), VIEW, 16, 0, rng))
    return pairs


def detect_features(detector: FeatureDetector, view: AugmentedView) -> DetectedFeatures:
    """What a detector finds, of 8 bits a pixel as a camera gives them."""
    found = detector.detect(np.rint(255.0 * view.image).astype(np.uint8))
    return DetectedFeatures(found.keypoints_px.astype(np.float64), found.descriptors)


def measure_pair(
    detector: FeatureDetector, pair: ViewPair, former: DetectedFeatures
) -> tuple[float, float, float, float]:
    """``MEASURES`` of one pair: homography right to 3 px at the corners or not, MMA at 3 px, repeatability, former MMA.

    The last is that of the codes which a ``former`` detector gave the first view and this one gives the second.
    Where nothing is matched MMA is 0, or a detector that finds nothing would look good.
    """
    first, second = (detect_features(detector, view) for view in pair.views)
    matched = _matched(first, second, pair)
    error = corner_error(estimate_homography(*matched), pair.homography, VIEW)
    again = repeatability(first.points, second.points, pair.homography, VIEW, MOST_POINTS).repeatability
    return float(error <= WITHIN_PX), _accuracy(matched, pair), again, _accuracy(_matched(former, second, pair), pair)


def _matched(first: DetectedFeatures, second: DetectedFeatures, pair: ViewPair) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) of both views whose codes are each other's nearest, among those that both see."""
    here = in_common_view(first.points, pair.homography, VIEW)
    there = in_common_view(second.points, inverse(pair.homography), VIEW)
    matches = mutual_matches(first.codes[here], second.codes[there]).pairs
    return first.points[here][matches[:, 0]], second.points[there][matches[:, 1]]


def _accuracy(matched: tuple[FloatArray, FloatArray], pair: ViewPair) -> float:
    right = match_errors(*matched, pair.homography) <= WITHIN_PX
    return float(right.mean()) if len(right) else 0.0
