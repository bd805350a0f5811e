"""The arms of a study of federated training: the same start and number of samples, trained in different places."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from pydantic import Field

from fcslam.config import Settings, parse
from fcslam.evaluation.federated.poison import Poison, Poisoned
from fcslam.federated.client import client_app
from fcslam.federated.flower import Context
from fcslam.federated.grid import InProcessGrid
from fcslam.federated.network import network_of, version_maker
from fcslam.federated.robot import Learner, RobotLearner, seeded_noise
from fcslam.federated.rounds import Outside, Server
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import Example
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import Images
from fcslam.learning.trainer import Pace, Run, Status

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
class Ground:
    """What all arms of one seed share."""

    settings: FederatedSettings
    seed: int
    start: Weights
    images: Mapping[str, Images]
    """By robot."""
    folder: Path
    pace: Pace
    watch: Callable[[str, int, int], None]
    """Is told who trains, the steps or rounds done, and all of them."""


def train_central(ground: Ground) -> list[KeypointNetwork]:
    """One network, on all images in one place."""
    return [_train_alone(ground, CENTRAL, _everything(ground), _of_robots(ground, len(ground.images)))]


def train_locally(ground: Ground, name: str) -> list[KeypointNetwork]:
    """A network for each robot, on its images alone: with as many samples as all of them saw together, or its share."""
    training = _of_robots(ground, len(ground.images) if name == LOCAL else 1)
    return [_train_alone(ground, f"{name}-{robot}", images.train, training) for robot, images in ground.images.items()]


def train_arm(ground: Ground, name: str, arm: Arm) -> list[KeypointNetwork]:
    """One network, in one place, or by federated training in one process: what that would release at its end."""
    settings, place = arm.federated(ground.settings, ground.seed), ground.folder / name
    if not arm.together:
        return [_train_alone(ground, name, _everything(ground), settings.of_robots())]
    learners: list[Learner] = [
        RobotLearner(
            robot, Path(robot), place / robot, seeded_noise(robot, ground.seed), ground.pace.device, gathered=own
        )
        for robot, own in ground.images.items()
    ]
    if arm.poison is not None:
        learners[-1] = Poisoned(learners[-1], arm.poison)

    def learner_of(context: Context) -> Learner:
        return learners[int(context.node_config["partition-id"])]

    outside = Outside(
        version_maker(settings.training.encoder),
        # No version is compared with another one: the last one counts, as in the other arms.
        judge=lambda _weights: {},
        watch=lambda report, _best: ground.watch(name, report.round_number, settings.rounds),
    )
    server = Server(settings, ground.start, place, outside)
    state = server.run(InProcessGrid(client_app(learner_of), len(learners)))
    return [network_of(state.average, settings.training.encoder)]


def _everything(ground: Ground) -> list[Example]:
    return [example for images in ground.images.values() for example in images.train]


def _of_robots(ground: Ground, shares: int) -> TrainingSettings:
    """With ``shares`` times the steps of a robot."""
    training = ground.settings.of_robots()
    return training.model_copy(update={"steps": training.steps * shares, "seed": ground.seed})


def _train_alone(ground: Ground, name: str, examples: list[Example], training: TrainingSettings) -> KeypointNetwork:
    """By the central trainer."""
    state = network_of(ground.start, training.encoder).state_dict()
    folder = ground.folder / name
    folder.mkdir(parents=True, exist_ok=True)
    quiet = replace(ground.pace, validate_every=training.steps, log_every=max(training.steps // 20, 1))

    def watch(status: Status) -> None:
        ground.watch(name, status.step, status.steps)

    return Run(training, "joint", folder, quiet, state).train(examples, examples[:1], watch=watch)
