"""Robots that learn nothing but answer what a test wants, and how a server is run with them."""

import hashlib
import math
from dataclasses import dataclass, field, replace

import numpy as np

from fcslam.learning.federated.client import InProcessFleet
from fcslam.learning.federated.coordinator import Coordinator, CoordinatorHooks, RoundRules
from fcslam.learning.federated.evaluation import PUBLIC_IMAGES, SCORE_METRICS
from fcslam.learning.federated.messages import PAIRS
from fcslam.learning.federated.screening import ScreeningBounds
from fcslam.learning.federated.settings import FederatedSettings

START = {
    "a.weight": np.arange(1.0, 7.0, dtype=np.float32).reshape(2, 3),
    "a.running_var": np.ones(2, np.float32),
    "b.weight": np.full((), 0.5, np.float32),
}
LENIENT = ScreeningBounds(math.inf, math.inf, -math.inf, math.inf, clips=False)
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
    """Adds ``by`` to all weights; ``answer`` replaces that. ``judge`` gives its report on pairs."""

    name: str
    by: float = 0.1
    answer: object = None
    judge: object = None
    asked: list = field(default_factory=list)

    def __call__(self, request):
        if not request.is_training:
            return {PAIRS: self.judge(request.weights)}, {}
        self.asked.append(request.round_number)
        new = self.answer(request.weights, request.round_number) if self.answer else shifted(request.weights, self.by)
        return new, {"detector": self.by}


def settings(**given):
    return FederatedSettings.model_validate({"rounds": 2, "local_steps": 1} | given)


def rules(**given):
    return replace(PLAIN, **given)


def fleet_of(robots):
    return InProcessFleet({robot.name: robot for robot in robots})


def run(robots, folder, chosen=None, fleet=None, start=START, rules=PLAIN, score=lambda _weights: 0.5, **given):
    """``score``: of weights, by public images."""
    reports = []

    def evaluate(weights):
        return {PUBLIC_IMAGES: dict.fromkeys(SCORE_METRICS, score(weights))}

    hooks = CoordinatorHooks(version, evaluate, reports.append, **given)
    return Coordinator(fleet or fleet_of(robots), chosen or settings(), start, folder, hooks, rules).run(), reports
