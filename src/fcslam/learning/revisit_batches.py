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
from fcslam.learning.revisits import Sightings
from fcslam.records import FloatArray

VIEWS: Final = 4
"""Images in a batch."""
MOST_POINTS: Final = 100
"""Most points of a pair in a batch."""
VOTED_VIEWS: Final = 2
"""Images in a step that trains keypoints."""
FEWEST_VOTES: Final = 3
"""Fewest views that show a keypoint for a vote on it."""
FOUND_SHARE: Final = 0.5
"""A keypoint found again in at least this share of them is a positive."""
LOST_SHARE: Final = 0.25
"""One found in at most this share is a negative."""
FEWEST_VOTED: Final = 10
"""Fewest such keypoints of an image."""


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
class VotedImage:
    """An image with keypoints of which other views tell whether they are found again."""

    image: int
    """Its number in ``RevisitExamples``."""
    points: Points
    """Shape (M, 2), pixels."""
    is_found: NDArray[np.bool_]
    """Shape (M,). True: at least half of the views that show the point find it again. False: at most a quarter do."""


@dataclass(frozen=True, slots=True, eq=False)
class RevisitExamples:
    """Training data of a robot: its own revisits."""

    images: Sequence[GreyImage] = field(default=())
    """All of one size."""
    pairs: Sequence[RevisitPair] = field(default=())
    voted: Sequence[VotedImage] = field(default=())

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


def vote(image: int, points: Points, sightings: Sightings) -> VotedImage | None:
    """The keypoints (K, 2) of an image on which its sightings agree; None if these are few."""
    share = sightings.found / np.maximum(sightings.shown, 1)
    is_found, is_lost = share >= FOUND_SHARE, share <= LOST_SHARE
    rows = np.flatnonzero((sightings.shown >= FEWEST_VOTES) & (is_found | is_lost))
    return VotedImage(image, points[rows], is_found[rows]) if len(rows) >= FEWEST_VOTED else None


def draw_voted(examples: RevisitExamples, seed: int, step: int) -> list[VotedImage]:
    """The images of a step that trains keypoints; none without any."""
    rng = np.random.default_rng([seed, step, VOTED_VIEWS, FEWEST_VOTES])
    return [examples.voted[k] for k in rng.integers(len(examples.voted), size=VOTED_VIEWS)] if examples.voted else []


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
