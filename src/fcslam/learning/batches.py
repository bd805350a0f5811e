"""Batches of view pairs, prepared ahead in threads. A batch depends on the seed and its step alone."""

from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from fcslam.learning.pairs import TrainingExample, ViewPair, draw_pair
from fcslam.learning.settings import TrainingSettings

POINTS = 320
"""Points of a pair whose descriptors are compared."""
TEACHER_POINTS = 192
"""Most points of the teacher that are used in a pair."""


Tensors = TypeVar("Tensors", bound=tuple[Tensor, ...])


def on_device(tensors: Tensors, device: torch.device) -> Tensors:
    """A named tuple of tensors on a device."""
    return type(tensors)(*(each.to(device, non_blocking=True) for each in tensors))


class TrainingBatch(NamedTuple):
    """B pairs; the first B images are first views, the others second views."""

    images: Tensor
    """Shape (2B, 1, H, W), grey in [0, 1]."""
    targets: Tensor
    """Shape (2B, H, W): weight of a keypoint at each pixel, in [0, 1]."""
    seen: Tensor
    """Shape (2B, H, W), bool: whether a pixel shows the image."""
    points: Tensor
    """Shape (2B, N, 2) [px]; 0 where not valid."""
    valid: Tensor
    """Shape (B, N), bool: whether both views show a point."""
    teacher_points: Tensor
    """Shape (2B, M, 2) [px]; 0 where not valid."""
    teacher_valid: Tensor
    """Shape (B, M), bool: whether both views show a point of the teacher."""
    teacher_descriptors: Tensor
    """Shape (B, M, D); D is 0 without a teacher."""
    homographies: Tensor
    """Shape (B, 3, 3): map pixels of the first view to pixels of the second."""


def draw_batch(examples: Sequence[TrainingExample], settings: TrainingSettings, step: int) -> TrainingBatch:
    """The batch of this step."""
    pairs = []
    for index in range(settings.pairs):
        rng = np.random.default_rng([settings.seed, step, index])
        example = examples[int(rng.integers(len(examples)))]
        pairs.append(draw_pair(example, (settings.side_px, settings.side_px), POINTS, TEACHER_POINTS, rng))
    return collate(pairs)


def collate(pairs: Sequence[ViewPair]) -> TrainingBatch:
    """Stack pairs into a batch."""
    views = [pair.views[side] for side in (0, 1) for pair in pairs]

    def stack(arrays: Sequence[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.nan_to_num(np.stack(arrays)))

    return TrainingBatch(
        images=stack([view.image for view in views]).unsqueeze(1),
        targets=stack([view.targets for view in views]),
        seen=stack([view.valid for view in views]),
        points=stack([view.points for view in views]),
        valid=stack([pair.valid for pair in pairs]),
        teacher_points=stack([view.teacher_points for view in views]),
        teacher_valid=stack([pair.teacher_valid for pair in pairs]),
        teacher_descriptors=stack([pair.teacher_descriptors for pair in pairs]),
        homographies=stack([pair.homography.astype(np.float32) for pair in pairs]),
    )


def batch_stream(
    examples: Sequence[TrainingExample], settings: TrainingSettings, steps: range, ahead: int, threads: int
) -> Generator[TrainingBatch, None, None]:
    """The batches of these steps, in order; ``threads`` threads prepare up to ``ahead`` of them."""
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque(pool.submit(draw_batch, examples, settings, step) for step in steps[:ahead])
        try:
            for step in steps:
                yield waiting.popleft().result()
                if step + ahead < steps.stop:
                    waiting.append(pool.submit(draw_batch, examples, settings, step + ahead))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
