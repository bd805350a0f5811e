"""The training loop: at each step losses, gradients and an update of the weights, with a schedule of the rate.

A client's part of a federated round is some steps of it, from given weights (``local_training``).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Final

import torch
from torch import Tensor, nn

from fcslam.errors import InputError
from fcslam.learning.batches import TrainingBatch, batch_stream, on_device
from fcslam.learning.network import KeypointNetwork, layer_names, network_from_state
from fcslam.learning.objective import LOSSES, TeacherBits, grid_shift, objective
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings

CLIP_NORM: Final = 1.0
"""Gradients with a larger norm are scaled down to it, so that one odd batch does not undo many steps."""
WEIGHT_DECAY: Final = 1e-4
WARM_UP_STEPS: Final = 300
"""Longest warm-up of the learning rate; short runs use a tenth of their steps."""
LAST_RATE: Final = 1e-5
"""Learning rate at the end of training, and the lowest one."""
RAMP_STEPS: Final = 10
"""Steps over which the learning rate rises of a new optimizer: without moments, Adam only follows gradients' signs."""
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


@dataclass(frozen=True, slots=True)
class LocalTrainingPlan:
    """The steps of the whole run that are done now, and how."""

    settings: TrainingSettings
    """Settings of the whole run; the learning rate falls towards the end of its steps."""
    first_step: int
    """Counted from 0 over the whole run."""
    steps: int
    optimizer_state: Mapping[str, Tensor] | None = None
    """Result of an earlier local training, which is continued."""
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    on_step: Callable[[int], None] = lambda _steps: None
    """Called with the number of steps done."""

    @property
    def numbers(self) -> range:
        """Numbers of the steps, over the whole run."""
        return range(self.first_step, self.first_step + self.steps)


LocalTrainingResult = tuple[KeypointNetwork, dict[str, float], dict[str, Tensor]]
"""The network; the means of its losses; and the state of the optimizer, with which a later local training continues."""


def local_training(
    start: Mapping[str, Tensor], examples: Sequence[TrainingExample], plan: LocalTrainingPlan
) -> LocalTrainingResult:
    """Train for some steps from the state ``start``, which is not changed.

    The result depends on the arguments alone.
    """
    settings, device = plan.settings, plan.device
    network = network_from_state(settings.encoder, start).to(device, memory_format=torch.channels_last)
    network.train()
    batches = batch_stream(examples, settings, plan.numbers, ahead=2, threads=1)

    def losses_of(step: int) -> tuple[Tensor, dict[str, Tensor]]:
        return step_losses(network, on_device(next(batches), device), settings, step)

    with closing(batches):
        return _descended(network, losses_of, plan)


def train_layers(
    network: KeypointNetwork, layers: Sequence[nn.Module], losses_of: LossesOf, plan: LocalTrainingPlan
) -> LocalTrainingResult:
    """Train some layers of a network in place, with the batch statistics as they are. All others stay as they are."""
    trained = layer_names(network, layers)
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(name in trained)
    network.eval()
    return _descended(network, losses_of, plan)


def _descended(network: KeypointNetwork, losses_of: LossesOf, plan: LocalTrainingPlan) -> LocalTrainingResult:
    """The network after the steps of the plan, in evaluation mode."""
    optimizer = create_optimizer(network)
    is_new = plan.optimizer_state is None
    if plan.optimizer_state is not None:
        try:
            restore_optimizer_state(optimizer, plan.optimizer_state)
        except (KeyError, ValueError) as error:
            raise InputError(f"the optimizer cannot continue ({error})") from error
    sums: dict[str, float] = {}
    for step, losses in descend(
        network, optimizer, losses_of, plan.settings, plan.numbers, RAMP_STEPS if is_new else 0
    ):
        for name, loss in losses.items():
            sums[name] = sums.get(name, 0.0) + float(loss.detach())
        plan.on_step(step + 1 - plan.first_step)
    network.eval()
    state = get_optimizer_state(optimizer)
    if not all(bool(torch.isfinite(value).all()) for value in state.values()):
        # Checked here, because whatever continues from this state would diverge.
        raise InputError("training diverged in the last step; lower the learning rate")
    return network, {name: total / plan.steps for name, total in sums.items()}, state
