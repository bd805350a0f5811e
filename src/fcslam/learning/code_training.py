"""Training of the codes alone, on points that a robot saw again: a client's part of a federated round.

Only the layers at 1/8 of the resolution are trained. The output of the layers before them is computed once for each
image. The keypoints depend on the trained layers a little, so a loss keeps the keypoints where they were. Rehearsal
keeps the codes of what the robot does not see.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from fcslam.errors import InputError
from fcslam.features.detector import GreyImage
from fcslam.learning.batches import on_device
from fcslam.learning.code_batches import RevisitExamples, draw_rehearsal, draw_revisits, draw_views
from fcslam.learning.network import Description, KeypointNetwork, layer_names, network_from_state
from fcslam.learning.objective import REHEARSAL_WEIGHT, rehearsal_loss, revisit_objective
from fcslam.learning.training_loop import LocalTrainingPlan, LocalTrainingResult, reduced_precision, train_layers


@dataclass(slots=True)
class CodeInputs:
    """The inputs of the trained layers for a robot's images; computed again if the layers before them change."""

    _frozen: dict[str, Tensor] = field(default_factory=dict)
    _inputs: Tensor | None = None
    _seed: int | None = None

    def of(self, network: KeypointNetwork, images: Sequence[GreyImage], seed: int, device: torch.device) -> Tensor:
        """Shape (K + V, C, H/8, W/8), float16, for K images, always the same, and the V views of ``draw_views``.

        ``seed`` is that of the views.
        """
        heads = layer_names(network, (*network.body.code_layers, *network.body.point_layers))
        frozen = {name: value for name, value in network.state_dict().items() if name not in heads}
        is_same = self._frozen.keys() == frozen.keys() and all(
            torch.equal(value, self._frozen[name]) for name, value in frozen.items()
        )
        if self._inputs is None or self._seed != seed or not is_same:
            self._seed = seed
            self._frozen = {name: value.clone() for name, value in frozen.items()}
            parts, shown = [], [*images, *draw_views(images, seed)]
            for k in range(0, len(shown), 8):
                grey = np.stack(shown[k : k + 8]).astype(np.float32) / 255.0
                with torch.no_grad():
                    parts.append(network.body.code_inputs(torch.from_numpy(grey).unsqueeze(1).to(device)).half())
            self._inputs = torch.cat(parts)
        return self._inputs


def train_codes(
    start: Mapping[str, Tensor],
    revisits: RevisitExamples,
    inputs: CodeInputs,
    plan: LocalTrainingPlan,
    before: KeypointNetwork,
) -> LocalTrainingResult:
    """Train for some steps from the state ``start``, which is not changed, with the batch statistics as they are.

    The result depends on the arguments alone. ``inputs`` are kept from call to call. Keypoints, and the codes of
    distorted views, stay as the network ``before`` gives them.
    """
    settings, device = plan.settings, plan.device
    if not revisits:
        raise InputError("codes are trained on places seen again, but no place was")
    network = network_from_state(settings.encoder, start).to(device, memory_format=torch.channels_last)
    before = before.to(device)
    known = inputs.of(network, revisits.images, settings.seed, device)
    size = (revisits.images[0].shape[1], revisits.images[0].shape[0])

    def losses_of(step: int) -> tuple[Tensor, dict[str, Tensor]]:
        batch = on_device(draw_revisits(revisits, settings.seed, step), device)
        described = _described(known[batch.images], network, before)
        total, losses = revisit_objective(*described, batch)
        numbers, points = (each.to(device) for each in draw_rehearsal(size, settings.seed, step))
        described = _described(known[len(revisits.images) + numbers], network, before)
        losses["rehearsal"] = rehearsal_loss(*described, points)
        return total + REHEARSAL_WEIGHT * losses["rehearsal"], losses

    return train_layers(network, network.body.code_layers, losses_of, plan)


def _described(inputs: Tensor, network: KeypointNetwork, before: KeypointNetwork) -> tuple[Description, Description]:
    """Descriptions by both networks of inputs of the trained layers, shape (B, C, H/8, W/8)."""
    given = inputs.float().contiguous(memory_format=torch.channels_last)
    with reduced_precision(given.device):
        described = network.body.describe(given)
        with torch.no_grad():
            return described, before.body.describe(given)
