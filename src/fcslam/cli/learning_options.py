"""Options of a robot that learns with its fleet, and their checks before anything starts."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

if TYPE_CHECKING:
    from fcslam.learning.federated.learning_beside import RobotLearningPlan
    from fcslam.robot.frontend import RobotConfig

LearnConfig = Annotated[
    Path | None,
    typer.Option(help="YAML file of settings of learning; see docs/howto/federated.md.", rich_help_panel="Learning"),
]


class RobotLearning(NamedTuple):
    """The options of a robot that learns; it shows the service who it is as it does for its packets."""

    learn: bool
    config: Path | None
    token_file: Path | None
    ca: Path | None
    own: tuple[Path, Path] | None
    """Its certificate and the key."""

    def checked(self, localizes: bool) -> "RobotLearning":
        """The same options; settings without --learn are refused, and --learn of a robot that localises.

        Raises:
            InputError: there are some.
        """
        from fcslam.errors import InputError

        if not self.learn and self.config is not None:
            raise InputError("--learn-config needs --learn")
        if self.learn and localizes:
            raise InputError("--learn is for a robot that maps; leave out --localize or --learn")
        return self

    def plan(self, settings: "RobotConfig", service: str | None, state: Path | None) -> "RobotLearningPlan | None":
        """Where and how the robot learns, with the service at this address; None: it does not.

        ``state`` is its state folder.

        Raises:
            ConfigError: the settings cannot be used.
            InputError: something is missing, or does not fit.
            TrainingError: a library is missing.
        """
        if not self.learn:
            return None
        from fcslam.cli.training_options import require_training_libraries
        from fcslam.config import load
        from fcslam.errors import InputError
        from fcslam.features.detector_kinds import DetectorKind
        from fcslam.learning.federated.learning_beside import RobotLearningPlan
        from fcslam.learning.federated.live_settings import RobotLearningSettings
        from fcslam.records import Channel
        from fcslam.wire.http_transport import addresses

        if service is None or state is None:
            raise InputError(
                "a robot learns with the fleet of a service, from keyframes on its disk: give --server and --state"
            )
        if Channel.CAMERA not in settings.channels or settings.views.detector is not DetectorKind.ONNX:
            raise InputError("--learn trains the camera's network; robot.channels or robot.views.detector leave it out")
        chosen = RobotLearningSettings() if self.config is None else load(RobotLearningSettings, self.config)
        require_training_libraries("flwr", extra="federated")
        return RobotLearningPlan(addresses(service)[0], chosen, state, self.token_file, self.ca, self.own)
