"""Runs the server of a fleet on several machines, and a robot of it."""

import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from fcslam.learning.federated.client import RobotClient
from fcslam.learning.federated.client_app import build_client_app
from fcslam.learning.federated.fleet_grid import FleetGrid
from fcslam.learning.federated.fleet_robot import RobotLink, robot_context, serve_requests
from fcslam.learning.federated.fleet_server import FleetApp, listening
from fcslam.learning.federated.job import FederatedJob, ProgressCallbacks, run_job
from fcslam.learning.trainer import ExecutionOptions
from fcslam.service.http.authentication import Authenticator

WAIT_S: Final = 5.0
"""Time after which a round is tried again that could not be completed."""

OnNotice = Callable[[str], None]


def serve(
    job: FederatedJob,
    options: ExecutionOptions,
    listener: socket.socket,
    tls: tuple[Path, Path] | None,
    authenticator: Authenticator,
    callbacks: ProgressCallbacks,
    on_notice: OnNotice,
) -> list[Path]:
    """Let robots fetch requests, and train with them.

    Args:
        job: what to train.
        options: where and how the server computes.
        listener: socket on which the server listens.
        tls: PEM files of this machine's certificate and its key; None, on a private network only, for no encryption.
        authenticator: knows the robots that may join.
        callbacks: receive the progress.
        on_notice: called with one line for each kind of refused request and each reason to wait, from any thread.

    Returns:
        The files for the user, see ``run_job``.

    Raises:
        TrainingError: the training failed.
        OutputError: the run folder cannot be written.
    """
    with open_port(listener, tls, authenticator, on_notice) as grid:
        return run_job(job, options, callbacks, grid, waiting(on_notice))


def waiting(on_notice: OnNotice) -> Callable[[str], None]:
    """A function that says the reason to wait, and waits."""

    def wait(reason: str) -> None:
        on_notice(f"waiting: {reason}")
        time.sleep(WAIT_S)

    return wait


@contextlib.contextmanager
def open_port(
    listener: socket.socket,
    tls: tuple[Path, Path] | None,
    authenticator: Authenticator,
    on_notice: OnNotice,
) -> Iterator[FleetGrid]:
    """Let robots fetch requests while the block runs; arguments as for ``serve`` and ``FleetApp``."""
    grid = FleetGrid()
    with listening(FleetApp(grid, authenticator, on_notice), listener, tls):
        yield grid


def join(link: RobotLink, client: RobotClient, on_notice: OnNotice) -> None:
    """Let a robot answer a server's requests until it is interrupted. It waits for a server that is not there, or gone.

    Args:
        link: to the server.
        client: trains on the robot's images.
        on_notice: called with one line for each refused request and each reason to wait.

    Raises:
        TrainingError: the server does not accept the robot.
        CloudError: the server's certificate is not trusted.
    """
    with link:
        serve_requests(link, build_client_app(client), robot_context(), on_notice)
