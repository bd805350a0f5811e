"""Distillation on distorted views of a robot's own images: there the codes stay those of the initial network.

A robot that trains on one building forgets others. Random homographies and light carry its images far from what it
sees. There the network that training started from is the teacher (Li and Hoiem, "Learning without forgetting", 2016).
No other images are needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from fcslam.features.detector import GreyImage
from fcslam.learning.warps import random_change, relight, warp_image
from fcslam.metrics.framing import Size

VIEWS: Final = 128
"""Views that are drawn once for a robot."""
VIEWS_A_STEP: Final = 4
POINTS: Final = 100
"""Points of a view in a step, anywhere in it."""
_BORDER_PX: Final = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class RehearsalBatch:
    """The views of one step."""

    numbers: Tensor
    """Numbers of R views, shape (R,)."""
    points: Tensor
    """Shape (R, N, 2), pixels."""

    def to(self, device: torch.device) -> "RehearsalBatch":
        """The batch on another device."""
        return RehearsalBatch(self.numbers.to(device), self.points.to(device))


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


def draw_rehearsal(size: Size, seed: int, step: int) -> RehearsalBatch:
    """The batch of a step, of views of this width and height."""
    rng = np.random.default_rng([seed, step, VIEWS_A_STEP, VIEWS])
    points = rng.uniform(_BORDER_PX, np.array(size) - 1.0 - _BORDER_PX, (VIEWS_A_STEP, POINTS, 2))
    return RehearsalBatch(
        torch.from_numpy(rng.integers(VIEWS, size=VIEWS_A_STEP)), torch.from_numpy(points.astype(np.float32))
    )
