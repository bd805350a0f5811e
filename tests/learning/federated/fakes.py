"""Robots that learn nothing but answer what a test wants, and how a server is run with them."""

import hashlib
from dataclasses import dataclass, field

import numpy as np

from fcslam.learning.federated.client import ClientUpdate
from fcslam.learning.federated.client_app import build_client_app
from fcslam.learning.federated.coordinator import Coordinator, CoordinatorHooks
from fcslam.learning.federated.flower import InProcessGrid
from fcslam.learning.federated.settings import FederatedSettings

START = {
    "a.weight": np.arange(1.0, 7.0, dtype=np.float32).reshape(2, 3),
    "a.running_var": np.ones(2, np.float32),
    "b.weight": np.full((), 0.5, np.float32),
}


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

    def train(self, weights, round_number, _run_id, _settings):
        self.asked.append(round_number)
        new = self.answer(weights, round_number) if self.answer else shifted(weights, self.by)
        return ClientUpdate(new, {"detector": self.by})

    def evaluate(self, *_):
        return self.figures


def grid_of(robots, **extra):
    return InProcessGrid({robot.name: build_client_app(robot) for robot in robots}, **extra)


def settings(**given):
    return FederatedSettings.model_validate(
        {
            "rounds": 2,
            "local_steps": 1,
            "judge_every": 1,
            "screening": LENIENT,
            "server_momentum": 0.0,
            "smoothing": 0.0,
        }
        | given
    )


LENIENT = {"largest_change": None, "longest": None, "least_agreement": None, "statistics_distance": None}


def run(robots, folder, chosen=None, grid=None, start=START, **given):
    reports = []
    hooks = CoordinatorHooks(
        **{
            "version": version,
            "evaluate_fn": lambda _weights: {"repeatability": 0.5, "mma_3px": 0.5},
            "on_round": reports.append,
        }
        | given
    )
    coordinator = Coordinator(grid or grid_of(robots), chosen or settings(), start, folder, hooks)
    return coordinator.run(), reports
