"""The training loop: at each step losses, gradients and an update of the weights, with a schedule of the rate."""

from collections.abc import Callable, Iterator, Mapping
from typing import Final

import torch
from torch import Tensor

from fcslam.errors import InputError
from fcslam.learning.batches import TrainingBatch
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.objective import LOSSES, TeacherBits, grid_shift, objective
from fcslam.learning.settings import TrainingSettings

CLIP_NORM: Final = 1.0
"""Gradients with a larger norm are scaled down to it, so that one odd batch does not undo many steps."""
WEIGHT_DECAY: Final = 1e-4
WARM_UP_STEPS: Final = 300
"""Longest warm-up of the learning rate; short runs use a tenth of their steps."""
LAST_RATE: Final = 1e-5
"""Learning rate at the end of training, and the lowest one."""
DECAY_SHARE: Final = 0.3
"""Share of the steps, at the end, over which the learning rate falls."""

LossesOf = Callable[[int], tuple[Tensor, dict[str, Tensor]]]
"""Gives the loss to descend at a step of the whole run, and its parts by name."""


def reduced_precision(device: torch.device) -> torch.autocast:
    """A context in which networks compute in bfloat16 where the device does so natively, and in float32 elsewhere.

    A processor without instructions for bfloat16 takes up to 18 times as long with it as with float32.
    """
    native = device.type != "cpu" or torch.cpu._is_avx512_bf16_supported()
    return torch.autocast(device.type, torch.bfloat16, enabled=native)


def create_optimizer(network: KeypointNetwork) -> torch.optim.Optimizer:
    """An optimizer without moments; ``descend`` sets its learning rate."""
    return torch.optim.AdamW(network.parameters(), weight_decay=WEIGHT_DECAY)


def get_optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The optimizer's step counts and moments, by parameter number and name."""
    states = optimizer.state_dict()["state"]
    return {f"{index}/{name}": value for index, entries in states.items() for name, value in entries.items()}


def restore_optimizer_state(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Let a new optimizer continue from the tensors of ``get_optimizer_state``.

    Raises:
        ValueError: the tensors belong to another network.
    """
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, key = name.split("/")
        state.setdefault(int(index), {})[key] = tensor
    shapes = [tuple(value.shape) for group in optimizer.param_groups for value in group["params"]]
    for number, entries in state.items():
        found = {key: tuple(value.shape) for key, value in entries.items()}
        shape = shapes[number] if 0 <= number < len(shapes) else None
        if found != {"step": (), "exp_avg": shape, "exp_avg_sq": shape}:
            raise ValueError("the optimizer's state belongs to other parameters")
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def step_losses(
    network: KeypointNetwork,
    batch: TrainingBatch,
    settings: TrainingSettings,
    step: int,
    bits: TeacherBits | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The sum to minimise at a step, and the losses in it by name.

    The network is in training mode, on the device of the batch; ``step`` counts from 0 over the whole run.
    """
    with reduced_precision(batch.images.device):
        maps = network(batch.images.contiguous(memory_format=torch.channels_last))
    shift = grid_shift(settings.encoder, settings.seed, step)
    return objective(maps, batch, LOSSES[settings.losses], step / settings.steps, shift, bits)


def descend(
    network: KeypointNetwork,
    optimizer: torch.optim.Optimizer,
    losses_of: LossesOf,
    settings: TrainingSettings,
    steps: range,
    ramp_steps: int = 0,
) -> Iterator[tuple[int, dict[str, Tensor]]]:
    """Follow the gradient of the losses in place; after each step, gives its number and its losses by name.

    ``steps`` are numbers over the whole run. The learning rate rises over the first ``ramp_steps`` of them.
    """
    for step in steps:
        total, losses = losses_of(step)
        if not torch.isfinite(total):
            raise InputError(f"training diverged at step {step}; lower the learning rate")
        ramp = min((step + 1 - steps.start) / ramp_steps, 1.0) if ramp_steps else 1.0
        for group in optimizer.param_groups:
            group["lr"] = ramp * learning_rate(settings, step)
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)
        optimizer.step()
        yield step, losses


def learning_rate(settings: TrainingSettings, step: int) -> float:
    """Learning rate of a step: a linear warm-up, a plateau, and a linear decay over the last steps.

    On the plateau it does not depend on the number of steps, so a run can be made longer.
    """
    warm = min(WARM_UP_STEPS, settings.steps // 10)
    rise = (step + 1) / max(warm, 1)
    fall = (settings.steps - step) / (DECAY_SHARE * settings.steps)
    return max(settings.learning_rate * min(rise, fall, 1.0), LAST_RATE)
