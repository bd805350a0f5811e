"""Options of a robot that learns with its fleet, and their checks before anything starts."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fcslam.learning.federated.learning_process import RobotLearningPlan
    from fcslam.robot.frontend import RobotConfig
    from fcslam.wire.http_transport import Server

_LEARNING = "Learning"

LEARNING_FILE = "learning.yaml"
"""Settings of learning, in a robot's state folder or a service's data folder; each key has a default."""


Learn = Annotated[
    bool,
    typer.Option(
        "--learn",
        rich_help_panel=_LEARNING,
        help="Train the detector with the fleet on what the camera saw again: after a recording, and while a live "
        "robot stands still. No image leaves. Settings: learning.yaml in --state.",
    ),
]


def learning_plan(
    settings: "RobotConfig", server: "Server | None", credentials: Path | None, state: Path | None
) -> "RobotLearningPlan":
    """Where and how a robot learns with this service; ``state`` is its state folder.

    Raises:
        ConfigError: the settings cannot be used.
        InputError: something is missing, or does not fit.
        TrainingError: a library is missing.
    """
    from fcslam.cli.training_options import require_training_libraries
    from fcslam.config import load
    from fcslam.errors import InputError
    from fcslam.features.detector_kinds import DetectorKind
    from fcslam.learning.federated.learning_process import RobotLearningPlan
    from fcslam.learning.federated.settings import RobotLearningSettings
    from fcslam.records import Channel
    from fcslam.wire.http_transport import addresses

    if server is None or state is None:
        raise InputError(
            "a robot learns with the fleet of a service, from keyframes on its disk: give --server and --state"
        )
    if Channel.CAMERA not in settings.channels or settings.views.detector is not DetectorKind.ONNX:
        raise InputError("--learn trains the camera's network; robot.channels or robot.views.detector leave it out")
    file = state / LEARNING_FILE
    chosen = load(RobotLearningSettings, file) if file.exists() else RobotLearningSettings()
    require_training_libraries("flwr", extra="federated")
    return RobotLearningPlan(addresses(server.url)[0], chosen, state, credentials)
