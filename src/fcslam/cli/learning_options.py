"""Options of a robot that learns with its fleet, and their checks before anything starts."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fcslam.cli.server_options import ServerFlags
    from fcslam.learning.federated.learning_beside import RobotLearningPlan
    from fcslam.robot.frontend import RobotConfig

_LEARNING = "Learning"

LEARNING_FILE = "learning.yaml"
"""Settings of learning, in a robot's state folder or a service's data folder; each key has a default."""


@dataclass(frozen=True)
class LearningFlags:
    """Whether and how a robot learns with its fleet."""

    learn: Annotated[
        bool,
        typer.Option(
            "--learn", rich_help_panel=_LEARNING,
            help="Train the detector with the fleet on what the camera saw again: after a recording, and while a live "
            "robot stands still. No image leaves. Settings: learning.yaml in --state.",
        ),
    ] = False  # fmt: skip

    def plan(self, settings: "RobotConfig", server: "ServerFlags", state: Path | None) -> "RobotLearningPlan | None":
        """Where and how the robot learns, with this service; None: it does not.

        ``state`` is its state folder.

        Raises:
            ConfigError: the settings cannot be used.
            InputError: something is missing, or does not fit.
            TrainingError: a library is missing.
        """
        from fcslam.errors import InputError

        if not self.learn:
            return None
        from fcslam.cli.training_options import require_training_libraries
        from fcslam.config import load
        from fcslam.features.detector_kinds import DetectorKind
        from fcslam.learning.federated.learning_beside import RobotLearningPlan
        from fcslam.learning.federated.live_settings import RobotLearningSettings
        from fcslam.records import Channel
        from fcslam.wire.http_transport import addresses

        access = server.access()
        if access is None or state is None:
            raise InputError(
                "a robot learns with the fleet of a service, from keyframes on its disk: give --server and --state"
            )
        if Channel.CAMERA not in settings.channels or settings.views.detector is not DetectorKind.ONNX:
            raise InputError("--learn trains the camera's network; robot.channels or robot.views.detector leave it out")
        file = state / LEARNING_FILE
        chosen = load(RobotLearningSettings, file) if file.exists() else RobotLearningSettings()
        require_training_libraries("flwr", extra="federated")
        return RobotLearningPlan(addresses(access.url)[0], chosen, state, server.credentials)
