"""Runs the server of a fleet on several machines, and a robot of it."""

import contextlib
import ipaddress
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from fcslam.errors import TrainingError
from fcslam.federated.client import RobotClient
from fcslam.federated.client_app import build_client_app
from fcslam.federated.fleet_grid import FleetGrid
from fcslam.federated.fleet_robot import RobotLink, robot_context, serve_requests
from fcslam.federated.fleet_server import FleetApp, Teach, listening, teach_nothing
from fcslam.federated.identity import RobotAuthenticator, RobotIdentity
from fcslam.federated.job import FederatedJob, ProgressCallbacks, run_job
from fcslam.federated.tls import Address, Certificates, check_own_certificate, check_server_certificate
from fcslam.learning.trainer import ExecutionOptions

WAIT_S: Final = 5.0
"""Time after which a round is tried again that could not be completed."""
FREED_S: Final = 15.0
"""Time in which the system frees the port of a server that was killed."""
BACKLOG: Final = 128

OnNotice = Callable[[str], None]


def serve(
    job: FederatedJob,
    options: ExecutionOptions,
    address: Address,
    certificates: Certificates | None,
    authenticator: RobotAuthenticator,
    callbacks: ProgressCallbacks,
    on_notice: OnNotice,
) -> list[Path]:
    """Let robots fetch requests at the address, and train with them.

    Args:
        job: what to train.
        options: where and how the server computes.
        address: to listen on.
        certificates: of this machine; None, on a private network only, for no encryption.
        authenticator: knows the robots that may join.
        callbacks: receive the progress.
        on_notice: called with one line for each kind of refused request and each reason to wait, from any thread.

    Returns:
        The files for the user, see ``run_job``.

    Raises:
        TrainingError: the certificates do not fit, the address is taken or the robots cannot reach it, or the training
            failed.
        OutputError: the run folder cannot be written.
    """
    with open_port(address, certificates, authenticator, on_notice) as grid:
        return run_job(job, options, callbacks, grid, waiting(on_notice))


def waiting(on_notice: OnNotice) -> Callable[[str], None]:
    """A function that says the reason to wait, and waits."""

    def wait(reason: str) -> None:
        on_notice(f"waiting: {reason}")
        time.sleep(WAIT_S)

    return wait


@contextlib.contextmanager
def open_port(
    address: Address,
    certificates: Certificates | None,
    authenticator: RobotAuthenticator,
    on_notice: OnNotice,
    teach: Teach = teach_nothing,
) -> Iterator[FleetGrid]:
    """Let robots fetch requests at the address while the block runs; arguments as for ``serve`` and ``FleetApp``.

    Raises:
        TrainingError: the certificates do not fit, or the address is taken or the robots cannot reach it.
    """
    check_port(address, certificates)
    keys = authenticator.keys
    grid = FleetGrid(None if keys is None else tuple(keys))
    app = FleetApp(grid, authenticator, on_notice, teach)
    with _bound(address) as listener, listening(app, listener, certificates):
        yield grid


def check_port(address: Address, certificates: Certificates | None) -> None:
    """Check an address and its certificates before anything is started.

    Raises:
        TrainingError: the certificates do not fit, or robots cannot reach the address.
    """
    if certificates is not None:
        check_own_certificate(certificates, address.host)
    _check_name(address)


def join(address: Address, client: RobotClient, identity: RobotIdentity, ca: Path | None, on_notice: OnNotice) -> None:
    """Let a robot answer a server's requests until it is interrupted. It waits for a server that is not there, or gone.

    Args:
        address: of the server.
        client: trains on the robot's images.
        identity: of the robot.
        ca: certificate of the authority that signed the server's; None, on a private network only, for no encryption.
        on_notice: called with one line for each refused request and each reason to wait.

    Raises:
        TrainingError: the server's certificate does not fit, or the server does not accept the robot.
    """
    if ca is not None:
        check_server_certificate(address, ca)
    with RobotLink(address, identity, ca) as link:
        serve_requests(link, build_client_app(lambda _context: client), robot_context(), on_notice)


def _check_name(address: Address) -> None:
    """Refuse an address that robots cannot reach."""
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(address.host, address.port)}
    except (OSError, UnicodeError) as error:
        raise TrainingError(f"{address}: this machine knows no such name ({error})") from error
    if not _names_loopback(address.host) and all(map(_is_loopback, found)):
        raise TrainingError(
            f"{address}: on this machine that name means {min(found)}, which other machines cannot reach; "
            "let it mean the address that the robots use, for instance in /etc/hosts"
        )


def _names_loopback(host: str) -> bool:
    """Whether the user asks for loopback or gives a literal address, of which 127.1 is one too."""
    return host.lower().startswith("localhost") or host.strip("0123456789.") == "" or ":" in host


def _is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


@contextlib.contextmanager
def _bound(address: Address) -> Iterator[socket.socket]:
    """A socket that listens at the address."""
    end = time.monotonic() + FREED_S
    while True:
        try:
            family, _, _, _, place = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0]
            listener = socket.create_server(place[:2], family=family, backlog=BACKLOG)
            break
        except OSError as error:
            if time.monotonic() > end:
                raise TrainingError(f"{address}: cannot listen there ({error}); choose another port") from error
            time.sleep(0.2)
    with listener:
        yield listener
