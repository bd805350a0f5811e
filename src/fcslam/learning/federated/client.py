"""A robot as a federated client: it trains on its own images from the global weights, and evaluates weights on some."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.errors import FcslamError
from fcslam.learning.code_batches import RevisitExamples
from fcslam.learning.code_training import CodeInputs, train_codes
from fcslam.learning.federated.client_state import first_weights, load_moments, save_moments
from fcslam.learning.federated.evaluation import SCORE_METRICS
from fcslam.learning.federated.held_out import HeldOutPairs, Judgement, judge
from fcslam.learning.federated.messages import PAIRS, TrainingReply, TrainingRequest
from fcslam.learning.federated.networks import network_to_weights, weights_to_network
from fcslam.learning.images import find_images
from fcslam.learning.local_training import LocalTrainingPlan, local_training
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import TrainingImages, keypoint_response, read_labelled_images
from fcslam.learning.validation import validate, validation_pairs


class ClientUpdate(NamedTuple):
    """The result of a client's training in a round."""

    weights: dict[str, NDArray[np.float32]]
    losses: dict[str, float]
    """Means over the steps."""


class FederatedClient(Protocol):
    """A participant in federated training."""

    @property
    def name(self) -> str:
        """Name of the robot, unique in the fleet."""

    def train(self, request: TrainingRequest) -> ClientUpdate:
        """Train for a round."""

    def evaluate(self, request: TrainingRequest) -> dict[str, float]:
        """Metrics of the weights by name, on images that are held out."""

    def judge(self, request: TrainingRequest) -> Judgement:
        """A report on the pairs of keyframes that are held out, with the weights, shape (P, 2)."""


def answer(client: FederatedClient, request: TrainingRequest) -> TrainingReply:
    """A client's reply. A failure ends the request, and neither the robot nor the training of the others."""
    try:
        if request.is_training:
            update = client.train(request)
            return TrainingReply(client.name, request.version, update.weights, update.losses)
        if request.lesson == "revisits":
            return TrainingReply(client.name, request.version, {PAIRS: client.judge(request)})
        return TrainingReply(client.name, request.version, figures=client.evaluate(request))
    except FcslamError as error:
        return TrainingReply(client.name, request.version, error=str(error))
    except Exception as error:
        return TrainingReply(client.name, request.version, error=f"{type(error).__name__}: {error}")


@dataclass(slots=True)
class RobotClient:
    """A client with its own images."""

    name: str
    folder: Path
    """Contains the images."""
    cache: Path
    """Folder for what must survive a round: labels, the optimizer's state, and the weights of the first round."""
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
    """Points that were seen again."""
    inputs: CodeInputs = field(default_factory=CodeInputs)
    """Inputs from the images of ``revisits``."""
    held_out: HeldOutPairs = field(default_factory=HeldOutPairs)
    """Pairs of keyframes that are never trained on."""

    def train(self, request: TrainingRequest) -> ClientUpdate:
        """Train from the weights. The result depends on the request, the cache and the images."""
        settings, number, run_id = request.settings, request.round_number, request.run_id
        encoder = settings.training.encoder
        start = weights_to_network(request.weights, encoder).state_dict()
        seed = robot_seed(self.name, settings.training.seed)
        plan = LocalTrainingPlan(
            settings=settings.client_training().model_copy(update={"seed": seed}),
            first_step=number * settings.local_steps,
            steps=settings.local_steps,
            optimizer_state=load_moments(self.cache, run_id, number),
            device=torch.device(self.device),
            on_step=partial(self.on_step, self.name),
        )
        if request.lesson == "revisits":
            before = weights_to_network(first_weights(self.cache, run_id, number, request.weights), encoder)
            trained = train_codes(start, self.revisits, self.inputs, plan, before)
        else:
            trained = local_training(start, self._labelled_images(request).train, plan)
        save_moments(self.cache, run_id, number, trained.optimizer_state)
        return ClientUpdate(network_to_weights(trained.network), trained.losses)

    def evaluate(self, request: TrainingRequest) -> dict[str, float]:
        """Repeatability and MMA at 3 px of the weights, shares in [0, 1], on pairs of images that are held out."""
        network = weights_to_network(request.weights, request.settings.training.encoder).to(self.device)
        pairs = validation_pairs(self._labelled_images(request).held_out)
        found = validate(network, pairs, torch.device(self.device))
        # A detector that finds nothing has no metrics; it counts as one that finds nothing again.
        return {name: found[name] if np.isfinite(found[name]) else 0.0 for name in SCORE_METRICS}

    def judge(self, request: TrainingRequest) -> Judgement:
        """A report on the pairs of keyframes that the robot holds out, with the weights, shape (P, 2)."""
        device = torch.device(self.device)
        network = weights_to_network(request.weights, request.settings.training.encoder).to(device)
        judgement: Judgement = judge(network, self.held_out, device)
        return judgement

    def _labelled_images(self, request: TrainingRequest) -> TrainingImages:
        """The images, labelled by the first weights that the robot ever received; the labels stay."""
        training = request.settings.training
        if self.images is None or self.images_settings not in (None, training):
            device = torch.device(self.device)
            labeller = keypoint_response(weights_to_network(request.weights, training.encoder).to(device), device)
            files = find_images([self.folder])
            self.images = read_labelled_images(
                files, self.cache, training, labeller, None, lambda _stage, _progress: None, self.most_images
            )
            self.images_settings = training
        return self.images


def robot_seed(robot: str, seed: int) -> int:
    """The seed of a robot, so that two robots draw different views."""
    return int(np.random.default_rng([seed, zlib.crc32(robot.encode())]).integers(2**31))
