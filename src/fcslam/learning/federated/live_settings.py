"""Settings of a fleet that learns while it maps."""

import math
from typing import Final

from pydantic import Field

from fcslam.config import Settings
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.settings import TrainingSettings
from fcslam.records import FloatArray

RELEASE: Final = "release"
"""The event by which the process of a learning fleet says that it has released a detector."""


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
