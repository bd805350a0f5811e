"""Aggregation by Flower's own strategies."""

import numpy as np
import pytest

pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.learning.federated.flower import flower_aggregate

RNG = np.random.default_rng(1)
UPDATES = [{"a": RNG.normal(size=(3, 4)).astype(np.float32), "b": np.full((), k, np.float32)} for k in range(5)]


def test_a_strategy_of_your_own_sees_every_update():
    from flwr.serverapp.strategy import FedAvg

    class First(FedAvg):
        def aggregate_train(self, server_round, replies):
            seen.append((server_round, len(replies)))
            return super().aggregate_train(server_round, replies[:1])

    seen = []
    found = flower_aggregate(First)(3, UPDATES)
    assert np.array_equal(found["a"], UPDATES[0]["a"])
    assert seen == [(3, 5)]
