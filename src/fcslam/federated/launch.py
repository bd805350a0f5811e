"""Start Flower's daemons for a fleet on several machines, with our apps in them."""

import contextlib
import ctypes
import ipaddress
import json
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Final

from fcslam.errors import OutputError, TrainingError
from fcslam.federated.deployed_apps import encode_job, read_status, write_status
from fcslam.federated.flower import QUIET
from fcslam.federated.job import FederatedJob
from fcslam.federated.tls import Address, Certificates, check_own_certificate, check_server_certificate

LINK: Final = "fleet"
START_S: Final = 180.0
GRACE_S: Final = 90.0
"""A server that has just started does not know its robots' keys yet: it refuses them for a moment."""
RETRY_S: Final = 3.0
FREED_S: Final = 15.0
"""A server that was killed leaves its port within that time."""
LOG_FILE: Final = "flower.log"
LOOPBACK: Final = "127.0.0.1"
PR_SET_PDEATHSIG: Final = 1
"""Of Linux; Flower's own children watch their parents themselves."""

_APP: Final = """[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "fcslam-fleet"
version = "0.1.0"
description = "Federated training of fcslam's detector"
license = { file = "LICENSE" }
dependencies = ["flwr>=1.41.0,<2.0"]

[tool.flwr.app]
publisher = "fcslam"
fab-format-version = 1
flwr-version-target = "1.41.0"

[tool.flwr.app.components]
serverapp = "fcslam_fleet.apps:server"
clientapp = "fcslam_fleet.apps:robot"

[tool.flwr.app.config]
task = %s
"""


def serve(
    task: FederatedJob,
    device: str,
    address: Address,
    certificates: Certificates | None,
    robot_keys: Sequence[Path],
    say: Callable[[], None],
) -> None:
    """Start a SuperLink, let robots with these public keys join, train, and stop it.

    Args:
        task: what is asked.
        device: what the server judges on.
        address: to listen on.
        certificates: None for a network that nobody else is on: neither encrypted nor authenticated.
        robot_keys: public keys of the robots that may join.
        say: called about every second, to look at the run folder.

    Raises:
        TrainingError: certificates do not fit, the address is taken or out of the robots' reach, Flower does not
            start, or the training failed; the message says why.
        OutputError: the run folder cannot be written.
    """
    if certificates is not None:
        check_own_certificate(certificates, address.host)
    _check_place(address)
    with tempfile.TemporaryDirectory() as place, _log(task.output / LOG_FILE) as log:
        write_status(task.output, "running", "")
        home = Path(place)
        environment = _environment(home / "home")
        _write_app(home, encode_job(task, device), address, certificates)
        security = ["--insecure"] if certificates is None else [*certificates.options(), "--enable-supernode-auth"]
        where = ["--host", address.host, "--port", str(address.port)]
        with _daemon(["flower-superlink", *security, *where], environment, log) as link:
            _wait_for(address, link)
            for key in robot_keys:
                _flwr(["supernode", "register", str(key.resolve()), LINK], environment)
            with _daemon(["flwr", "run", str(home / "app"), LINK, "--stream"], environment, log) as run:
                while run.poll() is None and read_status(task.output)[0] not in ("done", "failed"):
                    say()
                    time.sleep(1.0)
                    if link.poll() is not None:
                        raise TrainingError(f"Flower's SuperLink ended; see {task.output / LOG_FILE}")
        say()
    state, text = read_status(task.output)
    if state != "done":
        raise TrainingError(text or f"Flower's run ended; see {task.output / LOG_FILE}")


def join(
    address: Address,
    robot: Mapping[str, str],
    certificates: Certificates | None,
    private_key: Path | None,
    log_file: Path,
    say: Callable[[str], None],
) -> int:
    """Be a robot's SuperNode until interrupted; the exit code of one that the server does not take.

    A server that is not there, or gone, is waited for.

    Args:
        address: of the server.
        robot: its configuration, see ``deployed``.
        certificates: of this machine, as Flower's processes on it talk over TLS as well; None as in ``serve``.
        private_key: of a key pair whose public half the server has.
        log_file: for what Flower says.
        say: told what is waited for.

    Raises:
        TrainingError: certificates do not fit.
        OutputError: the folder of ``log_file`` cannot be written.
    """
    security = ["--insecure"]
    if certificates is not None:
        check_own_certificate(certificates, LOOPBACK)
        security = ["--root-certificates", str(certificates.ca.resolve()), *certificates.options()]
    if private_key is not None:
        security += ["--auth-supernode-private-key", str(private_key.resolve())]
    config = " ".join(f"{name}={json.dumps(value)}" for name, value in robot.items())
    command = ["flower-supernode", *security, "--superlink", str(address), "--host", LOOPBACK, "--node-config", config]
    refused_since = math.inf
    while True:
        _await(address, say)
        if certificates is not None:
            check_server_certificate(address, certificates.ca)
        began = time.monotonic()
        code = _be_node([*command, "--port", str(free_port())], log_file)
        if code == 0:
            return code
        taken = time.monotonic() - began > GRACE_S
        refused_since = math.inf if taken else min(refused_since, began)
        if time.monotonic() - refused_since > GRACE_S:
            return code
        time.sleep(RETRY_S)


