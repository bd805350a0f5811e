"""Settings of federated training, and of a fleet that learns while it maps."""

from typing import Final, Literal

from pydantic import Field

from fcslam.config import Settings
from fcslam.learning.settings import TrainingSettings

StrategyName = Literal["fedavg", "fedmedian"]

RELEASE: Final = "release"
"""The event by which the process of a learning fleet says that it has released a detector."""


class FederatedSettings(Settings):
    """Settings of a federated training run."""

    rounds: int = Field(default=200, ge=1, description="number of rounds of local training and aggregation")
    local_steps: int = Field(default=10, ge=1, description="optimizer steps of each robot in a round")
    strategy: StrategyName = Field(
        default="fedavg",
        description="Flower strategy that aggregates the updates of `fcslam tools federate`",
    )
    participation: float = Field(
        default=1.0, gt=0.0, le=1.0, description="share of the connected robots that train in a round"
    )
    minimum_robots: int = Field(default=1, ge=1, description="fewest updates for which a round counts")
    deadline_s: float = Field(
        default=3600.0, gt=0.0, description="time for a robot's reply [s]; later replies are left out of the round"
    )
    training: TrainingSettings = Field(
        default_factory=TrainingSettings,
        description="training on each robot; its steps are replaced by rounds times local_steps",
    )

    def client_training(self) -> TrainingSettings:
        """The training settings of a robot, with the steps of the whole run."""
        return self.training.model_copy(update={"steps": self.rounds * self.local_steps})


class RobotLearningSettings(Settings):
    """A robot that learns while it stands still."""

    cpu_s: float = Field(default=3600.0, gt=0.0, description="CPU time that learning may take after a start [s]")
    time_s: float = Field(
        default=14_400.0, gt=0.0, description="time after the drive for which a recorded robot stays to learn [s]"
    )


LIVE_ROUNDS: Final = FederatedSettings(
    rounds=60, minimum_robots=2, deadline_s=600.0, training=TrainingSettings(learning_rate=1e-3)
)
"""The recipe of the study of closures as teachers."""


class FleetLearningSettings(Settings):
    """A service whose fleet learns while it maps. A file is read over an instance, which holds the recipe."""

    federated: FederatedSettings = Field(
        default=LIVE_ROUNDS, description="rounds of training; other keys are those of the federated settings"
    )
    fewest_pairs: int = Field(
        default=200,
        ge=1,
        description="fewest held-out pairs of the fleet on which a version is judged; with fewer, nothing is released. "
        "Below 200 is for tests only: the intervals of so few pairs say little",
    )
