"""The arms of a study of federated training. All start from the same weights; they differ in where they train."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from pydantic import Field

from fcslam.config import Settings, parse
from fcslam.lab.evaluation.federated.poison import Poison, PoisonedClient
from fcslam.learning.federated.client import FederatedClient, RobotClient
from fcslam.learning.federated.client_app import in_process_grid
from fcslam.learning.federated.coordinator import Coordinator, CoordinatorHooks
from fcslam.learning.federated.networks import weights_to_network, weights_version
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import TrainingImages
from fcslam.learning.trainer import ExecutionOptions, TrainingProgress, TrainingRun

START: Final = "start"
"""The initial weights without training."""
CENTRAL: Final = "central"
"""One network on the images of all robots."""
LOCAL: Final = "local"
"""Each robot on its own images, with as many steps as all robots of the fleet have together."""
ALONE: Final = "alone"
"""Each robot on its own images, with as many steps as it has in the fleet."""


class Arm(Settings):
    """One way to train the fleet."""

    together: bool = Field(
        default=True,
        description="true: federated training; false: central training with as many steps as one robot of the fleet",
    )
    settings: dict[str, Any] = Field(
        default_factory=dict, description="federated settings of this arm that differ from those of the study"
    )
    poison: Poison | None = Field(default=None, description="how the last robot falsifies updates; null for not")
    seeds: int | None = Field(
        default=None, ge=1, description="number of the study's seeds for which this arm is trained; null for all"
    )

    def federated(self, common: FederatedSettings, seed: int) -> FederatedSettings:
        """The settings of this arm.

        Raises:
            ConfigError: ``settings`` names something that is not a setting.
        """
        content = common.model_dump() | self.settings
        content["training"] = dict(content["training"]) | {"seed": seed}
        return parse(FederatedSettings, content, "an arm of the study")


@dataclass(frozen=True, slots=True)
class SeedContext:
    """Data that all arms of one seed share."""

    settings: FederatedSettings
    seed: int
    start: Weights
    images: Mapping[str, TrainingImages]
    """Training images by robot."""
    folder: Path
    options: ExecutionOptions
    on_progress: Callable[[str, int, int], None]
    """Called with the name of what trains, the steps or rounds done, and their total."""


def train_central(context: SeedContext) -> list[KeypointNetwork]:
    """Train one network on the images of all robots."""
    return [
        _train_centrally(context, CENTRAL, _all_examples(context), _training_settings(context, len(context.images)))
    ]


def train_locally(context: SeedContext, name: str) -> list[KeypointNetwork]:
    """Train a network for each robot on its own images, for the arm ``LOCAL`` or ``ALONE``."""
    training = _training_settings(context, len(context.images) if name == LOCAL else 1)
    return [
        _train_centrally(context, f"{name}-{robot}", images.train, training) for robot, images in context.images.items()
    ]


def train_arm(context: SeedContext, name: str, arm: Arm) -> list[KeypointNetwork]:
    """Train the network of an arm; of federated training it is the one that could be released at its end."""
    settings, folder = arm.federated(context.settings, context.seed), context.folder / name
    if not arm.together:
        return [_train_centrally(context, name, _all_examples(context), settings.client_training())]
    clients: list[FederatedClient] = [
        RobotClient(robot, Path(robot), folder / robot, context.options.device, images=own)
        for robot, own in context.images.items()
    ]
    if arm.poison is not None:
        clients[-1] = PoisonedClient(clients[-1], arm.poison)
    hooks = CoordinatorHooks(
        partial(weights_version, encoder=settings.training.encoder),
        # Without metrics no version is better than another: the last one counts, as in the other arms.
        evaluate_fn=lambda _weights: {},
        on_round=lambda report: context.on_progress(name, report.round_number, settings.rounds),
    )
    state = Coordinator(in_process_grid(clients), settings, context.start, folder, hooks).run()
    return [weights_to_network(state.average, settings.training.encoder)]


def _all_examples(context: SeedContext) -> list[TrainingExample]:
    return [example for images in context.images.values() for example in images.train]


def _training_settings(context: SeedContext, shares: int) -> TrainingSettings:
    """Training settings with ``shares`` times the steps of a robot in the fleet."""
    training = context.settings.client_training()
    return training.model_copy(update={"steps": training.steps * shares, "seed": context.seed})


def _train_centrally(
    context: SeedContext, name: str, examples: list[TrainingExample], training: TrainingSettings
) -> KeypointNetwork:
    """Train with the trainer of central training."""
    state = weights_to_network(context.start, training.encoder).state_dict()
    folder = context.folder / name
    folder.mkdir(parents=True, exist_ok=True)
    quiet = replace(context.options, validate_every=training.steps, log_every=max(training.steps // 20, 1))

    def on_progress(progress: TrainingProgress) -> None:
        context.on_progress(name, progress.step, progress.steps)

    return TrainingRun(training, "joint", folder, quiet, state).train(examples, examples[:1], on_progress=on_progress)
