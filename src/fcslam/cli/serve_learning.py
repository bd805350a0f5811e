"""How `fcslam serve --learn` starts the process in which its robots learn together."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from fcslam.cli.learning_options import PORT
from fcslam.cli.listening import is_loopback
from fcslam.federated.live_settings import RELEASE, RELEASES

if TYPE_CHECKING:
    from fcslam.federated.live_settings import FleetLearningSettings
    from fcslam.federated.tls import Address, Certificates
    from fcslam.service.http.state import ServiceState


class FleetLearningPlan(NamedTuple):
    """How the robots of the service learn."""

    address: "Address"
    output: Path
    command: tuple[str, ...]
    """Starts the process when the folder of missions is added to it."""


class FleetLearning(NamedTuple):
    """The options of a service whose robots learn."""

    learn: bool
    server: str | None
    config: Path | None
    ca: Path | None
    robot_keys: tuple[Path, ...]

    def plan(
        self, output: Path, host: str, tls: tuple[Path | None, Path | None], insecure: bool, store: str | None
    ) -> FleetLearningPlan | None:
        """Check all that learning needs, before anything starts; None without --learn.

        Args:
            output: folder of the rounds.
            host: on which the service listens.
            tls: certificate and key of this service.
            insecure: whether everybody may learn.
            store: database of the missions; None: they are files.

        Raises:
            ConfigError: the settings cannot be used.
            ServiceError: an option is missing, or does not fit.
            TrainingError: a library is missing, or an address, a certificate or a key cannot be used.
        """
        import sys

        from fcslam.cli.federate.options import parse_address
        from fcslam.cli.training_options import require_training_libraries
        from fcslam.errors import ServiceError

        if not self.learn:
            if any(self[1:]):
                raise ServiceError("--learn-server, --learn-config, --learn-ca and --robot-key need --learn")
            return None
        if store is not None:
            raise ServiceError("--learn follows missions in --data; leave out --store")
        settings = self._settings()
        require_training_libraries("flwr", extra="federated")
        address = parse_address(self.server or f"{host}:{PORT}")
        certificates = self._certificates(address, *tls, insecure)
        words = ["--address", address.host, str(address.port), "--settings", settings.model_dump_json()]
        words += ["--output", str(output)]
        if certificates is not None:
            words += ["--ca", str(certificates.ca), "--certificate", str(certificates.certificate)]
            words += ["--key", str(certificates.key)]
            words += [word for file in self.robot_keys for word in ("--robot-key", str(file))]
        return FleetLearningPlan(address, output, (sys.executable, "-m", "fcslam.federated.fleet_learning", *words))

    def _settings(self) -> "FleetLearningSettings":
        from fcslam.config import load
        from fcslam.errors import ServiceError
        from fcslam.federated.live_settings import FleetLearningSettings

        settings = FleetLearningSettings() if self.config is None else load(FleetLearningSettings, self.config)
        if not settings.federated.on_revisits:
            raise ServiceError(
                f"{self.config}: a fleet that maps trains on what it saw again; set federated.trained to codes or heads"
            )
        if settings.federated.privacy.noise_multiplier:
            raise ServiceError(
                f"{self.config}: robots report on held-out pairs without noise; set noise_multiplier to 0"
            )
        return settings

    def _certificates(
        self, address: "Address", certificate: Path | None, key: Path | None, insecure: bool
    ) -> "Certificates | None":
        """The certificates of the port of learning; None for no encryption."""
        from fcslam.errors import ServiceError
        from fcslam.federated.identity import read_robot_keys
        from fcslam.federated.launch import check_port
        from fcslam.federated.tls import Certificates

        read_robot_keys(self.robot_keys)
        if self.ca is not None and certificate is not None and key is not None and self.robot_keys:
            certificates = Certificates(self.ca, certificate, key)
            check_port(address, certificates)
            return certificates
        if self.ca is not None or self.robot_keys:
            raise ServiceError("--learn-ca and --robot-key belong together, with --tls-certificate and --tls-key")
        if not insecure and not is_loopback(address.host):
            raise ServiceError(
                f"everybody who reaches {address} could train; give --learn-ca and the --robot-key of each robot, with "
                "--tls-certificate and --tls-key, or --insecure"
            )
        check_port(address, None)
        return None


@contextmanager
def learning_beside(plan: FleetLearningPlan | None, state: "ServiceState") -> Iterator[None]:
    """Run the process in which the fleet learns beside the block; robots get what it releases. None: it runs none."""
    import logging
    import time

    from fcslam.errors import FcslamError
    from fcslam.service.supervisor import Supervisor

    log = logging.getLogger("fcslam.service")

    def announce(event: str, number: int) -> None:
        if event != RELEASE or plan is None:
            return
        try:
            file = state.missions.detectors.announce((plan.output / RELEASES / f"{number}.onnx").read_bytes())
        except (FcslamError, OSError) as error:
            log.error("release %d of learning cannot be announced: %s", number, error)
        else:
            log.warning("robots are to use detector %s from now on", file.version)

    if plan is None:
        yield
        return
    learner = Supervisor(state.missions.root, time.monotonic, announce, plan.command)
    typer.echo(f"robots learn at {plan.address}; rounds are in {plan.output}")
    try:
        yield
    finally:
        learner.stop()
