"""A robot as a federated client: it trains on its own images from the global weights, and evaluates weights on some."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.learning.code_batches import RevisitExamples
from fcslam.learning.code_training import CodeInputs, train_codes
from fcslam.learning.federated.client_state import legacy_weights, load_robot_state, save_robot_state
from fcslam.learning.federated.evaluation import SCORE_METRICS
from fcslam.learning.federated.held_out import HeldOutPairs, Judgement, judge
from fcslam.learning.federated.networks import network_to_weights, weights_to_network
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights, shared_weights, with_private
from fcslam.learning.images import find_images
from fcslam.learning.local_training import LocalTrainingPlan, local_training
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import TrainingImages, keypoint_response, read_labelled_images
from fcslam.learning.trainer import validation_pairs
from fcslam.learning.validation import validate


class ClientUpdate(NamedTuple):
    """The result of a client's training in a round."""

    weights: dict[str, NDArray[np.float32]]
    """Of all layers; those of private layers are not sent."""
    losses: dict[str, float]
    """Means over the steps."""


class FederatedClient(Protocol):
    """A participant in federated training."""

    @property
    def name(self) -> str:
        """Name of the robot, unique in the fleet."""

    def train(self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings) -> ClientUpdate:
        """Train for a round, counted from 0, of the run with this number."""

    def evaluate(
        self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings
    ) -> dict[str, float]:
        """Metrics of the weights by name, after the round."""


@runtime_checkable
class JudgingClient(Protocol):
    """A participant that holds out pairs of keyframes."""

    def judge(self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings) -> Judgement:
        """A report on these pairs with the weights, after the round."""


@dataclass(slots=True)
class RobotClient:
    """A client with its own images."""

    name: str
    folder: Path
    """Contains the images."""
    cache: Path
    """Folder for what must survive a round: labels, the optimizer's state, private layers, and the weights of the
    legacy detector.
    """
    device: str = "cpu"
    on_step: Callable[[str, int], None] = lambda _robot, _steps: None
    """Called with the name and the number of steps done in a round."""
    most_images: int | None = None
    """It trains on the first ones alone; None for all."""
    images: TrainingImages | None = None
    """The images with their labels; None until they are read."""
    images_settings: TrainingSettings | None = None
    """Settings with which the images were read; None if they were given."""
    revisits: RevisitExamples = field(default_factory=RevisitExamples)
    """Points that were seen again, on which ``codes`` are trained."""
    inputs: CodeInputs = field(default_factory=CodeInputs)
    """Inputs from the images of ``revisits``."""
    held_out: HeldOutPairs = field(default_factory=HeldOutPairs)
    """Pairs of keyframes that are never trained on."""

    def train(self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings) -> ClientUpdate:
        """Train from the weights. The result depends on the arguments, the cache and the images.

        Args:
            weights: global weights of the round.
            round_number: counted from 0.
            run_id: identifies the run, for the state in the cache.
            settings: of the run.

        Raises:
            TrainingError: there are too few usable images, the weights belong to another network, training diverged,
                or the cache cannot be used.
        """
        encoder = settings.training.encoder
        moments, own = load_robot_state(self.cache, run_id, round_number)
        weights = with_private(weights, own, settings.private)
        start = weights_to_network(weights, encoder).state_dict()
        training = settings.client_training().model_copy(update={"seed": robot_seed(self.name, settings.training.seed)})
        needs_former = settings.compatible > 0.0 or settings.on_revisits
        former = legacy_weights(self.cache, run_id, round_number, weights) if needs_former else None
        plan = LocalTrainingPlan(
            settings=training,
            first_step=round_number * settings.local_steps,
            steps=settings.local_steps,
            compatible=settings.compatible,
            legacy=None if former is None else weights_to_network(former, encoder).state_dict(),
            frozen_statistics=settings.normalisation == "frozen",
            optimizer_state=moments,
            device=torch.device(self.device),
            on_step=partial(self.on_step, self.name),
        )
        if settings.on_revisits:
            trained = train_codes(start, self.revisits, self.inputs, plan)
        else:
            trained = local_training(start, self._labelled_images(weights, settings).train, plan)
        found = network_to_weights(trained.network)
        shared = shared_weights(found, settings.private)
        own = {name: array for name, array in found.items() if name not in shared}
        save_robot_state(self.cache, run_id, round_number, trained.optimizer_state, own)
        return ClientUpdate(found, trained.losses)

    def own_weights(self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings) -> Weights:
        """The weights with the robot's own private layers, as they are after the round.

        Raises:
            TrainingError: the cache cannot be read.
        """
        _, own = load_robot_state(self.cache, run_id, round_number + 1)
        return with_private(weights, own, settings.private)

    def evaluate(
        self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings
    ) -> dict[str, float]:
        """Repeatability and MMA at 3 px of the weights, shares in [0, 1], on pairs of images that are held out.

        Private layers are the robot's own.

        Raises:
            TrainingError: as in ``train``.
        """
        weights = self.own_weights(weights, round_number, run_id, settings)
        network = weights_to_network(weights, settings.training.encoder).to(self.device)
        held_out = self._labelled_images(weights, settings).held_out
        found = validate(network, validation_pairs(held_out), torch.device(self.device), shifts=False)
        # A detector that finds nothing has no metrics; it counts as one that finds nothing again.
        return {name: found[name] if np.isfinite(found[name]) else 0.0 for name in SCORE_METRICS}

    def judge(self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings) -> Judgement:
        """A report on the pairs of keyframes that the robot holds out, with the weights, shape (P, 2).

        Private layers are the robot's own.

        Raises:
            TrainingError: the weights belong to another network, or the cache cannot be read.
        """
        device = torch.device(self.device)
        weights = self.own_weights(weights, round_number, run_id, settings)
        network = weights_to_network(weights, settings.training.encoder).to(device)
        judgement: Judgement = judge(network, self.held_out, device)
        return judgement

    def _labelled_images(self, weights: Weights, settings: FederatedSettings) -> TrainingImages:
        """The images, labelled by the first weights that the robot ever received; the labels stay."""
        is_outdated = self.images_settings not in (None, settings.training)
        if self.images is None or is_outdated:
            device = torch.device(self.device)
            labeller = keypoint_response(weights_to_network(weights, settings.training.encoder).to(device), device)
            files = find_images([self.folder])
            self.images = read_labelled_images(
                files, self.cache, settings.training, labeller, None, lambda _stage, _progress: None, self.most_images
            )
            self.images_settings = settings.training
        return self.images


def robot_seed(robot: str, seed: int) -> int:
    """The seed of a robot, so that two robots draw different views."""
    return int(np.random.default_rng([seed, zlib.crc32(robot.encode())]).integers(2**31))
