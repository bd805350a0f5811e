"""Aggregation: Flower's strategies, and momentum between rounds, which must survive a restart."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.learning.federated.flower import FedAvg, FedMedian, Message, MetricRecord, RecordDict
from fcslam.learning.federated.messages import (
    ARRAYS_KEY,
    CONFIG_KEY,
    EXAMPLES_KEY,
    METRICS_KEY,
    record_to_weights,
    weights_to_record,
)
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights, trained_names, weights_error

StrategyFactory = Callable[..., FedAvg]
"""A subclass of Flower's FedAvg, or a function that makes one from FedAvg's keyword arguments. A checkpoint keeps no
state of a strategy."""


class Aggregator:
    """One of Flower's strategies with momentum between rounds.

    ``state`` is that of an earlier aggregator to continue; empty for a new run. ``strategy`` makes a strategy in place
    of the one that the settings name.
    """

    def __init__(
        self, settings: FederatedSettings, state: Mapping[str, NDArray[Any]], strategy: StrategyFactory | None = None
    ) -> None:
        self.strategy = create_strategy(settings, strategy)
        self._largest_momentum = settings.server_momentum
        self._momentum = dict(state)

    @property
    def state(self) -> dict[str, NDArray[Any]]:
        """Arrays with which another aggregator continues as this one would, by name."""
        return self._momentum

    def aggregate(self, round_number: int, updates: Sequence[tuple[Message, Weights]], old: Weights) -> Weights:
        """The next global weights.

        ``round_number`` counts from 1, as Flower does. ``updates`` are the robots' replies that passed screening, with
        the weights in them; they trained from ``old``.

        Raises:
            TrainingError: the strategy gives weights that are not finite or do not fit the network.
        """
        messages = []
        for message, weights in updates:
            # Every robot did the same number of steps, so every update has the same weight, whatever the robot says.
            metrics = MetricRecord({EXAMPLES_KEY: 1.0})
            # Serialised again, so that the strategy reads exactly the arrays that were screened.
            message.content = RecordDict({ARRAYS_KEY: weights_to_record(weights), METRICS_KEY: metrics})
            messages.append(message)
        record, _ = self.strategy.aggregate_train(round_number, messages)
        aggregated = {name: np.asarray(array, np.float32) for name, array in record_to_weights(record).items()}
        reason, following = weights_error(aggregated, old), aggregated
        if reason is None and self._largest_momentum > 0.0:
            # Limited to the way that the robots would have gone if they had trained one after another.
            share = min(self._largest_momentum, 1.0 - 1.0 / len(updates))
            following, self._momentum = apply_server_momentum(aggregated, old, self._momentum, share)
            reason = weights_error(following, old)
        if reason is not None:
            raise TrainingError(f"round {round_number}: the strategy gave unusable weights: {reason}")
        return {name: following[name] for name in old}


def apply_server_momentum(
    aggregated: Weights, old: Weights, momentum: Mapping[str, NDArray[np.float32]], share: float
) -> tuple[dict[str, NDArray[np.float32]], dict[str, NDArray[np.float32]]]:
    """Continue beyond the aggregated weights by Nesterov's momentum, as in Douillard et al. 2023 (DiLoCo).

    A mean of updates is less noisy than each of them, so it can be followed further. With u = ``aggregated`` - ``old``:
    m <- share m + u, w <- w + u + share m. Batch statistics are taken as aggregated: they are measured and not trained,
    and variances must not become negative. ``momentum`` is empty before the first round. Returns w and m.
    """
    following, next_momentum = {name: aggregated[name] for name in old}, {}
    for name in trained_names(old, frozen_statistics=True):
        update = aggregated[name] - old[name]
        next_momentum[name] = np.asarray(update + share * momentum[name] if momentum else update, np.float32)
        following[name] = np.asarray(aggregated[name] + share * next_momentum[name], np.float32)
    return following, next_momentum


def create_strategy(settings: FederatedSettings, factory: StrategyFactory | None = None) -> FedAvg:
    """Flower's strategy for these settings, or that of ``factory``.

    It asks all nodes that it is shown; the coordinator selects them.
    """
    everyone: dict[str, Any] = {
        "fraction_train": 1.0,
        "min_train_nodes": 1,
        "min_evaluate_nodes": 1,
        "min_available_nodes": 1,
        "weighted_by_key": EXAMPLES_KEY,
        "arrayrecord_key": ARRAYS_KEY,
        "configrecord_key": CONFIG_KEY,
    }
    named: StrategyFactory = FedMedian if settings.strategy == "fedmedian" else FedAvg
    return (factory or named)(**everyone)
