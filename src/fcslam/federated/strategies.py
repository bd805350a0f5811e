"""How updates become one: Flower's strategies, momentum between rounds, and what of both has to outlive a restart."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.flower import (
    FedAdam,
    FedAvg,
    FedMedian,
    FedProx,
    FedTrimmedAvg,
    Krum,
    Message,
    MetricRecord,
    RecordDict,
)
from fcslam.federated.messages import (
    ARRAYS_KEY,
    CONFIG_KEY,
    EXAMPLES_KEY,
    METRICS_KEY,
    record_to_weights,
    weights_to_record,
)
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights, trained_names, weights_error

_MOMENTS: Final = ("m_t", "v_t")
"""FedAdam's memory, by its attributes' names."""
_MOMENTUM: Final = "momentum"


class Aggregator:
    """One of Flower's strategies, and what it is to remember of earlier rounds."""

    def __init__(self, settings: FederatedSettings, memory: Mapping[str, NDArray[Any]]) -> None:
        self.strategy = create_strategy(settings)
        self._most = settings.server_momentum
        for moment in _MOMENTS:
            if part := _part(memory, moment):
                setattr(self.strategy, moment, part)
        # FedAdam has its own, and Krum's choice is one robot's update, as noisy as any.
        without = settings.strategy in ("fedadam", "krum") or settings.server_momentum == 0.0
        self._momentum = None if without else _part(memory, _MOMENTUM)

    @property
    def memory(self) -> dict[str, NDArray[Any]]:
        """What another one needs to go on as this one would, as arrays by name."""
        parts = {moment: getattr(self.strategy, moment, None) or {} for moment in _MOMENTS}
        parts[_MOMENTUM] = self._momentum or {}
        return {f"{part}/{name}": np.asarray(array) for part, arrays in parts.items() for name, array in arrays.items()}

    def merge(self, round_number: int, answers: Sequence[tuple[Message, Weights]], old: Weights) -> Weights:
        """The next weights, from robots' answers to ``old`` ones.

        Raises:
            TrainingError: they are unusable.
        """
        messages = []
        for message, weights in answers:
            # All did the same number of steps, so all weigh the same, whatever a robot would like to weigh.
            metrics = MetricRecord({EXAMPLES_KEY: 1.0})
            message.content = RecordDict({ARRAYS_KEY: weights_to_record(weights), METRICS_KEY: metrics})
            messages.append(message)
        record, _ = self.strategy.aggregate_train(round_number, messages)
        merged = {name: np.asarray(array, np.float32) for name, array in record_to_weights(record).items()}
        reason, onward = weights_error(merged, old), merged
        if reason is None and self._momentum is not None:
            # As far as all robots would have come one after another, at most.
            share = min(self._most, 1.0 - 1.0 / len(answers))
            onward, self._momentum = apply_server_momentum(merged, old, self._momentum, share)
            reason = weights_error(onward, old)
        if reason is not None:
            raise TrainingError(f"round {round_number}: the strategy gave unusable weights: {reason}")
        return {name: onward[name] for name in old}


def apply_server_momentum(
    merged: Weights, old: Weights, momentum: Mapping[str, NDArray[np.float32]], share: float
) -> tuple[dict[str, NDArray[np.float32]], dict[str, NDArray[np.float32]]]:
    """Weights beyond the ``merged`` ones by Nesterov's momentum, and the momentum for the next round.

    A mean of updates is less noisy than each of them and can be followed further: m <- share m + u,
    w <- w + u + share m with u = ``merged`` - ``old``, as in Douillard et al. 2023 (DiLoCo). Batch statistics are
    taken as merged: they are measured and not learnt, and variances may not turn negative.
    """
    onward, following = {name: merged[name] for name in old}, {}
    for name in trained_names(old, frozen_statistics=True):
        update = merged[name] - old[name]
        following[name] = np.asarray(update + share * momentum[name] if momentum else update, np.float32)
        onward[name] = np.asarray(merged[name] + share * following[name], np.float32)
    return onward, following


def create_strategy(settings: FederatedSettings) -> FedAvg:
    """The strategy of these settings; it asks every robot it sees, so whoever runs it shows it those to ask."""
    everyone: dict[str, Any] = {
        "fraction_train": 1.0,
        "min_train_nodes": 1,
        "min_evaluate_nodes": 1,
        "min_available_nodes": 1,
        "weighted_by_key": EXAMPLES_KEY,
        "arrayrecord_key": ARRAYS_KEY,
        "configrecord_key": CONFIG_KEY,
    }
    match settings.strategy:
        case "fedavg":
            return FedAvg(**everyone)
        case "fedprox":
            return FedProx(proximal_mu=settings.proximal, **everyone)
        case "fedadam":
            return FedAdam(eta=settings.server_rate, **everyone)
        case "fedmedian":
            return FedMedian(**everyone)
        case "fedtrimmedavg":
            return FedTrimmedAvg(beta=settings.trimmed, **everyone)
        case "krum":
            return Krum(num_malicious_nodes=settings.malicious, **everyone)


def _part(memory: Mapping[str, NDArray[Any]], part: str) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(f"{part}/"): array for name, array in memory.items() if name.startswith(f"{part}/")}
