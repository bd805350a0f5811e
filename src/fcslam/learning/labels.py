"""Labels of an image: keypoints with their quality, and a teacher's descriptors of some points.

Homographic adaptation (DeTone et al. 2018) averages a detector's response over many warped copies of an image. Points
that are found from many viewpoints keep a strong response, chance detections do not. It works with any detector that
gives a response at every pixel: the network itself, or Harris's measure, the most repeatable one on planes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fcslam.errors import InputError, writing
from fcslam.features.dense import find_peaks
from fcslam.features.detector import GreyImage
from fcslam.learning.homography import BORDER_PX, CORRECT_PX, inverse
from fcslam.learning.warps import random_change, warp_image
from fcslam.records import FloatArray
from fcslam.storage.state_file import read_state, write_state
from fcslam.untrusted import read_arrays

MOST_POINTS: Final = 800
WORST_QUALITY: Final = 0.1
"""Quality of the last of ``MOST_POINTS`` points; the first has 1."""

Points = NDArray[np.float32]
"""Shape (N, 2): x, y in pixels."""
Response = NDArray[np.float32]
"""Shape (height, width): strength of a keypoint at each pixel."""


@dataclass(frozen=True, slots=True)
class Teacher:
    """A teacher's keypoints and descriptors in one image."""

    keypoints: Points
    """Strongest first."""
    descriptors: NDArray[np.float16]
    """Shape (N, D), of unit length."""


@dataclass(frozen=True, slots=True)
class Labels:
    """Keypoints of one image."""

    keypoints: Points
    quality: NDArray[np.float32]
    """Shape (N,): in (0, 1], 1 for the best keypoint of the image."""


def adapt(
    detector: Callable[[GreyImage], Response], image: GreyImage, copies: int, rng: np.random.Generator
) -> Response:
    """Mean response of ``detector`` over the image and ``copies`` warped copies that show a pixel."""
    size = (image.shape[1], image.shape[0])
    total = detector(image).astype(np.float32)
    count = np.ones(image.shape, np.float32)
    for _ in range(copies):
        homography = random_change(size, rng)
        back = inverse(homography)
        response = detector(warp_image(image, homography, size))
        everywhere = np.zeros(image.shape, np.float32)
        everywhere[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 1.0
        total += _unwarp(response * everywhere, back)
        count += _unwarp(everywhere, back)
    return total / count


def harris(image: GreyImage) -> Response:
    """Square root of Harris's corner measure (Harris and Stephens 1988); the root limits strong contrast."""
    measure = np.asarray(cv2.cornerHarris(image, blockSize=4, ksize=3, k=0.04), np.float32)
    response: Response = np.sqrt(np.maximum(measure, np.float32(0.0)))
    return response


def peaks(response: Response, nms_px: float, most: int) -> Points:
    """The strongest local maxima, shape (N, 2) [px] with sub-pixel accuracy, strongest first."""
    within = np.zeros_like(response)
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    within[inner] = response[inner]
    points, _ = find_peaks(within, 0.0, nms_px, most)
    return points


def fuse_keypoints(first: Points, second: Points) -> Labels:
    """Fuse the keypoints of two detectors into one set, ranked by the mean of both ranks.

    A point that both detectors found lies midway between theirs; one of a single detector ranks last with the other.

    Args:
        first, second: shape (N, 2) [px], strongest first.
    """
    ranks = [1.0 - np.arange(len(points)) / MOST_POINTS for points in (first, second)]
    if min(len(first), len(second)) == 0:
        points, score = np.concatenate((first, second)), np.concatenate(ranks) / 2.0
    else:
        distances, nearest = cKDTree(second).query(first, distance_upper_bound=CORRECT_PX)
        both = np.isfinite(distances)
        partner = np.where(both, nearest, 0)
        unmatched = np.ones(len(second), np.bool_)
        unmatched[partner[both]] = False
        middle = np.where(both[:, None], 0.5 * (first + second[partner]), first)
        points = np.concatenate((middle, second[unmatched]))
        score = np.concatenate((ranks[0] + np.where(both, ranks[1][partner], 0.0), ranks[1][unmatched])) / 2.0
    kept = _suppress(points, score)[:MOST_POINTS]
    quality = 1.0 - (1.0 - WORST_QUALITY) * np.arange(len(kept)) / MOST_POINTS
    return Labels(points[kept].astype(np.float32), quality.astype(np.float32))


def read_teacher(path: Path) -> Teacher:
    """Read a teacher's file, which a script of the user has made (see docs/howto/training.md)."""
    try:
        arrays = read_arrays(path)
        keypoints, scores, descriptors = (arrays[name] for name in ("keypoints", "scores", "descriptors"))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: is not a file of a teacher's points ({error})") from error
    sides = (scores.ndim, keypoints.ndim, keypoints.shape[1:], descriptors.ndim) == (1, 2, (2,), 2)
    sound = sides and len(keypoints) == len(scores) == len(descriptors)
    if not sound or not all(is_finite(array) for array in (keypoints, scores, descriptors)):
        raise InputError(f"{path}: keypoints (N, 2), scores (N,) and descriptors (N, D) do not fit together")
    order = np.argsort(-scores.astype(np.float64), kind="stable")
    return Teacher(keypoints[order].astype(np.float32), descriptors[order].astype(np.float16))


def is_finite(array: NDArray[np.generic]) -> bool:
    """Whether an array holds finite numbers only."""
    return array.dtype.kind in "fiu" and bool(np.isfinite(array).all())


def write_labels(path: Path, labels: Labels, key: int) -> None:
    """Write labels for later runs; ``key`` identifies the image and how it was labelled."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_state(path, f"labels {key}", {"keypoints": labels.keypoints, "quality": labels.quality})


def read_labels(path: Path, key: int) -> Labels | None:
    """The labels of the image with this key; None if the file does not hold them."""
    try:
        found = read_state(path, f"labels {key}")
    except InputError:
        return None
    return None if found is None else Labels(**found)


def _suppress(points: Points, score: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the points that have no better point within ``CORRECT_PX``, best first."""
    order = np.argsort(-score, kind="stable")
    rank = np.empty(len(points), np.int64)
    rank[order] = np.arange(len(points))
    kept = np.ones(len(points), np.bool_)
    neighbours = cKDTree(points).query_ball_point(points, CORRECT_PX) if len(points) else []
    for index in order:
        if kept[index]:
            for other in neighbours[index]:
                if rank[other] > rank[index]:
                    kept[other] = False
    return order[kept[order]]


def _unwarp(response: Response, homography: FloatArray) -> Response:
    height, width = response.shape
    return np.asarray(cv2.warpPerspective(response, homography, (width, height), flags=cv2.INTER_LINEAR), np.float32)