def _be_node(command: Sequence[str], log_file: Path) -> int:
    with (
        tempfile.TemporaryDirectory() as home,
        _log(log_file) as log,
        _daemon(command, _environment(Path(home)), log) as node,
    ):
        return node.wait()


def _await(address: Address, say: Callable[[str], None]) -> None:
    """Return when somebody listens there."""
    while not _listens(address):
        say(f"nobody listens at {address}")
        time.sleep(RETRY_S)


def _listens(address: Address) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((address.host, address.port), timeout=1.0):
        return True
    return False


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _write_app(home: Path, task: str, address: Address, certificates: Certificates | None) -> None:
    package = home / "app" / "fcslam_fleet"
    package.mkdir(parents=True)
    (home / "home").mkdir()
    (home / "app" / "pyproject.toml").write_text(_APP % json.dumps(task), encoding="utf-8")
    (home / "app" / "LICENSE").write_text("Apache-2.0\n", encoding="utf-8")
    (package / "__init__.py").write_text('"""fcslam\'s apps, which are installed on every machine."""\n')
    # Flower looks for assignments in the text.
    apps = "from fcslam.federated import deployed\n\nrobot = deployed.robot\nserver = deployed.server\n"
    (package / "apps.py").write_text(apps, encoding="utf-8")
    trust = (
        "insecure = true"
        if certificates is None
        else f"root-certificates = {json.dumps(str(certificates.ca.resolve()))}"
    )
    connection = f'[superlink]\ndefault = "{LINK}"\n[superlink.{LINK}]\naddress = "{address}"\n{trust}\n'
    (home / "home" / "config.toml").write_text(connection, encoding="utf-8")


def _wait_for(address: Address, link: "subprocess.Popen[bytes]") -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end and link.poll() is None:
        if _listens(address):
            return
        time.sleep(0.2)
    raise TrainingError(f"{address}: Flower's SuperLink does not listen there; is the port free?")


def _flwr(arguments: Sequence[str], environment: Mapping[str, str]) -> None:
    command = [*_program("flwr"), *arguments]
    done = subprocess.run(command, env=dict(environment), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = " ".join((done.stdout + done.stderr).split())
        raise TrainingError(f"flwr {' '.join(arguments[:2])} {arguments[2]}: {said[-300:]}")


def _environment(home: Path) -> dict[str, str]:
    """For Flower's daemons: they start one another by name, whether or not this Python's commands are on the path."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)))
    return {**os.environ, **QUIET, "FLWR_HOME": str(home), "PATH": path}


def _program(name: str) -> list[str]:
    """Flower's command that belongs to this very Python."""
    beside = Path(sys.executable).with_name(name)
    if not beside.is_file():
        raise TrainingError(f"{name}: is not installed beside {sys.executable}; pip install 'fcslam[federated]'")
    return [str(beside)]


@contextlib.contextmanager
def _daemon(
    command: Sequence[str], environment: Mapping[str, str], log: IO[bytes]
) -> "Iterator[subprocess.Popen[bytes]]":
    """A process in a session of its own, which ends with the block and takes its children with it."""
    process = subprocess.Popen(
        [*_program(command[0]), *command[1:]],
        env=dict(environment),
        stdout=log,
        stderr=log,
        start_new_session=True,
        preexec_fn=_die_with_parent if sys.platform == "linux" else None,  # noqa: PLW1509 - there are no threads yet
    )
    try:
        yield process
    finally:
        for number in (signal.SIGINT, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10.0)


def _die_with_parent() -> None:
    """A daemon whose starter is killed outright ends as well; else it would keep the port, or train on unseen."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _check_place(address: Address) -> None:
    """A SuperLink that is not ours would be given the robots' keys; one on loopback would be found by none of them."""
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(address.host, address.port)}
    except (OSError, UnicodeError) as error:
        raise TrainingError(f"{address}: this machine knows no such name ({error})") from error
    if not _means_loopback(address.host) and all(map(_is_loopback, found)):
        raise TrainingError(
            f"{address}: on this machine that name means {min(found)}, where no other machine gets to; "
            "let it mean the address that robots know, in /etc/hosts for instance"
        )
    end = time.monotonic() + FREED_S
    while _listens(address):
        if time.monotonic() > end:
            raise TrainingError(f"{address}: somebody listens there already; end that, or choose another port")
        time.sleep(0.2)


def _means_loopback(host: str) -> bool:
    """Whether that is what who wrote it wants; 127.1 is an address, too."""
    return host.lower().startswith("localhost") or host.strip("0123456789.") == "" or ":" in host


def _is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


@contextlib.contextmanager
def _log(path: Path) -> Iterator[IO[bytes]]:
    """A file to be written on, with its folder."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
    except OSError as error:
        raise OutputError(f"{path.parent}: cannot be used as the output folder ({error})") from error
    with file:
        yield file
