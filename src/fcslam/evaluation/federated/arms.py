"""The arms of a study of federated training: the same start and number of samples, trained in different places."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from pydantic import Field

from fcslam.config import Settings, parse
from fcslam.evaluation.federated.poison import Poison, PoisonedClient
from fcslam.federated.client import FederatedClient, RobotClient, seeded_noise
from fcslam.federated.client_app import build_client_app
from fcslam.federated.codec import version_maker, weights_to_network
from fcslam.federated.coordinator import Coordinator, CoordinatorHooks
from fcslam.federated.flower import Context
from fcslam.federated.grid import InProcessGrid
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import TrainingImages
from fcslam.learning.trainer import ExecutionOptions, TrainingProgress, TrainingRun

START: Final = "start"
"""What all begin from, as it is."""
CENTRAL: Final = "central"
LOCAL: Final = "local"
ALONE: Final = "alone"
"""Local training that is no longer than a robot's in a fleet."""


class Arm(Settings):
    """One way to train."""

    together: bool = Field(default=True, description="false: in one place, as many steps as a robot of the fleet does")
    settings: dict[str, Any] = Field(default_factory=dict, description="federated settings that differ")
    poison: Poison | None = Field(default=None, description="what the last robot does to its updates")
    seeds: int | None = Field(default=None, ge=1, description="so many of the study's seeds; null for all")

    def federated(self, common: FederatedSettings, seed: int) -> FederatedSettings:
        """The settings of this arm.

        Raises:
            ConfigError: what differs is no setting.
        """
        content = common.model_dump() | self.settings
        content["training"] = dict(content["training"]) | {"seed": seed}
        return parse(FederatedSettings, content, "an arm of the study")


@dataclass(frozen=True, slots=True)
class SeedContext:
    """What all arms of one seed share."""

    settings: FederatedSettings
    seed: int
    start: Weights
    images: Mapping[str, TrainingImages]
    """By robot."""
    folder: Path
    pace: ExecutionOptions
    watch: Callable[[str, int, int], None]
    """Is told who trains, the steps or rounds done, and all of them."""


def train_central(ground: SeedContext) -> list[KeypointNetwork]:
    """One network, on all images in one place."""
    return [_train_alone(ground, CENTRAL, _everything(ground), _of_robots(ground, len(ground.images)))]


def train_locally(ground: SeedContext, name: str) -> list[KeypointNetwork]:
    """A network for each robot, on its images alone: with as many samples as all of them saw together, or its share."""
    training = _of_robots(ground, len(ground.images) if name == LOCAL else 1)
    return [_train_alone(ground, f"{name}-{robot}", images.train, training) for robot, images in ground.images.items()]


def train_arm(ground: SeedContext, name: str, arm: Arm) -> list[KeypointNetwork]:
    """One network, in one place, or by federated training in one process: what that would release at its end."""
    settings, place = arm.federated(ground.settings, ground.seed), ground.folder / name
    if not arm.together:
        return [_train_alone(ground, name, _everything(ground), settings.client_training())]
    learners: list[FederatedClient] = [
        RobotClient(
            robot, Path(robot), place / robot, seeded_noise(robot, ground.seed), ground.pace.device, gathered=own
        )
        for robot, own in ground.images.items()
    ]
    if arm.poison is not None:
        learners[-1] = PoisonedClient(learners[-1], arm.poison)

    def learner_of(context: Context) -> FederatedClient:
        return learners[int(context.node_config["partition-id"])]

    outside = CoordinatorHooks(
        version_maker(settings.training.encoder),
        # No version is compared with another one: the last one counts, as in the other arms.
        judge=lambda _weights: {},
        watch=lambda report, _best: ground.watch(name, report.round_number, settings.rounds),
    )
    server = Coordinator(settings, ground.start, place, outside)
    state = server.run(InProcessGrid(build_client_app(learner_of), len(learners)))
    return [weights_to_network(state.average, settings.training.encoder)]


def _everything(ground: SeedContext) -> list[TrainingExample]:
    return [example for images in ground.images.values() for example in images.train]


def _of_robots(ground: SeedContext, shares: int) -> TrainingSettings:
    """With ``shares`` times the steps of a robot."""
    training = ground.settings.client_training()
    return training.model_copy(update={"steps": training.steps * shares, "seed": ground.seed})


def _train_alone(
    ground: SeedContext, name: str, examples: list[TrainingExample], training: TrainingSettings
) -> KeypointNetwork:
    """By the central trainer."""
    state = weights_to_network(ground.start, training.encoder).state_dict()
    folder = ground.folder / name
    folder.mkdir(parents=True, exist_ok=True)
    quiet = replace(ground.pace, validate_every=training.steps, log_every=max(training.steps // 20, 1))

    def watch(status: TrainingProgress) -> None:
        ground.watch(name, status.step, status.steps)

    return TrainingRun(training, "joint", folder, quiet, state).train(examples, examples[:1], watch=watch)
