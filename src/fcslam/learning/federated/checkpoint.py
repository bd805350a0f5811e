"""The coordinator's checkpoint: everything that federated training needs to continue."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from fcslam.errors import InputError, writing
from fcslam.learning.federated.rounds import Row
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights, weights_error
from fcslam.learning.trainer import CHECKPOINT_FILE, CHECKPOINT_FORMAT
from fcslam.storage.state_file import read_state, write_state

CHANGEABLE: Final = frozenset({"rounds", "deadline_s", "minimum_robots"})
"""Settings whose values may differ when a run is continued: they do not change the rounds that are done."""


@dataclass(frozen=True, slots=True)
class CoordinatorState:
    """The state of federated training after a round."""

    weights: Weights
    """The next round starts from these."""
    average: Weights
    """Moving average of the rounds' weights; it is evaluated and released."""
    best: Weights
    """The released weights."""
    origin: str
    """Detector version of the initial weights."""
    rounds_done: int = 0
    best_round: int = 0
    """The round that made the released weights; 0 if they are the initial ones."""
    momentum: Weights = field(default_factory=dict)
    """Momentum of the aggregation, carried from round to round; empty before the first one."""
    times_asked: Mapping[str, int] = field(default_factory=dict)
    """How often each robot was asked to train: an upper bound of the updates that have left it."""
    update_length: float = 0.0
    """Median norm of the updates of the last round, by which those of the next one are screened; 0 before the first."""
    rows: Sequence[Row] = ()
    """The table of rounds."""


def run_id(settings: FederatedSettings, origin: str) -> str:
    """Identifies a run by its settings and the version of its initial weights: 16 hexadecimal digits.

    Settings in ``CHANGEABLE`` do not count, so the number stays when a run is continued.
    """
    return hashlib.sha256(json.dumps([_fixed(settings.model_dump(mode="json")), origin]).encode()).hexdigest()[:16]


def write_checkpoint(folder: Path, state: CoordinatorState, settings: FederatedSettings) -> None:
    """Replace the checkpoint atomically; if it cannot be written, the last one stays."""
    content = {each.name: getattr(state, each.name) for each in fields(state)}
    with writing(folder / CHECKPOINT_FILE):
        folder.mkdir(parents=True, exist_ok=True)
        write_state(
            folder / CHECKPOINT_FILE, CHECKPOINT_FORMAT, content | {"settings": settings.model_dump(mode="json")}
        )


def read_checkpoint(
    folder: Path, settings: FederatedSettings, initial: Weights, origin: str
) -> CoordinatorState | None:
    """The state in a checkpoint of this run; None if there is no file.

    ``initial`` and ``origin``: the weights that the run starts from, and their detector version.
    """
    path = folder / CHECKPOINT_FILE
    content = read_state(path, CHECKPOINT_FORMAT)
    if content is None:
        return None
    if "origin" not in content:
        raise InputError(f"{path}: is not a checkpoint of federated training; give another --output")
    fixed, asked = _fixed(content.pop("settings")), _fixed(settings.model_dump(mode="json"))
    others = sorted(name for name in asked.keys() | fixed.keys() if asked.get(name) != fixed.get(name))
    if others:
        raise InputError(
            f"{path}: belongs to a run with other settings ({', '.join(others)}); give the same or another --output"
        )
    reason = weights_error(content["weights"], initial)
    if reason is not None:
        raise InputError(f"{path}: its weights do not fit this network ({reason})")
    if content["origin"] != origin:
        raise InputError(
            f"{path}: belongs to a run that began from {content['origin']}, not from {origin}; give another --output"
        )
    return CoordinatorState(**content)


def _fixed(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in CHANGEABLE}
