"""Aggregation by Flower's own strategies."""

import numpy as np
import pytest

pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.learning.federated.aggregation import average
from fcslam.learning.federated.flower import flower_aggregate

RNG = np.random.default_rng(1)
UPDATES = [{"a": RNG.normal(size=(3, 4)).astype(np.float32), "b": np.full((), k, np.float32)} for k in range(5)]


def test_federated_averaging_is_ours_to_the_last_bit():
    theirs, ours = flower_aggregate("fedavg")(1, UPDATES), average(1, UPDATES)
    assert all(np.array_equal(theirs[name], ours[name]) for name in ("a", "b"))


def test_the_median_is_that_of_each_value():
    found = flower_aggregate("fedmedian")(1, UPDATES)
    assert np.array_equal(found["a"], np.median([update["a"] for update in UPDATES], axis=0))
    assert found["b"] == 2.0


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
