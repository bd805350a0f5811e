"""Robots as federated clients: they train from the global weights on their own images, or on what they saw again.

A client's state lasts from round to round: the state of its optimizer, and the weights of the first round in which it
took part. No name from the server stands in a path, so no server can make a robot write elsewhere.
"""

import time
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from fcslam.errors import FcslamError, InputError, writing
from fcslam.learning.code_batches import RevisitExamples
from fcslam.learning.code_training import CodeInputs, train_codes
from fcslam.learning.federated.evaluation import SCORE_METRICS
from fcslam.learning.federated.held_out import HeldOutPairs, judge
from fcslam.learning.federated.messages import PAIRS, TrainingReply, TrainingRequest
from fcslam.learning.federated.networks import network_to_weights, weights_to_network
from fcslam.learning.federated.weights import Weights
from fcslam.learning.images import find_images
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import TrainingImages, keypoint_response, label_images, read_images
from fcslam.learning.training_loop import LocalTrainingPlan, local_training
from fcslam.learning.validation import validate, validation_pairs
from fcslam.storage.state_file import State, read_state, write_state

STATE_FILE: Final = "training.state"
Answer = tuple[Weights, Mapping[str, float]]
"""Arrays and figures: weights with the mean losses of training, or a report on held-out pairs."""
Client = Callable[[TrainingRequest], Answer]
"""A participant in federated training. An exception says why it cannot answer."""


def reply_to(request: TrainingRequest, robot: str, client: Client) -> TrainingReply:
    """A client's reply. A failure ends the request, and neither the robot nor the training of the others."""
    try:
        return TrainingReply(robot, request.version, *client(request))
    except FcslamError as error:
        return TrainingReply(robot, request.version, error=str(error))
    except Exception as error:
        return TrainingReply(robot, request.version, error=f"{type(error).__name__}: {error}")


class InProcessFleet:
    """Clients in this process, one after another.

    Every robot has the whole deadline for itself, as if all worked at the same time.
    """

    def __init__(self, clients: Mapping[str, Client], clock: Callable[[], float] = time.monotonic) -> None:
        self._clients, self._clock = clients, clock

    def robots(self) -> list[str]:
        """Names of all robots: in one process they are always connected."""
        return sorted(self._clients)

    def ask(self, robots: Collection[str], request: TrainingRequest, deadline_s: float) -> dict[str, TrainingReply]:
        """Replies of the robots that took at most the deadline each."""
        replies = {}
        for robot in robots:
            started = self._clock()
            reply = reply_to(request, robot, self._clients[robot])
            if self._clock() - started <= deadline_s:
                replies[robot] = reply
        return replies


@dataclass(slots=True)
class RobotClient:
    """What all robots have in common."""

    name: str
    cache: Path
    """Folder for what must survive a round."""
    device: str = "cpu"
    on_step: Callable[[str, int], None] = lambda _robot, _steps: None
    """Called with the name and the number of steps done in a round."""

    def _plan(self, request: TrainingRequest, state: State) -> LocalTrainingPlan:
        """The steps of a round; the optimizer continues from the latest round before it."""
        settings, number = request.settings, request.round_number
        seed = robot_seed(self.name, settings.training.seed)
        before = _round_before(state, number)
        return LocalTrainingPlan(
            settings=settings.client_training().model_copy(update={"seed": seed}),
            first_step=number * settings.local_steps,
            steps=settings.local_steps,
            optimizer_state=None if before is None else _copied(state["moments"][before]),
            device=torch.device(self.device),
            on_step=partial(self.on_step, self.name),
        )

    def _state(self, request: TrainingRequest) -> State:
        """What the client keeps of this run; nothing of a run before, or of a file that is damaged."""
        try:
            return read_state(self.cache / STATE_FILE, request.run_id) or {"moments": {}}
        except InputError:
            return {"moments": {}}

    def _keep(self, request: TrainingRequest, state: State, optimizer_state: Mapping[str, Tensor]) -> None:
        """Keep the optimizer's state, and that of the previous round: a server that was killed may repeat the round."""
        before = _round_before(state, request.round_number)
        kept = {} if before is None else {before: state["moments"][before]}
        kept[str(request.round_number)] = {name: value.cpu().numpy() for name, value in optimizer_state.items()}
        with writing(self.cache / STATE_FILE):
            self.cache.mkdir(parents=True, exist_ok=True)
            write_state(self.cache / STATE_FILE, request.run_id, {**state, "moments": kept})


