"""Evaluates detectors and descriptors on scenes with known homographies: tables I and II of FC-SLAM, and more.

Each measure follows its original definition:

- repeatability and localization error at 320 x 240, NMS 4, the 300 strongest in common view (SuperPoint);
- homography from mutual nearest neighbours at 640 x 480 among the 1000 strongest in common view (SuperPoint), as the
  mean of 50 orders of the matches: the result of RANSAC depends on it;
- mean matching accuracy (D2-Net) and matching score (KP2D) at 640 x 480 among the 1000 strongest of each image.

All but the first are computed with NMS 8 and without NMS.
"""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import cv2
import numpy as np

from fcslam.errors import writing
from fcslam.features.dense import box_nms
from fcslam.features.detector import ImageFeatures, Keypoints
from fcslam.learning.homography import (
    Repeatability,
    Rows,
    Size,
    in_common_view,
    inside,
    inverse,
    match_errors,
    matching_accuracy,
    repeatability,
    warp,
)
from fcslam.metrics.bootstrap import DRAWS, Interval
from fcslam.records import FloatArray

from .baselines import FloatFeatures
from .detectors import (
    EvaluatedDetector,
    FramedImage,
    Framing,
    Scene,
    SceneKind,
    Stopwatch,
    frame,
    one_thread,
)
from .matching import mutual_pairs, nearest_neighbours

SMALL: Final[Size] = (320, 240)
LARGE: Final[Size] = (640, 480)
REPEATABILITY_NMS_PX: Final = 4
MATCHING_NMS_PX: Final = (8, 0)
ACCURACY_PX: Final = tuple(range(1, 11))
DETECTED, IN_COMMON, MATCHED = 1000, 300, 1000
"""Most keypoints: after NMS 4, of these in common view, and for matching."""


class HomographyGroundTruth(StrEnum):
    """How to compute the true homography between two scaled and cropped images."""

    CORRECTED = "corrected"
    """With the scale and the crop of both images: the correct one."""
    LEGACY = "legacy"
    """As in SuperPoint's widely used evaluation until 2019, which ignores the crop and the scale of the second image.
    Almost no match is then correct under a change of viewpoint, but published tables use it."""


def framed_homography(H: FloatArray, first: Framing, second: Framing, truth: HomographyGroundTruth) -> FloatArray:
    """Homography (3, 3) between two framed images from H (3, 3) between the original images, in pixels."""
    if truth is HomographyGroundTruth.LEGACY:
        scaling = np.diag([first.scale, first.scale, 1.0])
        return scaling @ H @ np.linalg.inv(scaling)
    return second.matrix @ H @ np.linalg.inv(first.matrix)


DescribedKeypoints = ImageFeatures | FloatFeatures
AnyKeypoints = TypeVar("AnyKeypoints", bound=Keypoints)


ESTIMATORS: Final = {"homography": cv2.RANSAC, "magsac": cv2.USAC_MAGSAC}
"""Robust estimators of OpenCV, by the name of their measures."""
ORDERS: Final = 50


class Marks(NamedTuple):
    """Where an estimated homography is judged: the same points of the plane in both images, pixels, shape (N, 2)."""

    first: FloatArray
    second: FloatArray

    @classmethod
    def corners(cls, H: FloatArray, size: Size) -> "Marks":
        """The corners of image 1, and where H (3, 3) maps them."""
        right, low = size[0] - 1.0, size[1] - 1.0
        corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, low], [right, low]])
        return cls(corners, warp(H, corners))


@dataclass(frozen=True, slots=True)
class MatchingResult:
    """Matching measures of one pair of images."""

    errors_px: FloatArray
    """Error of the homographies by each of ``ESTIMATORS``, for ``ORDERS`` of the matches, shape (2, 50); infinite
    without a homography."""
    accuracy: FloatArray
    """Matching accuracy at ``ACCURACY_PX``, shape (10,)."""
    score: float
    matches: int


UNKNOWN = Repeatability(0, 0, 0.0)
NO_MATCHES = MatchingResult(np.full((len(ESTIMATORS), ORDERS), np.inf), np.zeros(len(ACCURACY_PX)), 0.0, 0)


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
        InputError: extracted features belong to another image.
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
        again, matching, marks = UNKNOWN, {}, scene.marks.get(path)
        if marks is None:
            again = repeat_pair(small[0].keypoints, small[number].keypoints, _true(H, small[0], small[number], truth))
        if large:
            framed = None if marks is None else _framed(Marks(*marks), large[0], large[number])
            matching = _match_all(large[0], large[number], _true(H, large[0], large[number], truth), framed)
        yield PairResult(detector.name, scene.name, scene.kind, path.stem, again, matching)


