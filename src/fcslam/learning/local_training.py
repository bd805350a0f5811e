"""Local training: a client's part of a federated round. It trains some steps from given weights."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from fcslam.errors import TrainingError
from fcslam.learning.batches import batch_stream
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.revisit_batches import RevisitExamples, draw_revisits
from fcslam.learning.settings import Encoder, TrainingSettings
from fcslam.learning.training_step import (
    LegacyDetector,
    ProximalTerm,
    create_optimiser,
    get_optimiser_state,
    learning_rate,
    restore_optimiser_state,
    training_step,
)

RAMP_STEPS: Final = 10
"""Steps over which the learning rate rises of a new optimiser: without moments, Adam only follows gradients' signs."""

NO_REVISITS: Final = RevisitExamples()


@dataclass(frozen=True, slots=True)
class LocalTrainingPlan:
    """The steps of the whole run that are done now, and how."""

    first_step: int
    """Counted from 0 over the whole run."""
    steps: int
    proximal: float = 0.0
    """Strength of FedProx's proximal term; 0 for none."""
    compatible: float = 0.0
    """Weight of the loss that keeps codes compatible with those of a legacy detector; 0 for none."""
    frozen_statistics: bool = False
    """Batch normalisation uses the means and variances that it has, and does not change them."""
    only_codes: bool = False
    """Only the layers that nothing but the codes depends on are trained: the keypoints stay where they are."""


class LocalTrainingResult(NamedTuple):
    """The result of local training."""

    network: KeypointNetwork
    losses: dict[str, float]
    """Means over the steps."""
    optimiser_state: dict[str, Tensor]
    """With which a later local training continues."""


def local_training(
    start: Mapping[str, Tensor],
    examples: Sequence[TrainingExample],
    settings: TrainingSettings,
    plan: LocalTrainingPlan,
    device: torch.device,
    on_step: Callable[[int], None] = lambda _steps: None,
    legacy: Mapping[str, Tensor] | None = None,
    optimiser_state: Mapping[str, Tensor] | None = None,
    revisits: RevisitExamples = NO_REVISITS,
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
        optimiser_state: result of an earlier local training, to continue it.
        revisits: views of places that were seen again, also to train on.

    Raises:
        TrainingError: ``start``, ``legacy`` or ``optimiser_state`` does not fit the network, or training diverged.
    """
    network = network_from_state(settings.encoder, start).to(device, memory_format=torch.channels_last)
    network.train()
    if plan.frozen_statistics:
        freeze_statistics(network)
    if plan.only_codes:
        freeze_all_but_codes(network)
    proximal = None
    if plan.proximal > 0.0:
        weights = {name: value.detach().clone() for name, value in network.named_parameters()}
        proximal = ProximalTerm(plan.proximal, weights)
    legacy_detector = None
    if legacy is not None and plan.compatible > 0.0:
        legacy_detector = LegacyDetector(plan.compatible, network_from_state(settings.encoder, legacy).to(device))
    optimiser = create_optimiser(network)
    if optimiser_state is not None:
        try:
            restore_optimiser_state(optimiser, optimiser_state)
        except (KeyError, ValueError) as error:
            raise TrainingError(f"the optimiser cannot continue ({error})") from error
    sums: dict[str, float] = {}
    until = settings.model_copy(update={"steps": plan.first_step + plan.steps})
    for step, batch in batch_stream(examples, until, plan.first_step, ahead=2, threads=1):
        done = step - plan.first_step + 1
        rate = learning_rate(settings, step) * (min(done / RAMP_STEPS, 1.0) if optimiser_state is None else 1.0)
        again = draw_revisits(revisits, settings.seed, step).to(device) if revisits else None
        losses = training_step(
            network, optimiser, batch.to(device), settings, step, rate, proximal=proximal, legacy=legacy_detector,
            revisits=again,
        )  # fmt: skip
        for name, loss in losses.items():
            sums[name] = sums.get(name, 0.0) + float(loss)
        on_step(done)
    network.eval()
    state = get_optimiser_state(optimiser)
    if not all(bool(torch.isfinite(value).all()) for value in state.values()):
        # Checked here, because whatever continues from this state would diverge.
        raise TrainingError("training diverged in the last step; lower the learning rate")
    return LocalTrainingResult(network, {name: total / plan.steps for name, total in sums.items()}, state)


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


def freeze_all_but_codes(network: KeypointNetwork) -> None:
    """Let only the head of the codes be trained, without its batch statistics."""
    head = network.code_head
    trained = {id(parameter) for parameter in head.parameters()}
    for parameter in network.parameters():
        parameter.requires_grad_(id(parameter) in trained)
    freeze_statistics(network)


def freeze_statistics(network: nn.Module) -> None:
    """Let batch normalisation neither use nor change batch statistics; its scale and shift stay trainable."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()
