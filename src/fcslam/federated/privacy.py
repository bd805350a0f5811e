"""Differential privacy at the robot: its update is shortened and blurred before it leaves, and what that promises.

The mechanism is Gaussian, and what it protects is everything that a robot has seen: two robots with any other images
would send updates that differ by at most twice the clip norm. Whoever reads the network, the server included, cannot
tell which was sent but for epsilon and delta. Nobody's sampling is kept secret, so none makes the promise stronger.
"""

import math
from collections.abc import Collection
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.federated.settings import PrivacySettings
from fcslam.federated.weights import FloatVector, Weights, apply_update, update_vector

ORDERS: Final = tuple(1.0 + 10.0**exponent for exponent in np.linspace(-3.0, 4.0, 701))
"""Of the Renyi divergence; the best one is taken."""
_SENSITIVITY: Final = 2.0
"""Largest distance of two clipped updates, in clip norms."""


def clip_update(update: FloatVector, clip_norm: float) -> FloatVector:
    """The update (N,), shortened to the clip norm if it is longer."""
    length = float(np.linalg.norm(update))
    return update * (clip_norm / length) if length > clip_norm else update


def privatise_update(
    new: Weights, old: Weights, names: Collection[str], settings: PrivacySettings, rng: np.random.Generator
) -> dict[str, NDArray[np.float32]]:
    """Weights that may leave the robot: the arrays of these names are clipped and blurred, the others those of ``old``.

    Without a noise multiplier they are ``new``.
    """
    if settings.noise_multiplier == 0.0:
        return dict(new)
    update = clip_update(update_vector(new, old, names), settings.clip_norm)
    update = update + rng.normal(0.0, settings.noise_multiplier * settings.clip_norm, len(update))
    return apply_update(old, update, names)


def epsilon(noise_multiplier: float, rounds: int, delta: float) -> float:
    """What ``rounds`` updates of one robot give away of its images; infinite without noise, 0 without rounds.

    Renyi divergence of Gaussians (Mironov 2017, prop. 7), added up over the rounds, turned into (epsilon, delta) by
    theorem 21 of Balle et al. 2020.
    """
    if rounds == 0:
        return 0.0
    if noise_multiplier == 0.0:
        return math.inf
    a_round = 0.5 * (_SENSITIVITY / noise_multiplier) ** 2
    bounds = [
        rounds * a_round * order + math.log1p(-1.0 / order) - (math.log(delta) + math.log(order)) / (order - 1.0)
        for order in ORDERS
    ]
    return max(float(min(bounds)), 0.0)
