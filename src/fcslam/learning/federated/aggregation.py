"""Aggregation of the updates of a round, and Nesterov's momentum between rounds."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import InputError
from fcslam.learning.federated.weights import Weights, parameter_names, weights_error

Aggregate = Callable[[int, Sequence[Weights]], Weights]
"""Gives the weights of a round, counted from 1, from those of its robots."""


FEWEST_FOR_MEAN = 5
"""Fewest updates of which the mean is taken; of fewer, one that is false would have too large a share."""


def average(_round_number: int, updates: Sequence[Weights]) -> Weights:
    """Federated averaging: the mean; under five robots the median of each weight.

    Every robot did the same number of steps, so every update has the same weight.
    """
    if len(updates) < FEWEST_FOR_MEAN:
        return {name: np.median(np.stack([each[name] for each in updates]), axis=0) for name in updates[0]}
    share = 1.0 / len(updates)
    return {name: sum((each[name] * share for each in updates[1:]), updates[0][name] * share) for name in updates[0]}


def next_weights(
    aggregate: Aggregate,
    round_number: int,
    updates: Sequence[Weights],
    old: Weights,
    momentum: Weights,
    most_momentum: float,
) -> tuple[Weights, Weights]:
    """The next global weights and the momentum after the round, which is counted from 1.

    ``updates`` passed screening; they were trained from ``old``. ``momentum`` is that after the previous round; empty
    at first, and after a return to an earlier version.
    """
    aggregated = {name: np.asarray(array, np.float32) for name, array in aggregate(round_number, updates).items()}
    reason, following = weights_error(aggregated, old), aggregated
    if reason is None and most_momentum > 0.0:
        # Limited to the way that the robots would have gone if they had trained one after another.
        share = min(most_momentum, 1.0 - 1.0 / len(updates))
        following, momentum = apply_momentum(aggregated, old, momentum, share)
        reason = weights_error(following, old)
    if reason is not None:
        raise InputError(f"round {round_number}: the strategy gave unusable weights: {reason}")
    return {name: following[name] for name in old}, momentum


def apply_momentum(
    aggregated: Weights, old: Weights, momentum: Mapping[str, NDArray[np.float32]], share: float
) -> tuple[dict[str, NDArray[np.float32]], dict[str, NDArray[np.float32]]]:
    """Continue beyond the aggregated weights by Nesterov's momentum, as in Douillard et al. 2023 (DiLoCo).

    A mean of updates is less noisy than each of them, so it can be followed further. With u = ``aggregated`` - ``old``:
    m <- share m + u, w <- w + u + share m. Batch statistics are taken as aggregated: they are measured and not trained,
    and variances must not become negative. ``momentum`` is empty before the first round. Returns w and m.
    """
    following, next_momentum = {name: aggregated[name] for name in old}, {}
    for name in parameter_names(old):
        update = aggregated[name] - old[name]
        next_momentum[name] = np.asarray(update + share * momentum[name] if momentum else update, np.float32)
        following[name] = np.asarray(aggregated[name] + share * next_momentum[name], np.float32)
    return following, next_momentum
