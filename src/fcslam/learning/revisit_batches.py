"""Batches of points that a robot saw again, in pairs of its images."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fcslam.features.detector import GreyImage
from fcslam.learning.labels import Points
from fcslam.records import FloatArray

VIEWS: Final = 4
"""Images in a batch."""
MOST_POINTS: Final = 100
"""Most points of a pair in a batch."""


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


@dataclass(frozen=True, slots=True, eq=False)
class RevisitBatch:
    """B pairs of views."""

    images: Tensor
    """Numbers of the images, shape (2B,): B first views, then B second views."""
    points: Tensor
    """Shape (2B, N, 2) [px]: in the first views, then in the second ones."""
    positions: Tensor
    """Shape (B, N, 3), metres; NaN where unknown."""
    valid: Tensor
    """Shape (B, N), bool."""

    def to(self, device: torch.device) -> "RevisitBatch":
        """The batch on another device."""
        return RevisitBatch(**{each.name: getattr(self, each.name).to(device) for each in fields(self)})


def draw_revisits(examples: RevisitExamples, seed: int, step: int) -> RevisitBatch:
    """The pairs of a step, with ``VIEWS`` images."""
    rng = np.random.default_rng([seed, step, VIEWS])
    pairs = [examples.pairs[k] for k in rng.integers(len(examples.pairs), size=VIEWS // 2)]
    firsts, seconds, positions, valid = [], [], [], []
    for pair in pairs:
        chosen = _some(len(pair.positions), rng)
        firsts.append(_padded(pair.points[0][chosen]))
        seconds.append(_padded(pair.points[1][chosen]))
        positions.append(_padded(pair.positions[chosen]))
        valid.append(np.arange(MOST_POINTS) < len(chosen))
    return RevisitBatch(
        torch.tensor([pair.images[view] for view in (0, 1) for pair in pairs]),
        torch.from_numpy(np.stack(firsts + seconds)),
        torch.from_numpy(np.stack(positions)),
        torch.from_numpy(np.stack(valid)),
    )


def _some(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    return rng.permutation(count)[:MOST_POINTS]


def _padded(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    """Rows (M, D), M at most ``MOST_POINTS``, with zeros below."""
    padded = np.zeros((MOST_POINTS, rows.shape[1]), np.float32)
    padded[: len(rows)] = rows
    return padded
