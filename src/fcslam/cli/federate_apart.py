"""`fcslam federate --serve` and `--join`: a fleet on several machines."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from fcslam.errors import TrainingError

if TYPE_CHECKING:
    from fcslam.federated.job import FederatedJob
    from fcslam.federated.tls import Address, Certificates

NEEDED = "give --ca, --certificate, --key and --robot-key, or --insecure where nobody else is on the network"


@dataclass(frozen=True, slots=True)
class Security:
    """What was given to keep others out."""

    ca: Path | None
    certificate: Path | None
    key: Path | None
    robot_keys: tuple[Path, ...]
    insecure: bool

    def checked(self) -> "Certificates | None":
        """The certificates; None if there shall be none.

        Raises:
            TrainingError: something is missing, or is no file.
        """
        from fcslam.federated.tls import Certificates

        files = [file for file in (self.ca, self.certificate, self.key, *self.robot_keys) if file is not None]
        for file in files:
            if not file.is_file():
                raise TrainingError(f"{file}: is no file; {NEEDED}")
        if self.insecure:
            if files:
                raise TrainingError("--insecure, but certificates or keys are given; leave out one or the other")
            return None
        if self.ca is None or self.certificate is None or self.key is None or not self.robot_keys:
            raise TrainingError(NEEDED)
        return Certificates(self.ca, self.certificate, self.key)


def run_server(where: str, task: "FederatedJob", device: str, security: Security, folders: list[Path]) -> None:
    """Be the server; a line for each round, and whenever it waits."""
    from rich.console import Console

    from fcslam.cli.federate import line_of
    from fcslam.cli.train import pace_on
    from fcslam.federated.deployed_apps import read_status
    from fcslam.federated.history import ROUNDS_FILE, read_rows
    from fcslam.federated.launch import serve

    if folders:
        raise TrainingError(f"{folders[0]}: with --serve robots bring their own images; --public names the server's")
    console = Console(stderr=True)
    told: set[str] = set()

    def say() -> None:
        state, why = read_status(task.output)
        lines = [
            line_of(row, task.settings.rounds) for row in read_rows(task.output / ROUNDS_FILE, task.settings.rounds)
        ]
        if state == "waiting":
            lines.append(f"waiting: {why}")
        for line in lines:
            if line not in told:
                told.add(line)
                console.print(line, highlight=False, soft_wrap=True)

    certificates = security.checked()
    chosen = pace_on(device, False).device
    serve(task, chosen, _address(where), certificates, security.robot_keys, say)
    typer.echo(str(task.output / "detector.onnx"))


def run_robot(
    where: str, folders: list[Path], output: Path, device: str, security: Security, name: str | None = None
) -> None:
    """Be a robot until interrupted, called like its folder if no ``name`` is given; a line while there is no server."""
    from rich.console import Console

    from fcslam.cli.train import pace_on
    from fcslam.federated.launch import LOG_FILE, join
    from fcslam.federated.messages import MAX_NAME_LENGTH

    if len(folders) != 1 or not folders[0].is_dir():
        raise TrainingError("--join needs one folder, that of the robot's images")
    certificates = security.checked()
    if len(security.robot_keys) > 1:
        raise TrainingError("a robot has one --robot-key, its private one")
    folder = folders[0].resolve()
    called = folder.name if name is None else name
    if not (0 < len(called) <= MAX_NAME_LENGTH and called.isprintable()):
        raise TrainingError(f"{called!r}: a robot's name has 1 to {MAX_NAME_LENGTH} printable characters; give --name")
    robot = {
        "robot": called,
        "images": str(folder),
        "labels": str((output / "labels").resolve()),
        "device": pace_on(device, False).device,
    }
    private_key = security.robot_keys[0] if security.robot_keys else None
    console, told = Console(stderr=True), set[str]()

    def say(reason: str) -> None:
        if reason not in told:
            told.add(reason)
            console.print(f"waiting: {reason}", highlight=False, soft_wrap=True)

    code = join(_address(where), robot, certificates, private_key, output / LOG_FILE, say)
    if code != 0:
        raise TrainingError(f"{where}: the server does not take this robot; see {output / LOG_FILE}")


def _address(text: str) -> "Address":
    from fcslam.federated.tls import Address

    host, colon, port = text.removeprefix("https://").removeprefix("http://").rpartition(":")
    if not (colon and host.strip("[]") and port.isdecimal() and 0 < int(port) < 65536):
        raise TrainingError(f"{text}: is no HOST:PORT")
    return Address(host.strip("[]"), int(port))
