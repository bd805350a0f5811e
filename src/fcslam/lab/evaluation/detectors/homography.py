"""Evaluates detectors and descriptors on scenes with known homographies: tables I and II of FC-SLAM, and more.

Each measure follows its original definition:

- repeatability and localization error at 320 x 240, NMS 4, the 300 strongest in common view (SuperPoint);
- homography from mutual nearest neighbours at 640 x 480 among the 1000 strongest in common view (SuperPoint);
- mean matching accuracy (D2-Net) and matching score (KP2D) at 640 x 480 among the 1000 strongest of each image.

All but the first are computed with NMS 8 and without NMS.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

import numpy as np

from fcslam.features.detector import FloatFeatures, ImageFeatures, Keypoints
from fcslam.features.matching import mutual_pairs, nearest_neighbours
from fcslam.features.nms import box_nms
from fcslam.lab.evaluation.detectors.evaluated_detectors import (
    EvaluatedDetector,
    FramedImage,
    Stopwatch,
    frame,
    one_thread,
)
from fcslam.lab.evaluation.detectors.scenes import Scene, SceneKind
from fcslam.metrics.homography import (
    HomographyGroundTruth,
    Repeatability,
    Size,
    corner_error,
    estimate_homography,
    framed_homography,
    in_common_view,
    inverse,
    match_errors,
    matching_accuracy,
    matching_score,
    repeatability,
)
from fcslam.records import FloatArray

SMALL: Final[Size] = (320, 240)
LARGE: Final[Size] = (640, 480)
REPEATABILITY_NMS_PX: Final = 4
MATCHING_NMS_PX: Final = (8, 0)
ACCURACY_PX: Final = tuple(range(1, 11))
DETECTED, IN_COMMON, MATCHED = 1000, 300, 1000
"""Most keypoints: after NMS 4, of these in common view, and for matching."""

DescribedKeypoints = ImageFeatures | FloatFeatures
AnyKeypoints = TypeVar("AnyKeypoints", bound=Keypoints)


@dataclass(frozen=True, slots=True)
class MatchingResult:
    """Matching measures of one pair of images."""

    corner_error_px: float
    """Corner error of the homography estimated from the matches; infinite without one."""
    accuracy: FloatArray
    """Matching accuracy at ``ACCURACY_PX``, shape (10,)."""
    score: float
    matches: int


NO_MATCHES = MatchingResult(np.inf, np.zeros(len(ACCURACY_PX)), 0.0, 0)


@dataclass(frozen=True, slots=True)
class PairResult:
    """Measures of one detector on one pair of images."""

    detector: str
    scene: str
    kind: SceneKind
    image: str
    """The second image: its file's name without the suffix."""
    repeatability: Repeatability
    matching: Mapping[int, MatchingResult]
    """Measures by NMS in pixels; empty for detectors without descriptors."""


@dataclass(frozen=True, slots=True)
class HomographyReport:
    """Measures of every detector on every pair, and CPU times."""

    detectors: tuple[str, ...]
    pairs: tuple[PairResult, ...]
    milliseconds: Mapping[tuple[str, Size], float]
    """Median CPU time for one image on one thread, from grey levels to described keypoints."""

    def of(self, detector: str) -> tuple[PairResult, ...]:
        """The pairs of one detector; the order is the same for all detectors."""
        return tuple(pair for pair in self.pairs if pair.detector == detector)


class _Found(NamedTuple):
    picture: FramedImage
    keypoints: Keypoints


def evaluate_homography(
    scenes: Sequence[Scene],
    detectors: Sequence[EvaluatedDetector],
    truth: HomographyGroundTruth = HomographyGroundTruth.CORRECTED,
    watch: Callable[[], None] = lambda: None,
) -> HomographyReport:
    """Run every detector on every scene; ``watch`` is called after each scene of each detector.

    Raises:
        FeatureError: an image, or extracted features, cannot be read.
        EvaluationError: extracted features belong to another image.
    """
    stopwatch, pairs = Stopwatch(), list[PairResult]()
    with one_thread():
        for scene in scenes:
            for detector in detectors:
                pairs += _evaluate_scene(scene, detector, truth, stopwatch)
                watch()
    return HomographyReport(tuple(each.name for each in detectors), tuple(pairs), stopwatch.milliseconds())


