"""Options of a robot that learns with its fleet, and their checks before anything starts."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

if TYPE_CHECKING:
    from fcslam.federated.learning_beside import RobotLearningPlan
    from fcslam.federated.tls import Address
    from fcslam.robot.frontend import RobotConfig

PORT = 8341
"""Port of learning, unless the command line names another one."""
_PANEL = "Learning"

LearnServer = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT", rich_help_panel=_PANEL, show_default=f"port {PORT} of the same machine",
        help="Address of the service's port of learning, as robots reach it.",
    ),
]  # fmt: skip
LearnConfig = Annotated[
    Path | None,
    typer.Option(help="YAML file of settings of learning; see docs/howto/federated.md.", rich_help_panel=_PANEL),
]
LearnCa = Annotated[
    Path | None,
    typer.Option(help="Certificate of the authority that signed the service's (PEM).", rich_help_panel=_PANEL),
]


class RobotLearning(NamedTuple):
    """The options of a robot that learns."""

    learn: bool
    server: str | None
    config: Path | None
    ca: Path | None
    key: Path | None

    def checked(self, localizes: bool) -> "RobotLearning":
        """The same options; those that need --learn are refused without it, and --learn of a robot that localises.

        Raises:
            InputError: there are some.
        """
        from fcslam.errors import InputError

        if not self.learn and any(self[1:]):
            raise InputError("--learn-server, --learn-config, --learn-ca and --learn-key need --learn")
        if self.learn and localizes:
            raise InputError("--learn is for a robot that maps; leave out --localize or --learn")
        return self

    def plan(
        self, name: str, settings: "RobotConfig", service: str | None, state: Path | None
    ) -> "RobotLearningPlan | None":
        """Where and how the robot of this name learns, with the service at this address; None: it does not.

        ``state`` is its state folder.

        Raises:
            ConfigError: the settings cannot be used.
            InputError: something is missing, or does not fit.
            TrainingError: a library is missing, or the address or the key cannot be read.
        """
        if not self.learn:
            return None
        from urllib.parse import urlsplit

        from fcslam.cli.federate.options import parse_address
        from fcslam.cli.training_options import require_training_libraries
        from fcslam.config import load
        from fcslam.errors import InputError
        from fcslam.features.detector_kinds import DetectorKind
        from fcslam.federated.learning_beside import RobotLearningPlan
        from fcslam.federated.live_settings import RobotLearningSettings
        from fcslam.federated.tls import Address
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
        host = urlsplit(addresses(service)[0]).hostname or "localhost"
        address = Address(host, PORT) if self.server is None else parse_address(self.server)
        self._check_key(name, address)
        return RobotLearningPlan(address.host, address.port, chosen, state, self.ca, self.key)

    def _check_key(self, name: str, address: "Address") -> None:
        from fcslam.cli.listening import is_loopback
        from fcslam.errors import InputError
        from fcslam.federated.identity import read_private_key

        if (self.ca is None) != (self.key is None):
            raise InputError("--learn-ca and --learn-key belong together; give both or neither")
        if self.ca is None and not is_loopback(address.host):
            raise InputError(f"{address} is another machine; give --learn-ca and --learn-key")
        if self.ca is not None and not self.ca.is_file():
            raise InputError(
                f"{self.ca}: is not a file; give the certificate of the authority that signed the service's"
            )
        if self.key is not None:
            read_private_key(self.key)
            if self.key.stem != name:
                raise InputError(f"{self.key}: is the key of {self.key.stem}, but the robot is called {name}")
