"""Training of the keypoints alone, on which of them other views of a robot's own map show again.

Keypoints that are found again become more probable than with the initial network, and those that never are, less. All
other pixels keep their probability. The layers of the codes stay as they are.
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
    continued_optimiser,
    freeze_all_but,
    layer_names,
    local_rate,
    local_result,
    network_from_state,
    proximal_term,
)
from fcslam.learning.losses import detector_loss
from fcslam.learning.network import cell_probabilities
from fcslam.learning.objective import grid_shift, shift_grid
from fcslam.learning.revisit_batches import RevisitExamples, VotedImage, draw_voted
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.training_step import descend
from fcslam.records import FloatArray

MOST_GAIN: Final = 20.0
"""Largest factor by which a keypoint that is found again becomes more probable; it never exceeds 1."""
LOSS: Final = 0.05
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
    freeze_all_but(network, layer_names(network, network.point_layers))
    proximal = proximal_term(network, plan)
    optimiser = continued_optimiser(network, optimiser_state)
    sums = {"found again": 0.0}
    for done in range(1, plan.steps + 1):
        step = plan.first_step + done - 1
        for group in optimiser.param_groups:
            group["lr"] = local_rate(settings, step, done, optimiser_state is None)
        voted = draw_voted(revisits, settings.seed, step)
        grey = np.stack([revisits.images[each.image] for each in voted]).astype(np.float32) / 255.0
        images = torch.from_numpy(grey).unsqueeze(1).to(device).contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16):
            logits = network(images).point_logits
            with torch.no_grad():
                initial = before(images).point_logits
        targets = torch.from_numpy(voted_targets(_probabilities(initial), voted)).to(device)
        valid = torch.ones_like(targets, dtype=torch.bool)
        shift = grid_shift(settings.encoder, settings.seed, step)
        loss = detector_loss(*shift_grid((logits.float(), targets, valid), shift))
        total = loss if proximal is None else loss + proximal.loss(network)
        descend(network, optimiser, total, step)
        sums["found again"] += float(loss.detach())
        on_step(done)
    return local_result(network, optimiser, sums, plan)


def voted_targets(probabilities: FloatArray, voted: Sequence[VotedImage]) -> FloatArray:
    """The probabilities (B, H, W) that the network should give, from the initial ones and the votes on B images.

    A keypoint is what lies within a pixel of it.
    """
    targets = probabilities.copy()
    for target, image in zip(targets, voted, strict=True):
        for (x, y), is_found in zip(np.rint(image.points).astype(int).tolist(), image.is_found.tolist(), strict=True):
            window = target[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            window *= np.clip(1.0 / max(window.sum(), 1e-9), 1.0, MOST_GAIN) if is_found else LOSS
    return targets


def _probabilities(logits: Tensor) -> FloatArray:
    return np.asarray(cell_probabilities(logits.float()).cpu())
