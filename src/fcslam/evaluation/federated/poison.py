"""Robots that mean harm, for studies and tests of how well a fleet bears them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fcslam.federated.client import ClientUpdate, FederatedClient
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights, apply_update, trained_names, update_vector

Poison = Literal["flipped", "scaled", "reversed", "random", "nan"]
SCALE = 10.0


@dataclass(frozen=True, slots=True)
class PoisonedClient:
    """Trains like another robot, and spoils its update before it leaves."""

    learner: FederatedClient
    poison: Poison

    @property
    def name(self) -> str:
        """As the other robot."""
        return self.learner.name

    def learn(self, weights: Weights, round_number: int, run: str, settings: FederatedSettings) -> ClientUpdate:
        """As in ``FederatedClient``."""
        learned = self.learner.learn(weights, round_number, run, settings)
        names = trained_names(weights, frozen_statistics=True)
        update = update_vector(learned.weights, weights, names)
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
        return ClientUpdate(apply_update(weights, update, names), learned.losses)

    def judge(self, weights: Weights, settings: FederatedSettings) -> dict[str, float]:
        """As in ``FederatedClient``."""
        return self.learner.judge(weights, settings)
