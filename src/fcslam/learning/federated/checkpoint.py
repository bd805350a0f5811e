"""The coordinator's checkpoint: everything that federated training needs to continue."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import torch

from fcslam.errors import InputError
from fcslam.learning.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights, weights_error

CHECKPOINT_FILE: Final = "checkpoint.npz"
STAGE: Final = "federated"
GROUPS: Final = ("weights", "average", "best", "momentum")
"""Arrays of the state by their prefix in the file."""
CHANGEABLE: Final = frozenset({"rounds", "deadline_s", "minimum_robots"})
"""Settings whose values may differ when a run is continued: they do not change the rounds that are done."""


@dataclass(frozen=True, slots=True)
class CoordinatorState:
    """The state of federated training after a round."""

    rounds_done: int
    weights: Weights
    """The next round starts from these."""
    average: Weights
    """Moving average of the rounds' weights; it is evaluated and released."""
    best: Weights
    """The released weights."""
    best_scores: Mapping[str, float]
    """Scores of the released weights in [0, 1], by everyone who evaluated them (``PUBLIC_IMAGES`` or a robot)."""
    best_round: int
    """The round that made them; 0 if they are the initial weights."""
    momentum: Weights
    """Of the aggregation, carried from round to round; empty before the first one."""
    times_asked: Mapping[str, int]
    """How often each robot was asked to train: an upper bound of the updates that have left it."""
    origin: str
    """Detector version of the initial weights."""
    update_length: float = 0.0
    """Median norm of the updates of the last round, by which those of the next one are screened; 0 before the first."""

    @classmethod
    def at_start(cls, initial: Weights, version: str, scores: Mapping[str, float]) -> Self:
        """The state before the first round, from the initial weights, their version and their scores."""
        return cls(0, initial, initial, initial, scores, 0, {}, {}, version)


def run_id(settings: FederatedSettings, origin: str) -> str:
    """Identifies a run by its settings and the version of its initial weights: 16 hexadecimal digits.

    Settings in ``CHANGEABLE`` do not count, so the number stays when a run is continued.
    """
    return hashlib.sha256(json.dumps([_fixed(settings.model_dump(mode="json")), origin]).encode()).hexdigest()[:16]


def write_state(path: Path, state: CoordinatorState, settings: FederatedSettings) -> None:
    """Replace the checkpoint atomically; if it cannot be written, the last one stays."""
    groups = {name: getattr(state, name) for name in GROUPS}
    numbers = {
        "best_scores": dict(state.best_scores),
        "best_round": state.best_round,
        "asked": dict(state.times_asked),
        "origin": state.origin,
        "update_length": state.update_length,
    }
    tensors = {
        f"{group}/{name}": torch.from_numpy(np.asarray(array, order="C"))
        for group, arrays in groups.items()
        for name, array in arrays.items()
    }
    header = {"settings": settings.model_dump(mode="json"), **numbers}
    write_checkpoint(path, Checkpoint(STAGE, state.rounds_done, header, tensors))


def read_state(path: Path, settings: FederatedSettings, initial: Weights, origin: str) -> CoordinatorState | None:
    """The state in a checkpoint of this run; None if there is no file.

    ``initial`` and ``origin``: the weights that the run starts from, and their detector version.
    """
    if not path.exists():
        return None
    checkpoint = read_checkpoint(path)
    if checkpoint.stage != STAGE:
        raise InputError(f"{path}: is not a checkpoint of federated training; give another --output")
    groups = {
        group: {name: tensor.numpy() for name, tensor in checkpoint.part(f"{group}/").items()} for group in GROUPS
    }
    try:
        header = checkpoint.settings
        fixed = _fixed(header["settings"])
        state = CoordinatorState(
            rounds_done=checkpoint.step,
            **groups,
            best_scores={str(evaluator): float(score) for evaluator, score in header["best_scores"].items()},
            best_round=int(header["best_round"]),
            times_asked={str(robot): int(rounds) for robot, rounds in header["asked"].items()},
            origin=str(header["origin"]),
            update_length=float(header["update_length"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path}: is not a checkpoint of this version of fcslam ({error}); give another --output"
        ) from error
    asked = _fixed(settings.model_dump(mode="json"))
    others = sorted(name for name in asked.keys() | fixed.keys() if asked.get(name) != fixed.get(name))
    if others:
        raise InputError(
            f"{path}: belongs to a run with other settings ({', '.join(others)}); give the same or another --output"
        )
    for group in ("weights", "average", "best"):
        reason = weights_error(groups[group], initial)
        if reason is not None:
            raise InputError(f"{path}: its {group} do not fit this network ({reason})")
    if state.origin != origin:
        raise InputError(
            f"{path}: belongs to a run that began from {state.origin}, not from {origin}; give another --output"
        )
    return state


def _fixed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that must stay when a run is continued."""
    return {name: value for name, value in settings.items() if name not in CHANGEABLE}
