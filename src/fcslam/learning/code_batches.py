"""Batches of the training of codes: points that a robot saw again, and distorted views of its own images.

Rehearsal is distillation on these views: there the codes stay those of the initial network. A robot that trains on one
building forgets others. Random homographies and light carry its images far from what it sees. There the network that
training started from is the teacher (Li and Hoiem, "Learning without forgetting", 2016). No other images are needed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fcslam.features.detector import GreyImage
from fcslam.learning.homography import BORDER_PX, Size
from fcslam.learning.labels import Points
from fcslam.learning.warps import random_change, relight, warp_image
from fcslam.records import FloatArray

STEP_IMAGES: Final = 4
"""Images of revisits in a step, and views for rehearsal."""
STEP_POINTS: Final = 100
"""Most points of a pair of revisits in a step, and points of a view, anywhere in it."""
VIEWS: Final = 128
"""Views that are drawn once for a robot."""


@dataclass(frozen=True, slots=True, eq=False)
class RevisitPair:
    """Two images of one place and the points that both show."""

    images: tuple[int, int]
    """Their numbers in ``RevisitExamples``."""
    points: tuple[Points, Points]
    """Shape (M, 2) each, pixels."""
    positions: FloatArray
    """Positions of the points in the robot's map, shape (M, 3), metres; NaN where unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class RevisitExamples:
    """Training data of a robot: its own revisits."""

    images: Sequence[GreyImage] = field(default=())
    """All of one size."""
    pairs: Sequence[RevisitPair] = field(default=())

    def __bool__(self) -> bool:
        return bool(self.pairs)


class RevisitBatch(NamedTuple):
    """B pairs of views."""

    images: Tensor
    """Numbers of the images, shape (2B,): B first views, then B second views."""
    points: Tensor
    """Shape (2B, N, 2) [px]: in the first views, then in the second ones."""
    positions: Tensor
    """Shape (B, N, 3), metres; NaN where unknown."""
    valid: Tensor
    """Shape (B, N), bool."""


def draw_revisits(examples: RevisitExamples, seed: int, step: int) -> RevisitBatch:
    """The pairs of a step, with ``STEP_IMAGES`` images."""
    rng = np.random.default_rng([seed, step, STEP_IMAGES])
    pairs = [examples.pairs[k] for k in rng.integers(len(examples.pairs), size=STEP_IMAGES // 2)]
    firsts, seconds, positions, valid = [], [], [], []
    for pair in pairs:
        chosen = rng.permutation(len(pair.positions))[:STEP_POINTS]
        firsts.append(_padded(pair.points[0][chosen]))
        seconds.append(_padded(pair.points[1][chosen]))
        positions.append(_padded(pair.positions[chosen]))
        valid.append(np.arange(STEP_POINTS) < len(chosen))
    return RevisitBatch(
        torch.tensor([pair.images[view] for view in (0, 1) for pair in pairs]),
        torch.from_numpy(np.stack(firsts + seconds)),
        torch.from_numpy(np.stack(positions)),
        torch.from_numpy(np.stack(valid)),
    )


def _padded(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    """Rows (M, D), M at most ``STEP_POINTS``, with zeros below."""
    padded = np.zeros((STEP_POINTS, rows.shape[1]), np.float32)
    padded[: len(rows)] = rows
    return padded


def draw_views(images: Sequence[GreyImage], seed: int) -> list[GreyImage]:
    """``VIEWS`` views of the images' size; none without images."""
    if not images:
        return []
    rng = np.random.default_rng([seed, VIEWS])
    views = []
    for number in rng.integers(len(images), size=VIEWS):
        image = images[number]
        size = (image.shape[1], image.shape[0])
        view = relight(warp_image(image, random_change(size, rng), size), rng)
        views.append(np.rint(255.0 * view).astype(np.uint8))
    return views


def draw_rehearsal(size: Size, seed: int, step: int) -> tuple[Tensor, Tensor]:
    """Numbers (R,) of the views of a step, and points (R, N, 2) [px] in them; ``size``: their width and height."""
    rng = np.random.default_rng([seed, step, STEP_IMAGES, VIEWS])
    points = rng.uniform(BORDER_PX, np.array(size) - 1.0 - BORDER_PX, (STEP_IMAGES, STEP_POINTS, 2))
    return torch.from_numpy(rng.integers(VIEWS, size=STEP_IMAGES)), torch.from_numpy(points.astype(np.float32))
