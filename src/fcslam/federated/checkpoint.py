"""Where federated training stands, as a checkpoint."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights, weights_error
from fcslam.learning.checkpoint import Checkpoint, read_checkpoint, write_checkpoint

CHECKPOINT_FILE: Final = "checkpoint.npz"
STAGE: Final = "federated"
CHANGEABLE: Final = frozenset({"rounds", "deadline_s", "minimum_robots"})
"""Settings that a run may go on with other values of."""


@dataclass(frozen=True, slots=True)
class CoordinatorState:
    """After a round."""

    rounds_done: int
    weights: Weights
    """What the next round begins from."""
    average: Weights
    """Of the rounds' weights, the latest most of all: what is judged."""
    best: Weights
    """The released ones."""
    best_scores: Mapping[str, float]
    """By who judged them, see ``judging``."""
    best_round: int
    """The round they are of; 0 is the start."""
    memory: Mapping[str, NDArray[Any]]
    """The strategy's."""
    asked: Mapping[str, int]
    """How often each robot was: at most so many updates have left it."""
    origin: str
    """Version of the weights that everything began from."""


def run_id(settings: FederatedSettings, origin: str) -> str:
    """One for all that may go on from one checkpoint: 16 hexadecimal digits of settings and first weights."""
    return hashlib.sha256(json.dumps([_fixed(settings.model_dump(mode="json")), origin]).encode()).hexdigest()[:16]


def write_state(path: Path, state: CoordinatorState, settings: FederatedSettings) -> None:
    """Write beside the last state, then take its place.

    Raises:
        OutputError: it cannot be written; the last one stays.
    """
    numbers = {
        "best_scores": dict(state.best_scores),
        "best_round": state.best_round,
        "asked": dict(state.asked),
        "origin": state.origin,
    }
    tensors = {
        f"{group}/{name}": torch.from_numpy(np.asarray(array, order="C"))
        for group, arrays in (
            ("weights", state.weights),
            ("average", state.average),
            ("best", state.best),
            ("memory", state.memory),
        )
        for name, array in arrays.items()
    }
    header = {"settings": settings.model_dump(mode="json"), **numbers}
    write_checkpoint(path, Checkpoint(STAGE, state.rounds_done, header, tensors))


def read_state(path: Path, settings: FederatedSettings, start: Weights, origin: str) -> CoordinatorState | None:
    """The state in a file; None if there is no file. ``start`` are this run's first weights, ``origin`` names them.

    Raises:
        TrainingError: the file is no such state, or that of a run with other settings or another network.
    """
    if not path.exists():
        return None
    checkpoint = read_checkpoint(path)
    if checkpoint.stage != STAGE:
        raise TrainingError(f"{path}: is a checkpoint of other training; give another --output")
    groups: dict[str, dict[str, NDArray[Any]]] = {"weights": {}, "average": {}, "best": {}, "memory": {}}
    try:
        for key, tensor in checkpoint.tensors.items():
            group, _, name = key.partition("/")
            groups[group][name] = tensor.numpy()
        header = checkpoint.settings
        fixed = _fixed(header["settings"])
        state = CoordinatorState(
            checkpoint.step,
            groups["weights"],
            groups["average"],
            groups["best"],
            {str(judge): float(score) for judge, score in header["best_scores"].items()},
            int(header["best_round"]),
            groups["memory"],
            {str(robot): int(rounds) for robot, rounds in header["asked"].items()},
            str(header["origin"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise TrainingError(f"{path}: is no checkpoint of this version ({error}); give another --output") from error
    asked = _fixed(settings.model_dump(mode="json"))
    if odd := sorted(asked.keys() ^ fixed.keys()):
        raise TrainingError(f"{path}: is of another version of fcslam ({odd[0]}); give another --output")
    if others := sorted(name for name in asked if asked[name] != fixed[name]):
        raise TrainingError(
            f"{path}: is of a run with other settings ({', '.join(others)}); give them again, or another --output"
        )
    for group in ("weights", "average", "best"):
        reason = weights_error(groups[group], start)
        if reason is not None:
            raise TrainingError(f"{path}: its {group} do not fit this network ({reason})")
    if state.origin != origin:
        raise TrainingError(
            f"{path}: is of a run that began from {state.origin}, not from {origin}; give another --output"
        )
    return state


def _fixed(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in CHANGEABLE}
