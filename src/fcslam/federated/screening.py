"""Which updates of a round may be averaged: sound, of a plausible length, and not against all others."""

from collections.abc import Mapping, Sequence

import numpy as np

from fcslam.federated.settings import ScreeningSettings
from fcslam.federated.weights import FloatVector, Weights, trained_names, update_vector, weights_error


def screen(
    answers: Mapping[str, Weights], asked: Weights, settings: ScreeningSettings, frozen: bool = False
) -> dict[str, str]:
    """Reasons by robot for every answer that is refused; ``asked`` are the weights that all began from.

    With ``frozen`` batch statistics are to come back as they were sent.

    Batch statistics move many times as far as what is trained, and each robot's lie where its own light puts them:
    their length is looked at by itself, and their direction not at all.
    """
    refused = {robot: reason for robot, weights in answers.items() if (reason := weights_error(weights, asked))}
    parameters = trained_names(asked, frozen_statistics=True)
    statistics = [name for name in asked if name not in set(parameters)]
    for robot in [robot for robot in answers if frozen and robot not in refused]:
        if any(not np.array_equal(answers[robot][name], asked[name]) for name in statistics):
            refused[robot] = "batch statistics that were to stay as they are have changed"
    for names in (parameters, statistics):
        rest = _updates(answers, asked, names, refused)
        refused |= _too_long(rest, float(np.linalg.norm(_vector(asked, names))), settings)
    return refused | _against_the_others(_updates(answers, asked, parameters, refused), settings)


def _updates(
    answers: Mapping[str, Weights], asked: Weights, names: Sequence[str], refused: Mapping[str, str]
) -> dict[str, FloatVector]:
    return {robot: update_vector(answers[robot], asked, names) for robot in answers if robot not in refused}


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


def _against_the_others(updates: Mapping[str, FloatVector], settings: ScreeningSettings) -> dict[str, str]:
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
    """Cosine of an update (N,) with the median of others, coordinate by coordinate; 0 if either is zero."""
    median = np.median(np.stack(others), axis=0)
    length = float(np.linalg.norm(update) * np.linalg.norm(median))
    return float(update @ median) / length if length > 0.0 else 0.0
