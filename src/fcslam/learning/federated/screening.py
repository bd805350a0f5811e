"""Screening: decides which updates of a round are aggregated.

An update must fit the network, have a plausible length, batch statistics like those of the others, and not oppose them.
Of those that are aggregated, long ones are shortened.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fcslam.learning.federated.weights import (
    BATCH_NORM_EPSILON,
    MEAN,
    VARIANCE,
    FloatVector,
    Weights,
    interpolate_weights,
    parameter_names,
    update_vector,
    weights_error,
)

QUORUM: Final = 4
"""Fewest updates in a round for which they are compared with one another."""

SMALLEST_MEDIAN: Final = 3
"""Least number of updates of which one can be recognised as an outlier."""
WORST_CHANNEL: Final = 8.0
"""A channel may be as many times as far from the median as all channels together."""
LONGER_THAN_BEFORE: Final = 2.0
"""Factor by which the previous round's length limit exceeds this round's; it holds where most updates are poisoned."""


@dataclass(frozen=True, slots=True)
class ScreeningBounds:
    """Bounds beyond which an update is refused; malformed and non-finite updates are always refused."""

    largest_change: float = 1.0
    """Largest norm of an update, as a multiple of the norm of the weights."""
    longest: float = 3.0
    """Largest norm of an update, as a multiple of the median norm in the round."""
    least_agreement: float = -0.02
    """Least cosine between an update and the mean direction of the others."""
    statistics_distance: float = 0.4
    """Largest distance of batch statistics from the median of three robots or more, in standard deviations, root mean
    square over the channels."""
    clips: bool = True
    """Whether longer updates than the median of a round are shortened to it, so that none counts for several."""


BOUNDS: Final = ScreeningBounds()


def screen(
    updates: Mapping[str, Weights],
    sent: Weights,
    bounds: ScreeningBounds,
    frozen: bool = False,
    earlier_length: float = 0.0,
) -> dict[str, str]:
    """The reasons why updates are refused, by robot.

    Batch statistics change many times as much as parameters, and depend on the light at each robot. So the length of
    their change is checked separately, and its direction is not checked. Instead they must be close to those of the
    other robots: these differ much less from one another than from the ones that were sent. ``sent`` are the weights
    that all robots trained from. ``frozen``: batch statistics must come back unchanged. ``earlier_length``:
    ``update_length`` of the previous round; 0 in the first one.
    """
    refused = {robot: reason for robot, weights in updates.items() if (reason := weights_error(weights, sent))}
    parameters = parameter_names(sent)
    statistics = [name for name in sent if name not in set(parameters)]
    for robot in [robot for robot in updates if frozen and robot not in refused]:
        if any(not np.array_equal(updates[robot][name], sent[name]) for name in statistics):
            refused[robot] = "batch statistics that were to stay as they are have changed"
    for names, earlier in ((parameters, earlier_length), (statistics, 0.0)):
        rest = _vectors(updates, sent, names, refused)
        whole = update_vector(sent, {name: np.zeros_like(sent[name]) for name in names}, names)
        refused |= _too_long(rest, float(np.linalg.norm(whole)), earlier, bounds)
    refused |= _odd_statistics(updates, refused, bounds)
    return refused | _disagreeing(_vectors(updates, sent, parameters, refused), bounds)


def clip(updates: Mapping[str, Weights], sent: Weights, bounds: ScreeningBounds) -> dict[str, Weights]:
    """The accepted updates of a round, none longer than the median (of an even number, the shorter of the two in the
    middle). Batch statistics are not changed.
    """
    names = parameter_names(sent)
    lengths = {robot: float(np.linalg.norm(each)) for robot, each in _vectors(updates, sent, names, {}).items()}
    limit = sorted(lengths.values())[(len(lengths) - 1) // 2] if bounds.clips and lengths else np.inf
    clipped = dict(updates)
    for robot in [robot for robot, length in lengths.items() if length > limit]:
        shorter = interpolate_weights(updates[robot], sent, limit / lengths[robot])
        clipped[robot] = {**updates[robot], **{name: shorter[name] for name in names}}
    return clipped


def update_length(updates: Mapping[str, Weights], sent: Weights) -> float:
    """Median norm of the accepted updates of a round, without batch statistics; 0 if none was accepted."""
    names = parameter_names(sent)
    lengths = [float(np.linalg.norm(each)) for each in _vectors(updates, sent, names, {}).values()]
    return float(np.median(lengths)) if lengths else 0.0


def _vectors(
    updates: Mapping[str, Weights], sent: Weights, names: Sequence[str], refused: Mapping[str, str]
) -> dict[str, FloatVector]:
    return {robot: update_vector(updates[robot], sent, names) for robot in updates if robot not in refused}


def _too_long(
    updates: Mapping[str, FloatVector], size: float, earlier: float, bounds: ScreeningBounds
) -> dict[str, str]:
    lengths = {robot: float(np.linalg.norm(update)) for robot, update in updates.items()}
    limit = bounds.largest_change * size
    if len(lengths) >= QUORUM:
        limit = min(limit, bounds.longest * float(np.median(list(lengths.values()))))
    if earlier > 0.0:
        bound = LONGER_THAN_BEFORE * bounds.longest * earlier
        if min(lengths.values(), default=0.0) <= bound:  # not if training itself has changed
            limit = min(limit, bound)
    return {
        robot: f"an update of length {length:.3g}, at most {limit:.3g}"
        for robot, length in lengths.items()
        if length > limit
    }


def _odd_statistics(
    updates: Mapping[str, Weights], refused: Mapping[str, str], bounds: ScreeningBounds
) -> dict[str, str]:
    rest = {robot: weights for robot, weights in updates.items() if robot not in refused}
    if len(rest) < SMALLEST_MEDIAN:
        return {}
    largest = WORST_CHANNEL * bounds.statistics_distance
    found = dict(zip(rest, statistics_distances(list(rest.values())), strict=True))
    return {
        robot: f"batch statistics {np.sqrt(np.mean(distances**2)):.2g} standard deviations from the others', "
        f"at most {bounds.statistics_distance:.2g}, and {np.max(distances):.2g} in one channel"
        for robot, distances in found.items()
        if distances.size
        and not (np.sqrt(np.mean(distances**2)) <= bounds.statistics_distance and np.max(distances) <= largest)
    }


def statistics_distances(networks: Sequence[Weights]) -> list[FloatVector]:
    """How far the batch statistics of each network are from the median of all, by channel.

    Returns:
        For each network an array (C,) over all channels: the Euclidean length of two differences, that of the means in
        standard deviations of the median, and that of the logarithms of the standard deviations.
    """
    squared: list[FloatVector] = []
    for name in (name for name in networks[0] if name.endswith(VARIANCE)):
        # The network adds the same to a variance, so smaller differences have no effect.
        variances = np.stack([network[name].astype(np.float64) for network in networks]) + BATCH_NORM_EPSILON
        middle = np.median(variances, axis=0)
        distance = (0.5 * np.log(variances / middle)) ** 2
        if (means_name := name.removesuffix(VARIANCE) + MEAN) in networks[0]:
            means = np.stack([network[means_name].astype(np.float64) for network in networks])
            distance += (means - np.median(means, axis=0)) ** 2 / middle
        squared.append(distance.reshape(len(networks), -1))
    together = np.sqrt(np.concatenate(squared, axis=1)) if squared else np.zeros((len(networks), 0))
    return list(together)


def _disagreeing(updates: Mapping[str, FloatVector], bounds: ScreeningBounds) -> dict[str, str]:
    """The updates that oppose the others. The worst one is removed before the others are compared again.

    So an update that opposes all does not spoil the direction with which honest updates are compared.
    """
    if len(updates) < QUORUM:
        return {}
    rest, refused = dict(updates), {}
    while len(rest) >= SMALLEST_MEDIAN:
        cosines = dict(zip(rest, agreements(list(rest.values())), strict=True))
        worst = min(sorted(cosines), key=cosines.__getitem__)
        if cosines[worst] >= bounds.least_agreement:
            break
        refused[worst] = f"an update that agrees too little with the others' (cosine {cosines[worst]:.2f})"
        del rest[worst]
    return refused


def agreements(updates: Sequence[FloatVector]) -> list[float]:
    """Cosine of each update (N,) with the mean direction of the other updates; 0 if either is zero.

    The mean is one of directions, so a long update has no more influence than a short one.
    """
    lengths = [float(np.linalg.norm(update)) for update in updates]
    directions = np.stack(
        [update / length if length else update for update, length in zip(updates, lengths, strict=True)]
    )
    products = directions @ directions.T
    sums = products.sum(axis=1)
    # |sum of the others|^2 = |sum of all|^2 - 2 (own direction)(sum of all) + |own direction|^2
    squares = products.sum() - 2.0 * sums + np.diag(products)
    own = sums - np.diag(products)
    return [float(part / np.sqrt(square)) if square > 1e-12 else 0.0 for part, square in zip(own, squares, strict=True)]
