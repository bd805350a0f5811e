"""Training pairs: two views of one image under random homographies and light, and which points belong together."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.features.detector import GreyImage
from fcslam.learning.homography import BORDER_PX, Mask, Size, inverse, warp
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
from fcslam.records import FloatArray

GRID_SHARE: Final = 0.35
"""Share of a pair's points that are drawn anywhere and not at keypoints: every pixel needs a code."""
SHIFT_SHARE: Final = 0.3
"""Share of the pairs whose views differ by a shift of whole pixels, and in light."""


@dataclass(frozen=True, slots=True)
class TrainingExample:
    """An image with its labels."""

    image: GreyImage
    labels: Labels
    teacher: Teacher | None = None


@dataclass(frozen=True, slots=True)
class AugmentedView:
    """One side of a pair."""

    image: NDArray[np.float32]
    """Shape (H, W), in [0, 1]."""
    targets: NDArray[np.float32]
    """Shape (H, W): weight of a keypoint at each pixel, in [0, 1]."""
    valid: Mask
    """Shape (H, W): whether a pixel shows the image."""
    points: NDArray[np.float32]
    """Shape (N, 2): points of the pair in this view [px]."""
    teacher_points: NDArray[np.float32]
    """Shape (M, 2): points of the teacher in this view [px]."""


@dataclass(frozen=True, slots=True)
class ViewPair:
    """Two views of an image."""

    views: tuple[AugmentedView, AugmentedView]
    valid: Mask
    """Shape (N,): whether both views show a point."""
    teacher_valid: Mask
    """Shape (M,): whether both views show a point of the teacher."""
    teacher_descriptors: NDArray[np.float32]
    """Shape (M, D); D is 0 without a teacher."""
    homography: FloatArray
    """Shape (3, 3): maps pixels of the first view to pixels of the second."""


def draw_pair(
    example: TrainingExample, size: Size, points: int, teacher_points: int, rng: np.random.Generator
) -> ViewPair:
    """Draw a pair of views.

    ``size``: width and height of a view [px]; ``points`` and ``teacher_points``: their numbers N and M.
    """
    image = example.image
    window = random_view(image, size, rng)
    homographies = [random_change(size, rng) @ window for _ in range(2)]
    if rng.random() < SHIFT_SHARE:
        homographies[1] = random_shift(rng) @ homographies[0]
    chosen = _choose(example, homographies, size, points, rng)
    taught, descriptors = _choose_teacher_points(example.teacher, homographies, size, teacher_points, rng)
    views = [_view(example, homography, size, chosen, taught, rng) for homography in homographies]
    return ViewPair(
        (views[0], views[1]),
        _in_both(views[0].points, views[1].points, size) & well_inside(chosen, (image.shape[1], image.shape[0]), 0.0),
        _in_both(views[0].teacher_points, views[1].teacher_points, size),
        descriptors,
        homographies[1] @ inverse(homographies[0]),
    )


def splat_points(points: FloatArray, weight: NDArray[np.float32], size: Size) -> NDArray[np.float32]:
    """Distribute the weights (N,) of points (N, 2) [px] over the four pixels around each, shape (height, width)."""
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
    taught: FloatArray,
    rng: np.random.Generator,
) -> AugmentedView:
    keypoints = warp(homography, example.labels.keypoints.astype(np.float64))
    return AugmentedView(
        relight(warp_image(example.image, homography, size), rng),
        splat_points(keypoints, example.labels.quality, size),
        visible_mask((example.image.shape[0], example.image.shape[1]), homography, size),
        warp(homography, chosen).astype(np.float32),
        warp(homography, taught).astype(np.float32),
    )


def _choose(
    example: TrainingExample, homographies: list[FloatArray], size: Size, count: int, rng: np.random.Generator
) -> FloatArray:
    """Points (count, 2) of the image [px]: keypoints in both views, drawn by their quality, and others anywhere."""
    keypoints = example.labels.keypoints.astype(np.float64)
    usable = np.flatnonzero(_in_both(warp(homographies[0], keypoints), warp(homographies[1], keypoints), size))
    wanted = min(len(usable), round((1.0 - GRID_SHARE) * count))
    # Gumbel's trick: the largest sums of log weight and noise are a weighted draw without replacement.
    appeal = np.log(example.labels.quality[usable]) + rng.gumbel(size=len(usable))
    best = usable[np.argsort(-appeal)[:wanted]]
    anywhere = rng.uniform(0.0, 1.0, (count - wanted, 2)) * [size[0] - 1.0, size[1] - 1.0]
    return np.concatenate((keypoints[best], warp(inverse(homographies[0]), anywhere)))


def _choose_teacher_points(
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
