"""Robots that learn nothing but answer what a test wants, and how a server is run with them."""

import hashlib
import math
from dataclasses import dataclass, field, replace

import numpy as np

from fcslam.learning.federated.client import ClientUpdate
from fcslam.learning.federated.coordinator import Coordinator, CoordinatorHooks, RoundRules
from fcslam.learning.federated.fleets import InProcessFleet
from fcslam.learning.federated.screening import ScreeningBounds
from fcslam.learning.federated.settings import FederatedSettings

START = {
    "a.weight": np.arange(1.0, 7.0, dtype=np.float32).reshape(2, 3),
    "a.running_var": np.ones(2, np.float32),
    "b.weight": np.full((), 0.5, np.float32),
}
LENIENT = ScreeningBounds(math.inf, math.inf, -math.inf, math.inf)
PLAIN = RoundRules(bounds=LENIENT, momentum=0.0, smoothing=0.0, judge_every=1)


def version(weights):
    digest = hashlib.sha256()
    for name, array in sorted(weights.items()):
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:12]


def shifted(weights, by):
    return {name: (array + np.float32(by)).astype(np.float32) for name, array in weights.items()}


@dataclass
class Fake:
    """Adds ``by`` to all weights; ``answer`` replaces that."""

    name: str
    by: float = 0.1
    answer: object = None
    figures: dict = field(default_factory=lambda: {"repeatability": 0.5, "mma_3px": 0.5})
    asked: list = field(default_factory=list)

    def train(self, request):
        self.asked.append(request.round_number)
        new = self.answer(request.weights, request.round_number) if self.answer else shifted(request.weights, self.by)
        return ClientUpdate(new, {"detector": self.by})

    def evaluate(self, _request):
        return self.figures


def settings(**given):
    return FederatedSettings.model_validate({"rounds": 2, "local_steps": 1} | given)


def rules(**given):
    return replace(PLAIN, **given)


def run(robots, folder, chosen=None, fleet=None, start=START, rules=PLAIN, **given):
    reports = []
    hooks = CoordinatorHooks(
        **{
            "version": version,
            "evaluate_fn": lambda _weights: {"repeatability": 0.5, "mma_3px": 0.5},
            "on_round": reports.append,
        }
        | given
    )
    fleet = fleet or InProcessFleet(robots)
    return Coordinator(fleet, chosen or settings(), start, folder, hooks, rules).run(), reports
