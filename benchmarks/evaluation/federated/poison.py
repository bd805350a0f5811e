"""Poisoned clients, for studies and tests of how well a fleet tolerates them."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fcslam.learning.federated.client import Answer, Client
from fcslam.learning.federated.messages import TrainingRequest
from fcslam.learning.federated.weights import FloatVector, Weights, parameter_names, update_vector

Poison = Literal["flipped", "scaled", "reversed", "random", "nan"]
SCALE = 10.0
"""Factor of scaled and of reversed updates: large enough to dominate a mean of a few robots."""


@dataclass(frozen=True, slots=True)
class PoisonedClient:
    """Trains like another client, and falsifies its update before it leaves."""

    client: Client
    poison: Poison
    name: str = ""

    def __call__(self, request: TrainingRequest) -> Answer:
        arrays, losses = self.client(request)
        if not request.is_training:
            return arrays, losses
        weights, names = request.weights, parameter_names(request.weights)
        update = update_vector(arrays, weights, names)
        match self.poison:
            case "flipped":
                update = -update
            case "scaled":
                update = SCALE * update
            case "reversed":
                update = -SCALE * update
            case "random":
                update = np.random.default_rng([request.settings.training.seed, request.round_number]).permutation(
                    update
                )
            case "nan":
                update = np.full_like(update, np.nan)
        return apply_update(weights, update, names), losses


def apply_update(old: Weights, update: FloatVector, names: Collection[str]) -> dict[str, NDArray[np.float32]]:
    """``old`` with ``update`` (N,) of ``update_vector`` added to the named arrays."""
    arrays = {name: array.copy() for name, array in old.items()}
    begin = 0
    for name in names:
        size = old[name].size
        step = update[begin : begin + size].reshape(old[name].shape)
        arrays[name] = (old[name] + step).astype(np.float32)
        begin += size
    return arrays
