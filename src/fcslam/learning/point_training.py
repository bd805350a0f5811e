"""Training of the keypoints alone, by votes: whether other views of the robot's own map find a keypoint again.

Keypoints that most views find become more probable than with the initial network, and those that hardly any finds,
less. All other pixels keep their probability. The layers of the codes stay as they are.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor

from fcslam.errors import TrainingError
from fcslam.learning.local_training import (
    LocalTrainingPlan,
    LocalTrainingResult,
    network_from_state,
    train_layers,
)
from fcslam.learning.losses import detector_loss
from fcslam.learning.network import cell_probabilities
from fcslam.learning.objective import grid_shift, shift_grid
from fcslam.learning.revisit_batches import RevisitExamples, VotedImage, draw_voted
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.training_step import reduced_precision
from fcslam.records import FloatArray

MOST_GAIN: Final = 20.0
"""Largest factor by which a keypoint that is found again becomes more probable; it never exceeds 1."""
LOST_FACTOR: Final = 0.05
"""Factor by which one that is not becomes less probable."""


def train_points(
    start: Mapping[str, Tensor],
    revisits: RevisitExamples,
    settings: TrainingSettings,
    plan: LocalTrainingPlan,
    device: torch.device,
    on_step: Callable[[int], None] = lambda _steps: None,
    legacy: Mapping[str, Tensor] | None = None,
    optimiser_state: Mapping[str, Tensor] | None = None,
) -> LocalTrainingResult:
    """Train for some steps, with the batch statistics as they are. The result depends on the arguments alone.

    Args:
        start: state of a network, which is not changed.
        revisits: with keypoints that were voted on.
        settings: of the whole run; the learning rate falls towards the end of its steps.
        plan: which steps are done, and how.
        device: to train on.
        on_step: called with the number of steps done.
        legacy: state of the network whose probabilities count as the initial ones; None for ``start``.
        optimiser_state: result of an earlier local training, to continue it.

    Raises:
        TrainingError: no keypoint was voted on; ``start``, ``legacy`` or ``optimiser_state`` does not fit the network,
            or training diverged.
    """
    if not revisits.voted:
        raise TrainingError(
            "keypoints are trained on what other views show again, and there is none; set trained to codes"
        )
    network = network_from_state(settings.encoder, start).to(device, memory_format=torch.channels_last)
    before = network_from_state(settings.encoder, start if legacy is None else legacy).to(device)

    def losses_of(step: int) -> tuple[Tensor, dict[str, Tensor]]:
        voted = draw_voted(revisits, settings.seed, step)
        grey = np.stack([revisits.images[each.image] for each in voted]).astype(np.float32) / 255.0
        images = torch.from_numpy(grey).unsqueeze(1).to(device).contiguous(memory_format=torch.channels_last)
        with reduced_precision(device):
            logits = network(images).point_logits
            with torch.no_grad():
                initial = before(images).point_logits
        shift = grid_shift(settings.encoder, settings.seed, step)
        logits, initial = shift_grid((logits.float(), initial.float()), shift)
        wanted = voted_targets(np.asarray(cell_probabilities(initial).cpu()), voted, shift)
        loss = detector_loss(logits, torch.from_numpy(wanted).to(device), torch.ones_like(logits, dtype=torch.bool))
        return loss, {"votes": loss}

    return train_layers(network, network.point_layers, losses_of, settings, plan, on_step, optimiser_state)


def voted_targets(probabilities: FloatArray, voted: Sequence[VotedImage], shift: tuple[int, int]) -> FloatArray:
    """The probabilities (B, H, W) that the network should give, from the initial ones and the votes on B images.

    A keypoint is what lies within a pixel of it. The maps begin ``shift`` rows and columns into the images.
    """
    targets = probabilities.copy()
    height, width = targets.shape[1:]
    for target, image in zip(targets, voted, strict=True):
        pixels = np.rint(image.points).astype(int) - shift[::-1]
        for (x, y), is_found in zip(pixels.tolist(), image.is_found.tolist(), strict=True):
            if not (0 <= x < width and 0 <= y < height):
                continue
            window = target[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            window *= np.clip(1.0 / max(window.sum(), 1e-9), 1.0, MOST_GAIN) if is_found else LOST_FACTOR
    return targets
