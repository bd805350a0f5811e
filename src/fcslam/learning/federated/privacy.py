"""Differential privacy at the robot: the Gaussian mechanism, applied before an update leaves the robot.

It protects all images of a robot together. With any other images the robot would send an update that differs by at
most twice the clip norm. So whoever reads the weights, including the server, can tell two such sets of images apart
only as far as epsilon and delta allow. The sampling of robots is public, so it does not strengthen the guarantee.
"""

import math
from collections.abc import Collection
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.learning.federated.settings import PrivacySettings
from fcslam.learning.federated.weights import FloatVector, Weights, apply_update, update_vector

ORDERS: Final = tuple(1.0 + 10.0**exponent for exponent in np.linspace(-3.0, 4.0, 701))
"""Orders of the Renyi divergence; epsilon is the lowest bound over all of them."""
_SENSITIVITY: Final = 2.0
"""Largest distance between two clipped updates [clip norms]."""


def clip_update(update: FloatVector, clip_norm: float) -> FloatVector:
    """The update (N,), scaled down to the clip norm if its Euclidean norm is larger."""
    length = float(np.linalg.norm(update))
    return update * (clip_norm / length) if length > clip_norm else update


def privatise_update(
    new: Weights, old: Weights, names: Collection[str], settings: PrivacySettings, rng: np.random.Generator
) -> dict[str, NDArray[np.float32]]:
    """The weights that leave the robot.

    Args:
        new: weights after training.
        old: weights before training.
        names: arrays that were trained; all others are taken from ``old``.
        settings: clip norm and noise; with a noise multiplier of 0 the result is ``new``.
        rng: source of the noise.
    """
    if settings.noise_multiplier == 0.0:
        return dict(new)
    update = clip_update(update_vector(new, old, names), settings.clip_norm)
    update = update + rng.normal(0.0, settings.noise_multiplier * settings.clip_norm, len(update))
    return apply_update(old, update, names)


def epsilon(noise_multiplier: float, rounds: int, delta: float) -> float:
    """Privacy loss of a robot after ``rounds`` updates; infinite without noise, 0 without rounds.

    The Renyi divergence of Gaussians (Mironov 2017, prop. 7) is summed over the rounds and converted to (epsilon,
    delta) by theorem 21 of Balle et al. 2020.
    """
    if rounds == 0:
        return 0.0
    if noise_multiplier == 0.0:
        return math.inf
    per_round = 0.5 * (_SENSITIVITY / noise_multiplier) ** 2
    bounds = [
        rounds * per_round * order + math.log1p(-1.0 / order) - (math.log(delta) + math.log(order)) / (order - 1.0)
        for order in ORDERS
    ]
    return max(float(min(bounds)), 0.0)
