"""Training pairs: two views of one image under random homographies and light, and which points belong together."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.features.detector import GreyImage
from fcslam.learning.labels import Labels, Teacher
from fcslam.learning.warps import (
    random_change,
    random_shift,
    random_view,
    relight,
    visible_mask,
    warp_image,
    well_inside,
)
from fcslam.metrics.framing import Size
from fcslam.metrics.homography import Mask, inverse, warp
from fcslam.records import FloatArray

BORDER_PX: Final = 4
"""Points so close to the rim of a view do not count."""
GRID_SHARE: Final = 0.35
"""Points of a pair that are drawn anywhere instead of at keypoints: every pixel has to have a code."""

SHIFT_SHARE: Final = 0.3
"""Pairs whose views differ by a shift by whole pixels, and in light."""


@dataclass(frozen=True, slots=True)
class TrainingExample:
    """An image with what is known of it."""

    image: GreyImage
    labels: Labels
    teacher: Teacher | None = None


@dataclass(frozen=True, slots=True)
class AugmentedView:
    """One side of a pair."""

    image: NDArray[np.float32]
    """Shape (H, W), in [0, 1]."""
    targets: NDArray[np.float32]
    """Shape (H, W): how much of a keypoint is at each pixel."""
    valid: Mask
    """Shape (H, W): whether a pixel shows the image."""
    points: NDArray[np.float32]
    """Shape (N, 2): where this view sees the points of the pair [px]."""
    taught: NDArray[np.float32]
    """Shape (M, 2): where it sees the teacher's points [px]."""


@dataclass(frozen=True, slots=True)
class ViewPair:
    """Two views of an image."""

    views: tuple[AugmentedView, AugmentedView]
    valid: Mask
    """Shape (N,): whether both views see a point."""
    taught_valid: Mask
    """Shape (M,): whether both views see a point of the teacher."""
    taught: NDArray[np.float32]
    """Shape (M, D): the teacher's descriptors; D is 0 without one."""
    homography: FloatArray
    """Shape (3, 3): takes pixels of the first view to pixels of the second."""


def draw_pair(example: TrainingExample, size: Size, points: int, taught: int, rng: np.random.Generator) -> ViewPair:
    """A pair of views of this size with ``points`` points, ``taught`` of the teacher's among its own."""
    image = example.image
    window = random_view(image, size, rng)
    homographies = [random_change(size, rng) @ window for _ in range(2)]
    if rng.random() < SHIFT_SHARE:
        homographies[1] = random_shift(rng) @ homographies[0]
    chosen = _choose(example, homographies, size, points, rng)
    told, descriptors = _choose_taught(example.teacher, homographies, size, taught, rng)
    views = [_view(example, homography, size, chosen, told, rng) for homography in homographies]
    return ViewPair(
        (views[0], views[1]),
        _in_both(views[0].points, views[1].points, size) & well_inside(chosen, (image.shape[1], image.shape[0]), 0.0),
        _in_both(views[0].taught, views[1].taught, size),
        descriptors,
        homographies[1] @ inverse(homographies[0]),
    )


def splat_points(points: FloatArray, weight: NDArray[np.float32], size: Size) -> NDArray[np.float32]:
    """Weights of points (N, 2) shared out among the four pixels around each, shape (height, width)."""
    padded = np.zeros((size[1] + 1, size[0] + 1), np.float32)
    here = well_inside(points, size, 0.0)
    low = np.floor(points[here]).astype(np.int64)
    part = (points[here] - low).astype(np.float32)
    for row in (0, 1):
        for column in (0, 1):
            share = np.abs(1 - column - part[:, 0]) * np.abs(1 - row - part[:, 1])
            np.add.at(padded, (low[:, 1] + row, low[:, 0] + column), weight[here] * share)
    return padded[:-1, :-1]


def _view(
    example: TrainingExample,
    homography: FloatArray,
    size: Size,
    chosen: FloatArray,
    told: FloatArray,
    rng: np.random.Generator,
) -> AugmentedView:
    keypoints = warp(homography, example.labels.keypoints.astype(np.float64))
    return AugmentedView(
        relight(warp_image(example.image, homography, size), rng),
        splat_points(keypoints, example.labels.quality, size),
        visible_mask((example.image.shape[0], example.image.shape[1]), homography, size),
        warp(homography, chosen).astype(np.float32),
        warp(homography, told).astype(np.float32),
    )


def _choose(
    example: TrainingExample, homographies: list[FloatArray], size: Size, count: int, rng: np.random.Generator
) -> FloatArray:
    """Points (count, 2) of the image: keypoints that both views see, the better the likelier, and others anywhere."""
    keypoints = example.labels.keypoints.astype(np.float64)
    usable = np.flatnonzero(_in_both(warp(homographies[0], keypoints), warp(homographies[1], keypoints), size))
    wanted = min(len(usable), round((1.0 - GRID_SHARE) * count))
    # Gumbel's trick: the largest of noise plus log weight are a draw without replacement.
    appeal = np.log(example.labels.quality[usable]) + rng.gumbel(size=len(usable))
    best = usable[np.argsort(-appeal)[:wanted]]
    anywhere = rng.uniform(0.0, 1.0, (count - wanted, 2)) * [size[0] - 1.0, size[1] - 1.0]
    return np.concatenate((keypoints[best], warp(inverse(homographies[0]), anywhere)))


def _choose_taught(
    teacher: Teacher | None, homographies: list[FloatArray], size: Size, count: int, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.float32]]:
    if teacher is None:
        return np.zeros((count, 2)), np.zeros((count, 0), np.float32)
    keypoints = teacher.keypoints.astype(np.float64)
    usable = np.flatnonzero(_in_both(warp(homographies[0], keypoints), warp(homographies[1], keypoints), size))
    best = rng.permutation(usable)[:count]
    missing = count - len(best)
    places = np.concatenate((keypoints[best], np.full((missing, 2), np.nan)))
    descriptors = np.concatenate((teacher.descriptors[best], np.zeros((missing, teacher.descriptors.shape[1]))))
    return places, descriptors.astype(np.float32)


def _in_both(first: FloatArray | NDArray[np.float32], second: FloatArray | NDArray[np.float32], size: Size) -> Mask:
    sides = (well_inside(side.astype(np.float64), size, BORDER_PX) for side in (first, second))
    return np.logical_and(*sides)
