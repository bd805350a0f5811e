"""Local training: a client's part of a federated round. It trains some steps from given weights."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from fcslam.errors import InputError
from fcslam.learning.batches import batch_stream, on_device
from fcslam.learning.network import KeypointNetwork, layer_names, network_from_state
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.training_loop import (
    LossesOf,
    create_optimizer,
    descend,
    get_optimizer_state,
    restore_optimizer_state,
    step_losses,
)

RAMP_STEPS: Final = 10
"""Steps over which the learning rate rises of a new optimizer: without moments, Adam only follows gradients' signs."""


@dataclass(frozen=True, slots=True)
class LocalTrainingPlan:
    """The steps of the whole run that are done now, and how."""

    settings: TrainingSettings
    """Of the whole run; the learning rate falls towards the end of its steps."""
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
        """Of the steps, over the whole run."""
        return range(self.first_step, self.first_step + self.steps)


class LocalTrainingResult(NamedTuple):
    """The result of local training."""

    network: KeypointNetwork
    losses: dict[str, float]
    """Means over the steps."""
    optimizer_state: dict[str, Tensor]
    """With which a later local training continues."""


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
    return LocalTrainingResult(network, {name: total / plan.steps for name, total in sums.items()}, state)
