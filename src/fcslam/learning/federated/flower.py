"""Aggregation by the strategies of Flower, through its documented API.

Flower's SuperLink and SuperNode are not used: they run whatever app a caller submits, see docs/howto/federated.md.
"""

import logging
import os
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Final

import numpy as np

from fcslam.learning.federated.aggregation import Aggregate
from fcslam.learning.federated.settings import StrategyName
from fcslam.learning.federated.weights import Weights

QUIET: Final = {
    "FLWR_TELEMETRY_ENABLED": "0",
    "FLWR_DISABLE_UPDATE_CHECK": "1",
    "FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION": "1",
}
"""Environment in which Flower sends no telemetry, looks for no newer version and installs nothing."""
os.environ.update(QUIET)  # Flower reads it when it is imported

from flwr.app import Array, ArrayRecord, MetricRecord, RecordDict  # noqa: E402
from flwr.serverapp.strategy import FedAvg, FedMedian  # noqa: E402

logging.getLogger("flwr").setLevel(logging.ERROR)

StrategyFactory = Callable[..., FedAvg]
"""A subclass of Flower's FedAvg that aggregates by the replies alone. A checkpoint keeps no state of it."""


def flower_aggregate(strategy: StrategyName | StrategyFactory) -> Aggregate:
    """Aggregation by a strategy of Flower: one that the settings name, or of your own."""
    named = {"fedavg": FedAvg, "fedmedian": FedMedian}
    chosen = (named[strategy] if isinstance(strategy, str) else strategy)()

    def aggregate(round_number: int, updates: Sequence[Weights]) -> Weights:
        # The part of Flower's ``Message`` that strategies use; updates with errors are left out before.
        replies = [SimpleNamespace(content=_record(update, chosen), has_error=lambda: False) for update in updates]
        arrays, _ = chosen.aggregate_train(round_number, replies)
        return {str(name): array.numpy() for name, array in arrays.items()}

    return aggregate


def _record(update: Weights, strategy: FedAvg) -> RecordDict:
    arrays = ArrayRecord({name: Array(np.asarray(array, order="C")) for name, array in update.items()})
    # Every robot did the same number of steps, so every update has the same weight, whatever the robot says.
    metrics = MetricRecord({strategy.weighted_by_key: 1.0})
    return RecordDict({strategy.arrayrecord_key: arrays, "metrics": metrics})
