"""Starts Flower's daemons for a fleet on several machines, with the apps of fcslam in them."""

import contextlib
import ctypes
import ipaddress
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
from fcslam.federated import flower
from fcslam.federated.deployed_apps import encode_job, read_status, write_status
from fcslam.federated.flower import LOOPBACK
from fcslam.federated.job import FederatedJob
from fcslam.federated.tls import Address, Certificates, check_own_certificate, check_server_certificate

START_S: Final = 180.0
"""Time for a SuperLink to listen; on a busy machine Flower's processes take minutes to start."""
GRACE_S: Final = 90.0
"""A server that has just started does not know its robots' keys yet and refuses them for a moment."""
RETRY_S: Final = 3.0
"""Time between two attempts to reach or to join a server."""
FREED_S: Final = 15.0
"""Time in which the system frees the port of a server that was killed."""
STOP_S: Final = 10.0
"""Time for a daemon to end after each signal."""
LOG_FILE: Final = "flower.log"
PR_SET_PDEATHSIG: Final = 1
"""Option of Linux's ``prctl``: the signal for a process whose parent ends. Flower's own children watch theirs."""


def serve(
    job: FederatedJob,
    device: str,
    address: Address,
    certificates: Certificates | None,
    robot_keys: Sequence[Path],
    on_poll: Callable[[], None],
) -> None:
    """Start a SuperLink, let the robots with these keys join, train, and stop it.

    Args:
        job: what to train.
        device: torch's name of the device on which the server evaluates.
        address: to listen on.
        certificates: of this machine; None, on a private network only, for no encryption and no authentication.
        robot_keys: files of the public keys of the robots that may join.
        on_poll: called about every second; the run folder shows the progress.

    Raises:
        TrainingError: the certificates do not fit, the address is taken or the robots cannot reach it, Flower does not
            start, or the training failed.
        OutputError: the run folder cannot be written.
    """
    if certificates is not None:
        check_own_certificate(certificates, address.host)
    _check_address(address)
    with tempfile.TemporaryDirectory() as place, _log(job.output / LOG_FILE) as log:
        write_status(job.output, "running", "")
        home, app = Path(place) / "home", Path(place) / "app"
        flower.write_connection(home, address, certificates)
        apps = "fcslam.federated.deployed_apps"
        flower.write_app(app, f"{apps}:server_app", f"{apps}:robot_app", {"task": encode_job(job, device)})
        environment = _environment(home)
        with _daemon(flower.superlink_command(address, certificates), environment, log) as link:
            _wait_for(address, link)
            for key in robot_keys:
                _run_command(flower.register_command(key), environment)
            with _daemon(flower.run_command(app), environment, log) as run:
                while run.poll() is None and read_status(job.output)[0] not in ("done", "failed"):
                    on_poll()
                    time.sleep(1.0)
                    if link.poll() is not None:
                        raise TrainingError(f"Flower's SuperLink ended; see {job.output / LOG_FILE}")
        on_poll()
    state, text = read_status(job.output)
    if state != "done":
        raise TrainingError(text or f"Flower's run ended; see {job.output / LOG_FILE}")


def join(
    address: Address,
    node_config: Mapping[str, str],
    certificates: Certificates | None,
    private_key: Path | None,
    log_file: Path,
    on_wait: Callable[[str], None],
) -> int:
    """Run a robot's SuperNode until it is interrupted. It waits for a server that is not there, or gone.

    Args:
        address: of the server.
        node_config: configuration of the robot, see ``deployed_apps``.
        certificates: of this machine, on which Flower's processes use TLS as well; None as in ``serve``.
        private_key: file of the private key whose public key the server has.
        log_file: receives what Flower prints.
        on_wait: called with the reason while the robot waits.

    Returns:
        0 after an interrupt, else the exit code of a SuperNode that the server does not accept.

    Raises:
        TrainingError: the certificates do not fit.
        OutputError: the folder of ``log_file`` cannot be written.
    """
    if certificates is not None:
        check_own_certificate(certificates, LOOPBACK)
    command = flower.supernode_command(address, node_config, certificates, private_key)
    refused_since = math.inf
    while True:
        _await_server(address, on_wait)
        if certificates is not None:
            check_server_certificate(address, certificates.ca)
        started = time.monotonic()
        code = _run_supernode([*command, "--port", str(free_port())], log_file)
        if code == 0:
            return code
        was_accepted = time.monotonic() - started > GRACE_S
        refused_since = math.inf if was_accepted else min(refused_since, started)
        if time.monotonic() - refused_since > GRACE_S:
            return code
        time.sleep(RETRY_S)


