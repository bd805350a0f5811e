"""Screening: decides which updates of a round are aggregated.

An update must fit the network, have a plausible length, and not oppose the other updates.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from fcslam.federated.settings import ScreeningSettings
from fcslam.federated.weights import FloatVector, Weights, trained_names, update_vector, weights_error


def screen(
    updates: Mapping[str, Weights], sent: Weights, settings: ScreeningSettings, frozen: bool = False
) -> dict[str, str]:
    """The reasons why updates are refused, by robot.

    Batch statistics change many times as much as parameters, and depend on the light at each robot. So the length of
    their change is checked separately, and its direction is not checked.

    Args:
        updates: weights after training, by robot.
        sent: weights that all robots trained from.
        settings: the thresholds.
        frozen: batch statistics must come back unchanged.
    """
    refused = {robot: reason for robot, weights in updates.items() if (reason := weights_error(weights, sent))}
    parameters = trained_names(sent, frozen_statistics=True)
    statistics = [name for name in sent if name not in set(parameters)]
    for robot in [robot for robot in updates if frozen and robot not in refused]:
        if any(not np.array_equal(updates[robot][name], sent[name]) for name in statistics):
            refused[robot] = "batch statistics that were to stay as they are have changed"
    for names in (parameters, statistics):
        rest = _vectors(updates, sent, names, refused)
        refused |= _too_long(rest, float(np.linalg.norm(_vector(sent, names))), settings)
    return refused | _disagreeing(_vectors(updates, sent, parameters, refused), settings)


def _vectors(
    updates: Mapping[str, Weights], sent: Weights, names: Sequence[str], refused: Mapping[str, str]
) -> dict[str, FloatVector]:
    return {robot: update_vector(updates[robot], sent, names) for robot in updates if robot not in refused}


def _vector(weights: Weights, names: Sequence[str]) -> FloatVector:
    return update_vector(weights, {name: np.zeros_like(weights[name]) for name in names}, names)


def _too_long(updates: Mapping[str, FloatVector], size: float, settings: ScreeningSettings) -> dict[str, str]:
    lengths = {robot: float(np.linalg.norm(update)) for robot, update in updates.items()}
    limits = []
    if settings.largest_change is not None:
        limits.append(settings.largest_change * size)
    if settings.longest is not None and len(lengths) >= settings.quorum:
        limits.append(settings.longest * float(np.median(list(lengths.values()))))
    limit = min(limits, default=np.inf)
    return {
        robot: f"an update of length {length:.3g}, at most {limit:.3g}"
        for robot, length in lengths.items()
        if length > limit
    }


def _disagreeing(updates: Mapping[str, FloatVector], settings: ScreeningSettings) -> dict[str, str]:
    if settings.least_agreement is None or len(updates) < settings.quorum:
        return {}
    found = {robot: agreement(update, [each for other, each in updates.items() if other != robot])
             for robot, update in updates.items()}  # fmt: skip
    return {
        robot: f"an update that agrees too little with the others' (cosine {cosine:.2f})"
        for robot, cosine in found.items()
        if cosine < settings.least_agreement
    }


def agreement(update: FloatVector, others: Sequence[FloatVector]) -> float:
    """Cosine between an update (N,) and the coordinate-wise median of other updates; 0 if either is zero."""
    median = np.median(np.stack(others), axis=0)
    length = float(np.linalg.norm(update) * np.linalg.norm(median))
    return float(update @ median) / length if length > 0.0 else 0.0