def _find_all(scene: Scene, detector: EvaluatedDetector, size: Size, stopwatch: Stopwatch) -> list[_Found]:
    """Keypoints of image 1, then of the other images."""
    pictures = [frame(path, size) for path in (scene.reference, *(path for path, _ in scene.others))]
    return [_Found(picture, stopwatch.find(detector, picture)) for picture in pictures]


def _true(H: FloatArray, first: _Found, second: _Found, truth: HomographyGroundTruth) -> FloatArray:
    return framed_homography(H, first.picture.framing, second.picture.framing, truth)


def _framed(marks: Marks, first: _Found, second: _Found) -> Marks:
    return Marks(warp(first.picture.framing.matrix, marks.first), warp(second.picture.framing.matrix, marks.second))


def _match_all(first: _Found, second: _Found, H: FloatArray, marks: Marks | None) -> dict[int, MatchingResult]:
    """Matching measures for each NMS."""
    here, there = described(first.keypoints), described(second.keypoints)
    return {nms_px: match_pair(thinned(here, nms_px), thinned(there, nms_px), H, marks) for nms_px in MATCHING_NMS_PX}


def repeat_pair(first: Keypoints, second: Keypoints, H: FloatArray) -> Repeatability:
    """Repeatability of the keypoints of two images of size ``SMALL``, the strongest first; H (3, 3) is the true one."""
    here, there = (_points(thinned(found, REPEATABILITY_NMS_PX))[:DETECTED] for found in (first, second))
    return repeatability(here, there, H, SMALL, IN_COMMON)


def match_pair(
    first: DescribedKeypoints, second: DescribedKeypoints, H: FloatArray, marks: Marks | None = None
) -> MatchingResult:
    """Match the keypoints of two images of size ``LARGE``, the strongest first; H (3, 3) is the true homography.

    ``marks``: all that is known exactly. Then H is that of a plane near them, and only gives the common view.
    """
    common_first = first.take(in_common_view(_points(first), H, LARGE)[:MATCHED])
    common_second = second.take(in_common_view(_points(second), inverse(H), LARGE)[:MATCHED])
    first, second = first.take(slice(MATCHED)), second.take(slice(MATCHED))
    errors = match_errors(*matched_points(first, second), H)
    if not len(errors):
        return NO_MATCHES
    judged = Marks.corners(H, LARGE) if marks is None else marks
    errors_px = homography_errors(*matched_points(common_first, common_second), judged)
    if marks is not None:
        return MatchingResult(errors_px, np.full(len(ACCURACY_PX), np.nan), np.nan, len(errors))
    nearest = nearest_neighbours(first.descriptors, second.descriptors)
    return MatchingResult(
        errors_px,
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


CORRECT_PX = (1, 3, 5)
"""Thresholds of the error of a correct homography."""


def pair_measures(pair: PairResult) -> dict[str, float]:
    """All measures of a pair: ``repeatability``, ``localization_error_px``, and for each NMS n in pixels
    ``homography_<e>px_nms<n>`` and ``magsac_<e>px_nms<n>`` (shares of the orders), ``accuracy_<t>px_nms<n>``,
    ``score_nms<n>`` and ``matches_nms<n>``."""
    measures = {
        "repeatability": pair.repeatability.repeatability,
        "localization_error_px": pair.repeatability.localization_error_px,
    }
    for nms_px, result in pair.matching.items():
        measures |= {f"{name}_nms{nms_px}": value for name, value in _matching_measures(result).items()}
    return measures


def column(pairs: Sequence[PairResult], measure: str) -> FloatArray:
    """One measure of every pair, shape (N,); NaN if unknown."""
    return np.array([pair_measures(pair).get(measure, np.nan) for pair in pairs], np.float64)


def mean(pairs: Sequence[PairResult], measure: str, kind: SceneKind | None = None) -> float:
    """Mean of a measure over the pairs, or over those of one kind of scene; NaN without any."""
    values = column([pair for pair in pairs if kind in (None, pair.kind)], measure)
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def interval(pairs: Sequence[PairResult], measure: str, seed: int) -> Interval:
    """The mean over all pairs with its bootstrap interval."""
    return _by_scenes(pairs, column(pairs, measure), seed)


def difference(first: Sequence[PairResult], other: Sequence[PairResult], measure: str, seed: int) -> Interval:
    """Mean difference ``first`` minus ``other`` on the same pairs, with its paired bootstrap interval."""
    return _by_scenes(first, column(first, measure) - column(other, measure), seed)


def _by_scenes(pairs: Sequence[PairResult], values: FloatArray, seed: int) -> Interval:
    """The mean of the pairs' values (N,), and its bootstrap over scenes: the pairs of a scene have one image 1."""
    known = np.isfinite(values)
    if not known.any():
        return Interval(np.nan, np.nan, np.nan)
    _, scene = np.unique([pair.scene for pair in pairs], return_inverse=True)
    sums, counts = np.bincount(scene, np.where(known, values, 0.0)), np.bincount(scene, known)
    sums, counts = sums[counts > 0], counts[counts > 0]
    drawn = np.random.default_rng(seed).integers(len(sums), size=(DRAWS, len(sums)))
    low, high = np.quantile(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1), (0.025, 0.975))
    return Interval(float(values[known].mean()), float(low), float(high))