@dataclass(slots=True)
class ImageClient(RobotClient):
    """A robot that trains all layers on its own images."""

    folder: Path | None = None
    """Contains the images; None if they are given."""
    images: TrainingImages | None = None
    """The images with their labels; None until they are read."""
    labelled_for: TrainingSettings | None = None
    """Settings with which the images were read; None if they were given."""

    def __call__(self, request: TrainingRequest) -> Answer:
        """Train from the weights. The result depends on the request, the cache and the images."""
        training = request.settings.training
        start = weights_to_network(request.weights, training.encoder)
        state = self._state(request)
        examples = self._labelled(request.weights, training).train
        trained, losses, optimizer_state = local_training(start.state_dict(), examples, self._plan(request, state))
        self._keep(request, state, optimizer_state)
        return network_to_weights(trained), losses

    def evaluate(self, weights: Weights, training: TrainingSettings) -> dict[str, float]:
        """Repeatability and MMA at 3 px of the weights, shares in [0, 1], on pairs of images that are held out."""
        network = weights_to_network(weights, training.encoder).to(self.device)
        pairs = validation_pairs(self._labelled(weights, training).held_out)
        found = validate(network, pairs, torch.device(self.device))
        # A detector that finds nothing has no metrics; it counts as one that finds nothing again.
        return {name: found[name] if np.isfinite(found[name]) else 0.0 for name in SCORE_METRICS}

    def _labelled(self, weights: Weights, training: TrainingSettings) -> TrainingImages:
        """The images, labelled by the first weights that the robot ever received; the labels stay."""
        if self.images is None or self.labelled_for not in (None, training):
            assert self.folder is not None
            device = torch.device(self.device)
            labeller = keypoint_response(weights_to_network(weights, training.encoder).to(device), device)
            found = read_images(find_images([self.folder]))
            self.images = label_images(found, self.cache, training, labeller)
            self.labelled_for = training
        return self.images


@dataclass(slots=True)
class RevisitClient(RobotClient):
    """A robot that trains the layers of the codes on points that it saw again; batch statistics stay as they are."""

    revisits: RevisitExamples = field(default_factory=RevisitExamples)
    inputs: CodeInputs = field(default_factory=CodeInputs)
    """Inputs from the images of ``revisits``."""
    held_out: HeldOutPairs = field(default_factory=HeldOutPairs)
    """Pairs of keyframes that are never trained on."""

    def __call__(self, request: TrainingRequest) -> Answer:
        """Train from the weights, or report on the held-out pairs with them, shape (P, 2)."""
        encoder = request.settings.training.encoder
        network = weights_to_network(request.weights, encoder)
        if not request.is_training:
            device = torch.device(self.device)
            return {PAIRS: judge(network.to(device), self.held_out, device)}, {}
        state = self._state(request)
        if request.round_number == 0 or "first" not in state:
            state["first"] = dict(request.weights)
        before = weights_to_network(state["first"], encoder)
        plan = self._plan(request, state)
        trained, losses, optimizer_state = train_codes(network.state_dict(), self.revisits, self.inputs, plan, before)
        self._keep(request, state, optimizer_state)
        return network_to_weights(trained), losses


def robot_seed(robot: str, seed: int) -> int:
    """The seed of a robot, so that two robots draw different views."""
    return int(np.random.default_rng([seed, zlib.crc32(robot.encode())]).integers(2**31))


def _round_before(state: State, round_number: int) -> str | None:
    """Key of the latest round before this one in which the robot trained."""
    return max((key for key in state["moments"] if int(key) < round_number), key=int, default=None)


def _copied(arrays: Mapping[str, Any]) -> dict[str, Tensor]:
    """Tensors that the optimizer may change in place."""
    return {name: torch.tensor(array) for name, array in arrays.items()}
