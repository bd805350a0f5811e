"""Local training: a client's part of a federated round. It trains some steps from given weights."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from fcslam.errors import TrainingError
from fcslam.learning.batches import batch_stream
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import Encoder, TrainingSettings
from fcslam.learning.training_step import (
    LegacyDetector,
    create_optimizer,
    descend,
    get_optimizer_state,
    learning_rate,
    restore_optimizer_state,
    step_losses,
)

RAMP_STEPS: Final = 10
"""Steps over which the learning rate rises of a new optimizer: without moments, Adam only follows gradients' signs."""


@dataclass(frozen=True, slots=True)
class LocalTrainingPlan:
    """The steps of the whole run that are done now, and how."""

    first_step: int
    """Counted from 0 over the whole run."""
    steps: int
    compatible: float = 0.0
    """Weight of the loss that keeps codes compatible with those of a legacy detector; 0 for none."""
    frozen_statistics: bool = False
    """Batch normalisation uses the means and variances that it has, and does not change them."""


class LocalTrainingResult(NamedTuple):
    """The result of local training."""

    network: KeypointNetwork
    losses: dict[str, float]
    """Means over the steps."""
    optimizer_state: dict[str, Tensor]
    """With which a later local training continues."""


def local_training(
    start: Mapping[str, Tensor],
    examples: Sequence[TrainingExample],
    settings: TrainingSettings,
    plan: LocalTrainingPlan,
    device: torch.device,
    on_step: Callable[[int], None] = lambda _steps: None,
    legacy: Mapping[str, Tensor] | None = None,
    optimizer_state: Mapping[str, Tensor] | None = None,
) -> LocalTrainingResult:
    """Train for some steps. The result depends on the arguments alone.

    Args:
        start: state of a network, which is not changed.
        examples: to train on.
        settings: of the whole run; the learning rate falls towards the end of its steps.
        plan: which steps are done, and how.
        device: to train on.
        on_step: called with the number of steps done.
        legacy: state of the network whose codes are still in use.
        optimizer_state: result of an earlier local training, to continue it.

    Raises:
        TrainingError: ``start``, ``legacy`` or ``optimizer_state`` does not fit the network, or training diverged.
    """
    network = network_from_state(settings.encoder, start).to(device, memory_format=torch.channels_last)
    network.train()
    if plan.frozen_statistics:
        freeze_statistics(network)
    legacy_detector = None
    if legacy is not None and plan.compatible > 0.0:
        legacy_detector = LegacyDetector(plan.compatible, network_from_state(settings.encoder, legacy).to(device))
    until = settings.model_copy(update={"steps": plan.first_step + plan.steps})
    batches = batch_stream(examples, until, plan.first_step, ahead=2, threads=1)

    def losses_of(step: int) -> tuple[Tensor, dict[str, Tensor]]:
        _, batch = next(batches)
        return step_losses(network, batch.to(device), settings, step, legacy=legacy_detector)

    with closing(batches):
        return _descended(network, losses_of, settings, plan, on_step, optimizer_state)


def train_layers(
    network: KeypointNetwork,
    layers: Sequence[nn.Module],
    losses_of: Callable[[int], tuple[Tensor, dict[str, Tensor]]],
    settings: TrainingSettings,
    plan: LocalTrainingPlan,
    on_step: Callable[[int], None] = lambda _steps: None,
    optimizer_state: Mapping[str, Tensor] | None = None,
) -> LocalTrainingResult:
    """Train some layers of a network in place by losses of the caller's, with the batch statistics as they are.

    Args:
        network: in evaluation mode.
        layers: to train; all others stay as they are.
        losses_of: the loss to descend at a step of the whole run, and its parts by name.
        settings: of the whole run; the learning rate falls towards the end of its steps.
        plan: which steps are done, and how.
        on_step: called with the number of steps done.
        optimizer_state: result of an earlier local training, to continue it.

    Raises:
        TrainingError: ``optimizer_state`` belongs to another network, or training diverged.
    """
    trained = layer_names(network, layers)
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(name in trained)
    freeze_statistics(network)
    return _descended(network, losses_of, settings, plan, on_step, optimizer_state)


def _descended(
    network: KeypointNetwork,
    losses_of: Callable[[int], tuple[Tensor, dict[str, Tensor]]],
    settings: TrainingSettings,
    plan: LocalTrainingPlan,
    on_step: Callable[[int], None],
    optimizer_state: Mapping[str, Tensor] | None,
) -> LocalTrainingResult:
    """The network after the steps of the plan, in evaluation mode."""
    optimizer = create_optimizer(network)
    if optimizer_state is not None:
        try:
            restore_optimizer_state(optimizer, optimizer_state)
        except (KeyError, ValueError) as error:
            raise TrainingError(f"the optimizer cannot continue ({error})") from error
    sums: dict[str, float] = {}
    for done in range(1, plan.steps + 1):
        step = plan.first_step + done - 1
        ramp = min(done / RAMP_STEPS, 1.0) if optimizer_state is None else 1.0
        total, losses = losses_of(step)
        descend(network, optimizer, total, step, ramp * learning_rate(settings, step))
        for name, loss in losses.items():
            sums[name] = sums.get(name, 0.0) + float(loss.detach())
        on_step(done)
    network.eval()
    state = get_optimizer_state(optimizer)
    if not all(bool(torch.isfinite(value).all()) for value in state.values()):
        # Checked here, because whatever continues from this state would diverge.
        raise TrainingError("training diverged in the last step; lower the learning rate")
    return LocalTrainingResult(network, {name: total / plan.steps for name, total in sums.items()}, state)


def layer_names(network: KeypointNetwork, layers: Sequence[nn.Module]) -> set[str]:
    """Names of the parameters and statistics of some layers of a network."""
    values = {id(value) for layer in layers for value in layer.state_dict(keep_vars=True).values()}
    return {name for name, value in network.state_dict(keep_vars=True).items() if id(value) in values}


def network_from_state(encoder: Encoder, state: Mapping[str, Tensor]) -> KeypointNetwork:
    """A network in this state, in evaluation mode.

    Raises:
        TrainingError: the state belongs to another network.
    """
    network = KeypointNetwork(encoder)
    try:
        network.load_state_dict(dict(state))
    except RuntimeError as error:
        raise TrainingError(f"the weights are not those of a {encoder} network ({error})") from error
    network.eval()
    return network


def freeze_statistics(network: nn.Module) -> None:
    """Let batch normalisation neither use nor change batch statistics; its scale and shift stay trainable."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()