def write_pairs(report: HomographyReport, path: Path) -> None:
    """Write a CSV file with a line for every detector and pair, and a column for every measure.

    Raises:
        InputError: the file cannot be written.
    """
    rows = [(pair, pair_measures(pair)) for pair in report.pairs]
    names = list(dict.fromkeys(name for _, measures in rows for name in measures))
    with writing(path, "choose another place"), path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["detector", "scene", "kind", "image", *names])
        for pair, measures in rows:
            cells = (f"{measures[name]:.6g}" if name in measures else "" for name in names)
            writer.writerow([pair.detector, pair.scene, pair.kind, pair.image, *cells])


def _matching_measures(result: MatchingResult) -> dict[str, float]:
    return {
        **{
            f"{name}_{px}px": float(np.mean(errors_px <= px))
            for name, errors_px in zip(ESTIMATORS, result.errors_px, strict=True)
            for px in CORRECT_PX
        },
        **{f"accuracy_{px}px": float(share) for px, share in zip(ACCURACY_PX, result.accuracy, strict=True)},
        "score": result.score,
        "matches": float(result.matches),
    }


def homography_errors(first: FloatArray, second: FloatArray, marks: Marks) -> FloatArray:
    """Errors at the ``marks`` of homographies from matched points (N, 2), pixels; as ``MatchingResult.errors_px``."""
    orders = [np.random.default_rng(k).permutation(len(first)) for k in range(ORDERS)]
    return np.array(
        [
            [mark_error(estimate_homography(first[order], second[order], method), marks) for order in orders]
            for method in ESTIMATORS.values()
        ]
    )


def estimate_homography(first: FloatArray, second: FloatArray, method: int = cv2.RANSAC) -> FloatArray | None:
    """Estimate H (3, 3) from matched points (N, 2), pixels, with OpenCV's defaults (3 px, 2000 iterations).

    Returns None if there are fewer than 4 matches or no solution.
    """
    if len(first) < 4:
        return None
    H, _ = cv2.findHomography(first, second, method)
    return None if H is None or H[2, 2] == 0.0 else np.asarray(H, np.float64)


def mark_error(estimated: FloatArray | None, marks: Marks) -> float:
    """Mean distance, pixels, of the marks from where a homography (3, 3) maps them; infinite if undefined."""
    if estimated is None:
        return np.inf
    error = float(np.mean(np.linalg.norm(warp(estimated, marks.first) - marks.second, axis=1)))
    return error if np.isfinite(error) else np.inf


def matching_score(
    points: tuple[FloatArray, FloatArray], nearest: tuple[Rows, Rows], H: FloatArray, size: Size
) -> float:
    """Share of the keypoints in common view whose nearest neighbour is correct to 3 px, mean of both directions.

    ``nearest`` are the rows of each keypoint's nearest neighbour by descriptor in the other image, (N,) and (M,). H (3,
    3) takes image 1 to image 2.
    """
    first, second = points
    forward = _share_right(first, second[nearest[0]], H, size)
    backward = _share_right(second, first[nearest[1]], inverse(H), size)
    return 0.5 * (forward + backward)


def _share_right(points: FloatArray, neighbours: FloatArray, H: FloatArray, size: Size) -> float:
    seen = inside(warp(H, points), size)
    return float(np.mean(match_errors(points, neighbours, H)[seen] < 3.0)) if seen.any() else 0.0
