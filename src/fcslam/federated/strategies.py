"""Flower's strategies, and what of them has to outlive a restart."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.federated.flower import FedAdam, FedAvg, FedMedian, FedProx, FedTrimmedAvg, Krum
from fcslam.federated.letters import ARRAYS, CONFIG, WEIGHT
from fcslam.federated.settings import FederatedSettings

_MOMENTS: Final = ("m_t", "v_t")
"""FedAdam's memory, by its attributes' names."""


def new_strategy(settings: FederatedSettings) -> FedAvg:
    """The strategy of these settings; it asks every robot it sees, so whoever runs it shows it those to ask."""
    everyone: dict[str, Any] = {
        "fraction_train": 1.0,
        "min_train_nodes": 1,
        "min_evaluate_nodes": 1,
        "min_available_nodes": 1,
        "weighted_by_key": WEIGHT,
        "arrayrecord_key": ARRAYS,
        "configrecord_key": CONFIG,
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


def memory_of(strategy: FedAvg) -> dict[str, NDArray[Any]]:
    """What the strategy remembers of earlier rounds, as arrays by name."""
    return {
        f"{moment}/{name}": np.asarray(array)
        for moment in _MOMENTS
        for name, array in (getattr(strategy, moment, None) or {}).items()
    }


def remember(strategy: FedAvg, memory: Mapping[str, NDArray[Any]]) -> None:
    """Give a new strategy the memory of one before."""
    for moment in _MOMENTS:
        part = {
            name.removeprefix(f"{moment}/"): array for name, array in memory.items() if name.startswith(f"{moment}/")
        }
        if part:
            setattr(strategy, moment, part)
