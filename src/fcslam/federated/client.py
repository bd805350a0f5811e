"""What a robot does in a round: train from the global weights on its own images, or judge weights on some of them."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.client_state import legacy_weights, load_optimiser_state, save_optimiser_state
from fcslam.federated.codec import network_to_weights, weights_to_network
from fcslam.federated.evaluation import SCORE_METRICS
from fcslam.federated.privacy import privatise_update
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights, trained_names
from fcslam.learning.images import find_images
from fcslam.learning.local_training import LocalTrainingPlan, local_training
from fcslam.learning.stages import TrainingImages, keypoint_response, read_labelled_images
from fcslam.learning.trainer import TrainingProgress, validation_pairs
from fcslam.learning.validation import validate

NOISE_NEEDS_PUBLIC_IMAGES: Final = (
    "with noise for privacy no figures of a robot's own images may leave it: give --public images"
)

NoiseSource = Callable[[int], np.random.Generator]
"""Gives the generator of a round's noise: of the system's entropy where robots are real, seeded where they are not."""


class ClientUpdate(NamedTuple):
    """A robot's answer."""

    weights: dict[str, NDArray[np.float32]]
    losses: dict[str, float]
    """Means over the steps; none with noise, which they are without."""


class FederatedClient(Protocol):
    """Whoever takes part in federated training."""

    @property
    def name(self) -> str:
        """What the robot is called, in the whole fleet."""

    def learn(self, weights: Weights, round_number: int, run: str, settings: FederatedSettings) -> ClientUpdate:
        """Train for a round; rounds count from 0. ``run`` names the run that they are of."""

    def judge(self, weights: Weights, settings: FederatedSettings) -> dict[str, float]:
        """Figures of weights, by name."""


@dataclass(slots=True)
class RobotClient:
    """A robot with images of its own in ``folder``.

    What outlives a round is kept in ``cache``: labels of the images, the memory of the optimiser, and the weights that
    codes are to be compatible with, if they are to be.
    """

    name: str
    folder: Path
    cache: Path
    noise: NoiseSource
    device: str = "cpu"
    watch: Callable[[str, int], None] = lambda _robot, _steps: None
    """Is told its name and how many steps of a round are done."""
    gathered: TrainingImages | None = None
    """Its images with their labels, once they are read."""

    def learn(self, weights: Weights, round_number: int, run: str, settings: FederatedSettings) -> ClientUpdate:
        """As in ``FederatedClient``; the result depends on the arguments, what is kept, the images, and the noise.

        Raises:
            TrainingError: there are too few usable images, the weights are of another network, training diverged, or
                the cache cannot be used.
        """
        frozen = settings.normalisation == "frozen"
        network = weights_to_network(weights, settings.training.encoder)
        examples = self._examples(weights, settings).train
        leg = LocalTrainingPlan(
            first=round_number * settings.local_steps,
            steps=settings.local_steps,
            pull=settings.proximal if settings.strategy == "fedprox" else 0.0,
            compatible=settings.compatible,
            frozen_statistics=frozen,
        )
        own = settings.client_training().model_copy(update={"seed": robot_seed(self.name, settings.training.seed)})
        former = legacy_weights(self.cache, run, round_number, weights) if leg.compatible else None
        moments = load_optimiser_state(self.cache, run, round_number)
        trained = local_training(
            network.state_dict(),
            examples,
            own,
            leg,
            torch.device(self.device),
            partial(self.watch, self.name),
            former=None if former is None else weights_to_network(former, settings.training.encoder).state_dict(),
            moments=moments,
        )
        save_optimiser_state(self.cache, run, round_number, trained.moments)
        found, names = network_to_weights(trained.network), trained_names(weights, frozen)
        sent = privatise_update(found, weights, names, settings.privacy, self.noise(round_number))
        return ClientUpdate(sent, {} if settings.privacy.noise_multiplier else trained.losses)

    def judge(self, weights: Weights, settings: FederatedSettings) -> dict[str, float]:
        """As in ``FederatedClient``, on pairs of images that were held out.

        Raises:
            TrainingError: noise is to keep the images private, and figures are without any; or as in ``learn``.
        """
        if settings.privacy.noise_multiplier:
            raise TrainingError(NOISE_NEEDS_PUBLIC_IMAGES)
        network = weights_to_network(weights, settings.training.encoder).to(self.device)
        held_out = self._examples(weights, settings).held_out
        found = validate(network, validation_pairs(held_out), torch.device(self.device), shifts=False)
        # What finds nothing finds nothing again: a detector that collapsed is judged, too.
        return {name: found[name] if np.isfinite(found[name]) else 0.0 for name in SCORE_METRICS}

    def _examples(self, weights: Weights, settings: FederatedSettings) -> TrainingImages:
        """The images, labelled by the first weights that ever came here, and by no later ones."""
        if self.gathered is None:
            device = torch.device(self.device)
            labeller = keypoint_response(weights_to_network(weights, settings.training.encoder).to(device), device)
            self.gathered = read_labelled_images(
                find_images([self.folder]), self.cache, settings.training, labeller, None, _silent
            )
        return self.gathered


def robot_seed(robot: str, seed: int) -> int:
    """A robot's own seed, so that no two draw the same views."""
    return int(np.random.default_rng([seed, zlib.crc32(robot.encode())]).integers(2**31))


def seeded_noise(robot: str, seed: int) -> NoiseSource:
    """Noise that can be repeated: for robots in one process, whose privacy is a rehearsal."""
    return lambda round_number: np.random.default_rng([robot_seed(robot, seed), round_number])


def secret_noise(_round_number: int) -> np.random.Generator:
    """Noise that nobody can repeat."""
    return np.random.default_rng()


def _silent(_stage: str, _status: TrainingProgress) -> None:
    pass