def _run_supernode(command: Sequence[str], log_file: Path) -> int:
    with (
        tempfile.TemporaryDirectory() as home,
        _log(log_file) as log,
        _daemon(command, _environment(Path(home)), log) as node,
    ):
        return node.wait()


def _await_server(address: Address, on_wait: Callable[[str], None]) -> None:
    while not _listens(address):
        on_wait(f"nobody listens at {address}")
        time.sleep(RETRY_S)


def _listens(address: Address) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((address.host, address.port), timeout=1.0):
        return True
    return False


def free_port() -> int:
    """A port of this machine on which no process listens."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _wait_for(address: Address, link: "subprocess.Popen[bytes]") -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end and link.poll() is None:
        if _listens(address):
            return
        time.sleep(0.2)
    raise TrainingError(f"{address}: Flower's SuperLink does not listen there; is the port free?")


def _run_command(command: Sequence[str], environment: Mapping[str, str]) -> None:
    done = subprocess.run(_installed(command), env=dict(environment), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        output = " ".join((done.stdout + done.stderr).split())
        raise TrainingError(f"{' '.join(command[:4])}: {output[-300:]}")


def _environment(home: Path) -> dict[str, str]:
    """Flower's daemons start one another by name, so this Python's commands must be on the path."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)))
    return {**os.environ, **flower.daemon_environment(home), "PATH": path}


def _installed(command: Sequence[str]) -> list[str]:
    """The command with the full path of the program that belongs to this Python."""
    program = Path(sys.executable).with_name(command[0])
    if not program.is_file():
        raise TrainingError(f"{command[0]}: is not installed beside {sys.executable}; pip install 'fcslam[federated]'")
    return [str(program), *command[1:]]


@contextlib.contextmanager
def _daemon(
    command: Sequence[str], environment: Mapping[str, str], log: IO[bytes]
) -> "Iterator[subprocess.Popen[bytes]]":
    """A process in a session of its own; when the block ends, it and its children are stopped."""
    process = subprocess.Popen(
        _installed(command),
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
                process.wait(STOP_S)


def _die_with_parent() -> None:
    """Let the daemon end with a parent that is killed; else it would keep the port, or train on unseen."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _check_address(address: Address) -> None:
    """Refuse an address at which another server would be given the robots' keys, or that robots cannot reach."""
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(address.host, address.port)}
    except (OSError, UnicodeError) as error:
        raise TrainingError(f"{address}: this machine knows no such name ({error})") from error
    if not _names_loopback(address.host) and all(map(_is_loopback, found)):
        raise TrainingError(
            f"{address}: on this machine that name means {min(found)}, which other machines cannot reach; "
            "let it mean the address that the robots use, for instance in /etc/hosts"
        )
    end = time.monotonic() + FREED_S
    while _listens(address):
        if time.monotonic() > end:
            raise TrainingError(f"{address}: another process listens there already; stop it or choose another port")
        time.sleep(0.2)


def _names_loopback(host: str) -> bool:
    """Whether the user asks for loopback or gives a literal address, of which 127.1 is one too."""
    return host.lower().startswith("localhost") or host.strip("0123456789.") == "" or ":" in host


def _is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


@contextlib.contextmanager
def _log(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for appending, and make its folder."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
    except OSError as error:
        raise OutputError(f"{path.parent}: cannot be used as the output folder ({error})") from error
    with file:
        yield file
