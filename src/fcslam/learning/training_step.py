"""One step of training: forward, losses, backward, update."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from fcslam.errors import TrainingError
from fcslam.learning.batches import TrainingBatch
from fcslam.learning.losses import distillation_loss
from fcslam.learning.network import KeypointNetwork, Maps, sample_codes
from fcslam.learning.objective import TeacherBits, grid_shift, objective
from fcslam.learning.settings import TrainingSettings

CLIP_NORM: Final = 1.0
WEIGHT_DECAY: Final = 1e-4
WARM_UP_STEPS: Final = 300
LAST_RATE: Final = 1e-5
DECAY_SHARE: Final = 0.3


@dataclass(frozen=True, slots=True)
class ProximalTerm:
    """A spring back to given weights: strength / 2 times the squared distance is added to what is minimised."""

    strength: float
    weights: Mapping[str, Tensor]
    """By the parameters' names."""

    def energy(self, network: KeypointNetwork) -> Tensor:
        """What is added now."""
        terms = [(value - self.weights[name]).square().sum() for name, value in network.named_parameters()]
        return 0.5 * self.strength * torch.stack(terms).sum()


@dataclass(frozen=True, slots=True)
class LegacyDetector:
    """A former network whose codes are still in use: points should get codes that match those it gives them."""

    strength: float
    network: KeypointNetwork
    """In evaluation mode, on the device of the one that is trained."""

    def loss(self, maps: Maps, batch: TrainingBatch) -> Tensor:
        """Cross entropy of the bits at the batch's points against the former network's bits there."""
        with torch.no_grad(), torch.autocast(batch.images.device.type, torch.bfloat16):
            before = self.network(batch.images.contiguous(memory_format=torch.channels_last))
        wanted = torch.sigmoid(2.0 * sample_codes(before.code_logits.float(), batch.points))
        now = 2.0 * sample_codes(maps.code_logits.float(), batch.points)
        return distillation_loss(now, wanted, batch.valid.repeat(2, 1))


def create_optimiser(network: KeypointNetwork) -> torch.optim.Optimizer:
    """An optimiser without a memory yet; ``training_step`` sets its rate."""
    return torch.optim.AdamW(network.parameters(), weight_decay=WEIGHT_DECAY)


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """What an optimiser has learnt of gradients, by the parameters' numbers."""
    states = optimiser.state_dict()["state"]
    return {f"{index}/{name}": value for index, entries in states.items() for name, value in entries.items()}


def restore_optimiser_state(optimiser: torch.optim.Optimizer, moments: Mapping[str, Tensor]) -> None:
    """Let a new optimiser go on with what another one had learnt.

    Raises:
        ValueError: they are of another network.
    """
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in moments.items():
        index, key = name.split("/")
        state.setdefault(int(index), {})[key] = tensor
    shapes = [tuple(value.shape) for group in optimiser.param_groups for value in group["params"]]
    for number, entries in state.items():
        found = {key: tuple(value.shape) for key, value in entries.items()}
        shape = shapes[number] if 0 <= number < len(shapes) else None
        if found != {"step": (), "exp_avg": shape, "exp_avg_sq": shape}:
            raise ValueError("an optimiser's memory of other parameters")
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def training_step(
    network: KeypointNetwork,
    optimiser: torch.optim.Optimizer,
    batch: TrainingBatch,
    settings: TrainingSettings,
    step: int,
    rate: float,
    bits: TeacherBits | None = None,
    pull: ProximalTerm | None = None,
    former: LegacyDetector | None = None,
) -> dict[str, Tensor]:
    """One step in place, with batch, network and optimiser on one device; returns the losses by name.

    Raises:
        TrainingError: the losses are no longer finite; nothing was changed in this step.
    """
    for group in optimiser.param_groups:
        group["lr"] = rate
    with torch.autocast(batch.images.device.type, torch.bfloat16):
        maps = network(batch.images.contiguous(memory_format=torch.channels_last))
    shift = grid_shift(settings.encoder, settings.seed, step)
    total, parts = objective(maps, batch, settings.loss, step / settings.steps, shift, bits)
    if pull is not None:
        total = total + pull.energy(network)
    if former is not None:
        parts["former"] = former.loss(maps, batch)
        total = total + former.strength * parts["former"]
    if not torch.isfinite(total):
        raise TrainingError(f"training diverged at step {step}; lower the learning rate")
    optimiser.zero_grad(set_to_none=True)
    total.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)
    optimiser.step()
    return {name: part.detach() for name, part in parts.items()}


def learning_rate(settings: TrainingSettings, step: int) -> float:
    """Linear warm-up, a plateau, and a straight way down over the last part.

    On the plateau it does not depend on how many steps there will be, so a run may be made longer.
    """
    warm = min(WARM_UP_STEPS, settings.steps // 10)
    rise = (step + 1) / max(warm, 1)
    fall = (settings.steps - step) / (DECAY_SHARE * settings.steps)
    return max(settings.learning_rate * min(rise, fall, 1.0), LAST_RATE)
