"""Correspondences between two images of one place, from the poses that SLAM estimated and the keypoints' depth.

A homography makes pairs of one image only. Two visits differ in light, side and the furniture around the points.

Poses and depths are a few centimetres off, which is several pixels nearby. So the codes of the points that match anyway
first tell how far the predicted pixels are off in each part of the image. Then geometry alone decides which keypoint is
which: also where codes disagree, as only those pairs can teach anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fcslam.features.codes import LARGEST_HAMMING, hamming_matrix
from fcslam.features.detector import GreyImage, ImageFeatures
from fcslam.features.lidar_depth import LidarView, locate_among, project
from fcslam.geometry import se2
from fcslam.learning.homography import BORDER_PX, CORRECT_PX
from fcslam.records import CameraModel, FloatArray

SAME_POINT_M: Final = 0.15
"""Largest distance, seen from above, between a point and the surface that the other view shows in its direction."""
SEARCH_PX: Final = 12.0
"""Largest distance between a predicted pixel and a keypoint that may be the same point, before the correction."""
NEIGHBOURS: Final = 9
"""Keypoints with like codes over which the correction of the predicted pixels is a median."""
FEWEST_ALIKE: Final = NEIGHBOURS // 2 + 1
"""Fewest such keypoints; two views with fewer give no correspondences."""
AGREEING: Final = 0.5
"""Least share of the keypoints with like codes whose own offset is within ``CORRECT_PX`` of the correction."""
SNAP_PX: Final = 2.0
"""Largest distance between a corrected pixel and the keypoint that is the same point."""

FARTHEST_M: Final = 4.0
WIDEST_RAD: Final = 1.5
"""Two views farther apart, or turned by more, are not compared."""
FEWEST_SHARED: Final = 12
"""Fewest points that make two views a pair."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """An image with its keypoints, and where they are."""

    image: GreyImage
    features: ImageFeatures
    camera: CameraModel
    surroundings: tuple[LidarView, ...]
    """LiDAR returns in ``base`` at the time of the image."""
    positions: FloatArray
    """Position of each keypoint in ``base``, shape (K, 3), metres; 0 without one."""
    placed: NDArray[np.bool_]
    """Which keypoints have a position, shape (K,)."""

    @classmethod
    def of(
        cls, image: GreyImage, features: ImageFeatures, camera: CameraModel, surroundings: tuple[LidarView, ...]
    ) -> "Keyframe":
        """Locate the keypoints."""
        positions, placed = locate_among(features.keypoints_px, camera, surroundings)
        return cls(image, features, camera, surroundings, positions, placed)


def predict(first: Keyframe, second: Keyframe, T_first_second: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where the second keyframe shows the keypoints of the first, pixels (K, 2), and which of them it shows, (K,).

    A point is shown in the image, and on the surface that the LiDAR measures in its direction, so that nothing hides
    it. ``T_first_second`` (3,) is the pose of the second base in the first, in metres and radians.
    """
    there = first.positions.copy()
    there[:, :2] = se2.transform(se2.inverse(T_first_second), first.positions[:, :2])
    pixels = project(there, second.camera)
    last = np.array([second.camera.width - 1.0, second.camera.height - 1.0])
    inside = np.all((pixels >= BORDER_PX) & (pixels <= last - BORDER_PX), axis=1)  # NaN is outside
    shown = first.placed & inside
    surface, met = locate_among(pixels[shown].astype(np.float32), second.camera, second.surroundings)
    gap_m = np.hypot(*(surface[:, :2] - there[shown, :2]).T)
    shown[shown] = met & (gap_m <= SAME_POINT_M)
    return pixels, shown


def correspond(first: Keyframe, second: Keyframe, T_first_second: FloatArray) -> NDArray[np.int64]:
    """Numbers of the keypoints that two keyframes share, (M, 2), by the pose of the second base in the first, (3,)."""
    pixels, shown = predict(first, second, T_first_second)
    return correspond_predicted(first.features, second.features, pixels, shown)


def correspond_predicted(
    first: ImageFeatures, second: ImageFeatures, pixels: FloatArray, shown: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Numbers of the keypoints that two images share, shape (M, 2).

    ``pixels`` (K, 2): where the second image shows keypoints of the first, some pixels off; ``shown`` (K,): whether.
    """
    none = np.empty((0, 2), np.int64)
    asked = np.flatnonzero(shown & (len(second.keypoints_px) > 0))
    if len(asked) < FEWEST_ALIKE:
        return none
    others = second.keypoints_px.astype(np.float64)
    offsets, sources = _offsets_of_alike(first, second, pixels, asked, others)
    if len(sources) < FEWEST_ALIKE:
        return none
    correction = _local_medians(pixels[sources], offsets, pixels[asked])
    own = _local_medians(pixels[sources], offsets, pixels[sources])
    if np.mean(np.hypot(*(offsets - own).T) <= CORRECT_PX) < AGREEING:
        return none
    corrected = pixels[asked] + correction
    distances, nearest = map(np.asarray, cKDTree(others).query(corrected, distance_upper_bound=SNAP_PX))
    back = np.asarray(cKDTree(corrected).query(others)[1])
    found = np.flatnonzero(np.isfinite(distances))
    found = found[back[nearest[found]] == found]
    return np.column_stack((asked[found], nearest[found]))


def revisits_in_map(frames: Sequence[Keyframe], T_map_base: FloatArray) -> list[tuple[int, int, NDArray[np.int64]]]:
    """Find what N keyframes of one map, at their estimated poses (N, 3), show again, from whatever time.

    Returns the numbers of two keyframes, and those of their keypoints that are the same points, shape (M, 2), with M at
    least ``FEWEST_SHARED``.
    """
    pairs = []
    for i, first in enumerate(frames):
        between = se2.between(T_map_base[i], T_map_base[i + 1 :])
        near = (np.hypot(*between[:, :2].T) <= FARTHEST_M) & (np.abs(between[:, 2]) <= WIDEST_RAD)
        for k in np.flatnonzero(near).tolist():
            rows = correspond(first, frames[i + 1 + k], between[k])
            if len(rows) >= FEWEST_SHARED:
                pairs.append((i, i + 1 + k, rows))
    return pairs


def _offsets_of_alike(
    first: ImageFeatures, second: ImageFeatures, pixels: FloatArray, asked: NDArray[np.int64], others: FloatArray
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Offsets, (N, 2), and numbers of the keypoints with a like code near their predicted pixel."""
    distances = hamming_matrix(first.descriptors[asked], second.descriptors).astype(np.int64)
    gaps = others[None, :] - pixels[asked, None]
    distances[np.hypot(gaps[..., 0], gaps[..., 1]) > SEARCH_PX] = LARGEST_HAMMING + 1
    best, back = np.argmin(distances, axis=1), np.argmin(distances, axis=0)
    rows = np.arange(len(asked))
    rows = rows[(distances[rows, best] <= LARGEST_HAMMING) & (back[best] == rows)]
    return gaps[rows, best[rows]], asked[rows]


def _local_medians(places: FloatArray, values: FloatArray, asked: FloatArray) -> FloatArray:
    """Medians (K, 2) of the values (N, 2) at the places (N, 2) nearest to each point (K, 2)."""
    count = min(NEIGHBOURS, len(places))
    _, rows = cKDTree(places).query(asked, k=np.arange(1, count + 1))
    return np.asarray(np.median(values[rows], axis=1))
