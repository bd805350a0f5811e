"""Federated training with a strategy of your own: each round leaves out the update that is furthest from the median.

    python examples/own_strategy.py OUTPUT ROBOT1 ROBOT2 ROBOT3

Each ROBOT is a folder of images, which only this robot reads. Give more rounds and steps to learn something.
"""

import sys
from pathlib import Path

import numpy as np
from flwr.serverapp.strategy import FedAvg

from fcslam.learning.federated.coordinator import RoundRules
from fcslam.learning.federated.flower import flower_aggregate
from fcslam.learning.federated.job import FederatedJob, federate_locally
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.settings import TrainingSettings

TRAINING = TrainingSettings(pairs=1, side_px=64, label_copies=1)
SETTINGS = FederatedSettings(rounds=2, local_steps=2, training=TRAINING)


class WithoutFurthest(FedAvg):
    def aggregate_train(self, server_round, replies):
        replies = list(replies)
        arrays = [reply.content[self.arrayrecord_key].values() for reply in replies]
        weights = np.stack([np.concatenate([array.numpy().ravel() for array in record]) for record in arrays])
        distances = np.linalg.norm(weights - np.median(weights, axis=0), axis=1)
        print(f"round {server_round}: distances {np.round(np.sort(distances), 3)}, leaves out the last")
        del replies[int(np.argmax(distances))]
        return super().aggregate_train(server_round, replies)


if __name__ == "__main__":
    job = FederatedJob(Path(sys.argv[1]), SETTINGS, rules=RoundRules(flower_aggregate(WithoutFurthest)))
    print(*federate_locally([Path(folder) for folder in sys.argv[2:]], job), sep="\n")
