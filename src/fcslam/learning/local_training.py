"""A leg of a training run that another machine began: some steps from given weights, and back go the new ones."""

from collections.abc import Callable, Mapping, Sequence
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
    ProximalTerm,
    create_optimiser,
    learning_rate,
    optimiser_state,
    restore_optimiser_state,
    training_step,
)

RAMP_STEPS: Final = 10
"""An optimiser that knows no gradients yet steps by their signs alone; its rate rises over so many steps."""


@dataclass(frozen=True, slots=True)
class LocalTrainingPlan:
    """Which steps of the whole run, and how."""

    first: int
    steps: int
    pull: float = 0.0
    """Strength of a spring to the weights at the start."""
    compatible: float = 0.0
    """How strongly codes are kept to those of a former network, if there is one."""
    frozen_statistics: bool = False
    """Whether batch normalisation uses the means and variances it came with, and leaves them as they are."""


class LocalTrainingResult(NamedTuple):
    """What a leg gives."""

    network: KeypointNetwork
    losses: dict[str, float]
    """Means over the steps."""
    moments: dict[str, Tensor]
    """What the optimiser has learnt of gradients."""


def local_training(
    start: Mapping[str, Tensor],
    examples: Sequence[TrainingExample],
    settings: TrainingSettings,
    leg: LocalTrainingPlan,
    device: torch.device,
    watch: Callable[[int], None] = lambda _steps: None,
    former: Mapping[str, Tensor] | None = None,
    moments: Mapping[str, Tensor] | None = None,
) -> LocalTrainingResult:
    """Train from ``start`` (a network's state), with an optimiser that goes on from the ``moments`` of an earlier leg.

    The result depends on the arguments alone. ``settings.steps`` are those of the whole run: the rate falls towards
    its end. ``watch`` is told how many steps are done. ``former`` is the state of the network that made codes which are
    still in use.

    Raises:
        TrainingError: ``start``, ``former`` or ``moments`` does not fit the network, or training diverged.
    """
    network = network_from_state(settings.encoder, start).to(device, memory_format=torch.channels_last)
    network.train()
    if leg.frozen_statistics:
        freeze_statistics(network)
    pull = None
    if leg.pull > 0.0:
        pull = ProximalTerm(leg.pull, {name: value.detach().clone() for name, value in network.named_parameters()})
    keeper = None
    if former is not None and leg.compatible > 0.0:
        keeper = LegacyDetector(leg.compatible, network_from_state(settings.encoder, former).to(device))
    optimiser = create_optimiser(network)
    if moments is not None:
        try:
            restore_optimiser_state(optimiser, moments)
        except (KeyError, ValueError) as error:
            raise TrainingError(f"the optimiser cannot go on ({error})") from error
    sums: dict[str, float] = {}
    ends = settings.model_copy(update={"steps": leg.first + leg.steps})
    for step, batch in batch_stream(examples, ends, leg.first, ahead=2, threads=1):
        done = step - leg.first + 1
        rate = learning_rate(settings, step) * (min(done / RAMP_STEPS, 1.0) if moments is None else 1.0)
        parts = training_step(network, optimiser, batch.to(device), settings, step, rate, pull=pull, former=keeper)
        for name, part in parts.items():
            sums[name] = sums.get(name, 0.0) + float(part)
        watch(done)
    network.eval()
    learnt = optimiser_state(optimiser)
    if not all(bool(torch.isfinite(value).all()) for value in learnt.values()):
        raise TrainingError("training diverged in the last step; lower the learning rate")  # who went on would, too
    return LocalTrainingResult(network, {name: total / leg.steps for name, total in sums.items()}, learnt)


def network_from_state(encoder: Encoder, state: Mapping[str, Tensor]) -> KeypointNetwork:
    """A network in this state, in evaluation mode.

    Raises:
        TrainingError: the state is of another network.
    """
    network = KeypointNetwork(encoder)
    try:
        network.load_state_dict(dict(state))
    except RuntimeError as error:
        raise TrainingError(f"the weights are not those of a {encoder} network ({error})") from error
    network.eval()
    return network


def freeze_statistics(network: nn.Module) -> None:
    """Let batch normalisation neither look at the batch nor learn from it; its scale and shift stay trainable."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()
