"""Settings of federated training, and of a fleet that learns while it maps."""

import math
from typing import Final, Literal, Self

from pydantic import Field, model_validator

from fcslam.config import Settings
from fcslam.learning.settings import TrainingSettings
from fcslam.records import FloatArray

DETECTOR: Final = "detector.onnx"
"""File of the released detector in the output folder."""

StrategyName = Literal["fedavg", "fedmedian"]
Normalisation = Literal["averaged", "frozen"]
TrainedLayers = Literal["all", "codes"]

RELEASE: Final = "release"
"""The event by which the process of a learning fleet says that it has released a detector."""


class ScreeningSettings(Settings):
    """Thresholds above which an update is refused; malformed and non-finite updates are always refused."""

    largest_change: float | None = Field(
        default=1.0,
        gt=0.0,
        description="largest norm of an update, as a multiple of the norm of the weights; null for no limit",
    )
    longest: float | None = Field(
        default=3.0,
        gt=1.0,
        description="largest norm of an update, as a multiple of the median norm in the round; null for no limit",
    )
    least_agreement: float | None = Field(
        default=-0.02,
        ge=-1.0,
        le=1.0,
        description="least cosine between an update and the mean direction of the others; null for no limit",
    )
    statistics_distance: float | None = Field(
        default=0.4,
        gt=0.0,
        description="largest distance of batch statistics from the median of three robots or more, in standard "
        "deviations, root mean square over the channels; null for no limit",
    )
    quorum: int = Field(
        default=4, ge=3, description="fewest updates in a round for which they are compared with one another"
    )


class FederatedSettings(Settings):
    """Settings of a federated training run."""

    rounds: int = Field(default=200, ge=1, description="number of rounds of local training and aggregation")
    local_steps: int = Field(
        default=10,
        ge=1,
        description="optimizer steps of each robot in a round",
    )
    judge_every: int = Field(
        default=5,
        ge=1,
        description="rounds between two evaluations; only evaluated versions and the last one can be released",
    )
    strategy: StrategyName = Field(default="fedavg", description="Flower strategy that aggregates the updates")
    participation: float = Field(
        default=1.0, gt=0.0, le=1.0, description="share of the connected robots that train in a round"
    )
    minimum_robots: int = Field(default=1, ge=1, description="fewest updates for which a round counts")
    deadline_s: float = Field(
        default=3600.0, gt=0.0, description="time for a robot's reply [s]; later replies are left out of the round"
    )
    compatible: float = Field(
        default=0.0,
        ge=0.0,
        description="weight of the loss that keeps descriptors of distorted views of a robot's images as the initial "
        "weights give them, so that they stay compatible and less is forgotten; 0 for off",
    )
    server_momentum: float = Field(
        default=0.5,
        ge=0.0,
        lt=1.0,
        description="share of Nesterov's momentum kept between rounds, at most 1 - 1/N for N robots; 0 for off",
    )
    smoothing: float = Field(
        default=0.8,
        ge=0.0,
        lt=1.0,
        description="share of earlier rounds in the moving average of which versions are made; "
        "decreases with the learning rate",
    )
    normalisation: Normalisation = Field(
        default="averaged",
        description="batch statistics: averaged over the robots like weights, or frozen at their initial values",
    )
    trained: TrainedLayers = Field(
        default="all",
        description="layers that robots train. all: every layer; codes: only those of the descriptors, on points that "
        "a robot saw again, with frozen batch statistics",
    )
    private: tuple[str, ...] = Field(
        default=(),
        description="layers that each robot trains for itself and never sends, such as body.point_head; the server "
        "keeps their initial values",
    )
    collapse: float = Field(
        default=0.15,
        gt=0.0,
        le=1.0,
        description="drop of the score below the best version at which training returns to that version",
    )
    screening: ScreeningSettings = Field(
        default_factory=ScreeningSettings, description="thresholds above which an update is refused"
    )
    training: TrainingSettings = Field(
        default_factory=TrainingSettings,
        description="training on each robot; its steps are replaced by rounds times local_steps",
    )

    @model_validator(mode="after")
    def _revisits_leave_statistics(self) -> Self:
        if self.on_revisits and self.normalisation != "frozen":
            raise ValueError(
                "batch statistics belong to the keypoints too; set normalisation to frozen, or trained to all"
            )
        return self

    @property
    def on_revisits(self) -> bool:
        """Whether robots train on what they saw again, and on no image files."""
        return self.trained != "all"

    def client_training(self) -> TrainingSettings:
        """The training settings of a robot, with the steps of the whole run."""
        return self.training.model_copy(update={"steps": self.rounds * self.local_steps})


class HeldOutSettings(Settings):
    """Keyframes that a robot never trains on."""

    every: int = Field(
        default=4, ge=2, le=20, description="one in this many squares of the robot's map is held out from training"
    )
    side_m: float = Field(default=4.0, gt=0.0, description="side of these squares [m]")

    def is_held_out(self, T_own_base: FloatArray) -> bool:
        """Whether a new keyframe at this pose in the robot's own map, shape (3,), is held out."""
        column, row = (math.floor(float(each) / self.side_m) for each in T_own_base[:2])
        # Neither a row nor a column of squares is held out as a whole, or not at all.
        return (column + (self.every // 2) * row) % self.every == 0


class GateSettings(Settings):
    """When a version of the detector is released."""

    fewest_pairs: int = Field(
        default=200,
        ge=1,
        description="fewest held-out pairs of the fleet on which a version is judged; with fewer, nothing is released. "
        "Below 200 is for tests only: the intervals of so few pairs say little",
    )
    margin: float = Field(
        default=0.05,
        ge=0.0,
        le=1.0,
        description="largest loss of places found again that the lower end of the interval may allow, as a share",
    )


class RobotLearningSettings(Settings):
    """A robot that learns while it stands still."""

    cpu_s: float = Field(default=3600.0, gt=0.0, description="CPU time that learning may take after a start [s]")
    time_s: float = Field(
        default=14_400.0, gt=0.0, description="time after the drive for which a recorded robot stays to learn [s]"
    )
    held_out: HeldOutSettings = Field(
        default_factory=HeldOutSettings, description="keyframes that the robot never trains on"
    )


LIVE_ROUNDS: Final = FederatedSettings(
    rounds=60,
    minimum_robots=2,
    deadline_s=600.0,
    normalisation="frozen",
    trained="codes",
    compatible=4.0,
    training=TrainingSettings(learning_rate=1e-3),
)
"""The recipe of the study of closures as teachers."""


class FleetLearningSettings(Settings):
    """A service whose fleet learns while it maps. A file is read over an instance, which holds the recipe."""

    federated: FederatedSettings = Field(
        default=LIVE_ROUNDS, description="rounds of training; other keys are those of the federated settings"
    )
    gate: GateSettings = Field(default_factory=GateSettings, description="release of versions")
