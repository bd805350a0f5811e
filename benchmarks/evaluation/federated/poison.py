"""Poisoned clients, for studies and tests of how well a fleet tolerates them."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fcslam.learning.federated.client import ClientUpdate, FederatedClient
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import FloatVector, Weights, trained_names, update_vector

Poison = Literal["flipped", "scaled", "reversed", "random", "nan"]
SCALE = 10.0
"""Factor of scaled and of reversed updates: large enough to dominate a mean of a few robots."""


@dataclass(frozen=True, slots=True)
class PoisonedClient:
    """Trains like another client, and falsifies its update before it leaves."""

    client: FederatedClient
    poison: Poison

    @property
    def name(self) -> str:
        """Name of the other client."""
        return self.client.name

    def train(self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings) -> ClientUpdate:
        """As in ``FederatedClient``."""
        trained = self.client.train(weights, round_number, run_id, settings)
        names = trained_names(weights, frozen_statistics=True)
        update = update_vector(trained.weights, weights, names)
        match self.poison:
            case "flipped":
                update = -update
            case "scaled":
                update = SCALE * update
            case "reversed":
                update = -SCALE * update
            case "random":
                update = np.random.default_rng([settings.training.seed, round_number]).permutation(update)
            case "nan":
                update = np.full_like(update, np.nan)
        return ClientUpdate(apply_update(weights, update, names), trained.losses)

    def evaluate(
        self, weights: Weights, round_number: int, run_id: str, settings: FederatedSettings
    ) -> dict[str, float]:
        """As in ``FederatedClient``."""
        return self.client.evaluate(weights, round_number, run_id, settings)


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