def _evaluate_scene(
    scene: Scene, detector: EvaluatedDetector, truth: HomographyGroundTruth, stopwatch: Stopwatch
) -> Iterator[PairResult]:
    small = _find_all(scene, detector, SMALL, stopwatch)
    is_described = isinstance(small[0].keypoints, DescribedKeypoints)
    large = _find_all(scene, detector, LARGE, stopwatch) if is_described else []
    for number, (path, H) in enumerate(scene.others, start=1):
        again = repeat_pair(small[0].keypoints, small[number].keypoints, _true(H, small[0], small[number], truth))
        matching = _match_all(large[0], large[number], _true(H, large[0], large[number], truth)) if large else {}
        yield PairResult(detector.name, scene.name, scene.kind, path.stem, again, matching)


def _find_all(scene: Scene, detector: EvaluatedDetector, size: Size, stopwatch: Stopwatch) -> list[_Found]:
    """Keypoints of image 1, then of the other images."""
    pictures = [frame(path, size) for path in (scene.reference, *(path for path, _ in scene.others))]
    return [_Found(picture, stopwatch.find(detector, picture)) for picture in pictures]


def _true(H: FloatArray, first: _Found, second: _Found, truth: HomographyGroundTruth) -> FloatArray:
    return framed_homography(H, first.picture.framing, second.picture.framing, truth)


def _match_all(first: _Found, second: _Found, H: FloatArray) -> dict[int, MatchingResult]:
    """Matching measures for each NMS."""
    here, there = described(first.keypoints), described(second.keypoints)
    return {nms_px: match_pair(thinned(here, nms_px), thinned(there, nms_px), H) for nms_px in MATCHING_NMS_PX}


def repeat_pair(first: Keypoints, second: Keypoints, H: FloatArray) -> Repeatability:
    """Repeatability of the keypoints of two images of size ``SMALL``, the strongest first; H (3, 3) is the true one."""
    here, there = (_points(thinned(found, REPEATABILITY_NMS_PX))[:DETECTED] for found in (first, second))
    return repeatability(here, there, H, SMALL, IN_COMMON)


def match_pair(first: DescribedKeypoints, second: DescribedKeypoints, H: FloatArray) -> MatchingResult:
    """Match the keypoints of two images of size ``LARGE``, the strongest first; H (3, 3) is the true homography."""
    common_first = first.take(in_common_view(_points(first), H, LARGE)[:MATCHED])
    common_second = second.take(in_common_view(_points(second), inverse(H), LARGE)[:MATCHED])
    first, second = first.take(slice(MATCHED)), second.take(slice(MATCHED))
    errors = match_errors(*matched_points(first, second), H)
    if not len(errors):
        return NO_MATCHES
    nearest = nearest_neighbours(first.descriptors, second.descriptors)
    return MatchingResult(
        corner_error(estimate_homography(*matched_points(common_first, common_second)), H, LARGE),
        matching_accuracy(errors, ACCURACY_PX),
        matching_score((_points(first), _points(second)), nearest, H, LARGE),
        len(errors),
    )


def matched_points(first: DescribedKeypoints, second: DescribedKeypoints) -> tuple[FloatArray, FloatArray]:
    """Positions of mutual nearest neighbours by descriptor in both images, pixels, shape (K, 2) each."""
    if not (len(first.scores) and len(second.scores)):
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = mutual_pairs(*nearest_neighbours(first.descriptors, second.descriptors))
    return _points(first)[pairs[:, 0]], _points(second)[pairs[:, 1]]


def thinned(found: AnyKeypoints, nms_px: float) -> AnyKeypoints:
    """Keypoints after non-maximum suppression by boxes of side ``nms_px``."""
    return found.take(box_nms(found.keypoints_px, nms_px))


def described(found: Keypoints) -> DescribedKeypoints:
    """Narrow the type to keypoints with descriptors; raises TypeError if they have none."""
    if isinstance(found, ImageFeatures | FloatFeatures):
        return found
    raise TypeError("keypoints without descriptors cannot be matched")


def _points(found: Keypoints) -> FloatArray:
    return found.keypoints_px.astype(np.float64)
