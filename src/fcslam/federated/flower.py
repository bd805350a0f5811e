"""The adapter to Flower: the only module that imports it or knows what it does not document.

It relies on internals: who sends a message, what an in-process ``Grid`` has to offer, the moments of FedAdam, the
options and configuration files of the daemons. ``tests/federated/test_flower.py`` checks each of them. To support
another version of Flower, change ``SUPPORTED_VERSIONS`` and the requirement in pyproject.toml, and make that test pass.
"""

import json
import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.tls import Address, Certificates

QUIET: Final = {
    "FLWR_TELEMETRY_ENABLED": "0",
    "FLWR_DISABLE_UPDATE_CHECK": "1",
    "FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION": "1",
}
"""Environment in which Flower sends no telemetry, looks for no newer version and installs nothing."""
os.environ.update(QUIET)  # Flower reads it when it is imported

SUPPORTED_VERSIONS: Final = ((1, 41), (1, 42))
"""The first supported version of Flower, and the first later one that is not supported."""


def check_version(version: str) -> None:
    """Refuse a version of Flower whose internals this module does not know.

    Raises:
        TrainingError: the version is not supported.
    """
    first, end = SUPPORTED_VERSIONS
    if not first <= tuple(int(part) for part in version.split(".")[:2]) < end:
        wanted = f"flwr>={'.'.join(map(str, first))},<{'.'.join(map(str, end))}"
        raise TrainingError(f"flwr {version} is installed, but fcslam needs {wanted}; pip install 'fcslam[federated]'")


check_version(installed_version("flwr"))

from flwr.app import (  # noqa: E402
    Array,
    ArrayRecord,
    ConfigRecord,
    Context,
    Error,
    Message,
    MessageType,
    MetricRecord,
    RecordDict,
)
from flwr.clientapp import ClientApp  # noqa: E402
from flwr.serverapp import Grid, ServerApp  # noqa: E402
from flwr.serverapp.strategy import (  # noqa: E402
    FedAdam,
    FedAvg,
    FedMedian,
    FedProx,
    FedTrimmedAvg,
    Krum,
)
from flwr.supercore.task_identity import TaskIdentity  # noqa: E402

logging.getLogger("flwr").setLevel(logging.ERROR)

__all__ = [
    "Array",
    "ArrayRecord",
    "ClientApp",
    "ConfigRecord",
    "Context",
    "Error",
    "FedAdam",
    "FedAvg",
    "FedMedian",
    "FedProx",
    "FedTrimmedAvg",
    "Grid",
    "InProcessGrid",
    "Krum",
    "Message",
    "MessageType",
    "MetricRecord",
    "NodeSelection",
    "RecordDict",
    "ServerApp",
    "check_version",
    "daemon_environment",
    "register_command",
    "restore_moments",
    "run_command",
    "strategy_moments",
    "superlink_command",
    "supernode_command",
    "write_app",
    "write_connection",
]

RUN_ID: Final = 1
FIRST_NODE: Final = 2
"""Node number of the first robot; Flower reserves node 1 for the server."""
APP_FAILED: Final = 1001
"""Error code of a reply from an app that raised; smaller codes are Flower's, and 1000 is the client's own."""
LOOPBACK: Final = "127.0.0.1"
CONNECTION: Final = "fleet"
"""Name of the SuperLink in the configuration of Flower's commands."""


class InProcessGrid(Grid):
    """A ``Grid`` that calls the robots' apps in this process, one after another, without ports and daemons.

    Every robot has the whole deadline for itself, as if all worked at the same time.

    Args:
        app: of the robots; ``partition-id`` in the context's node configuration is the number of the robot, from 0.
        robots: number of robots.
        clock: gives seconds since any fixed moment.
    """

    def __init__(self, app: ClientApp, robots: int, clock: Callable[[], float] = time.monotonic) -> None:
        # A message asks this class who sends it; Flower's daemons set it for their processes.
        TaskIdentity.task_id = TaskIdentity.run_id = TaskIdentity.node_id = RUN_ID
        self._app, self._clock = app, clock
        self._replies: dict[str, Message] = {}
        self._pushed = 0
        # Contexts stay from round to round, as Flower's daemons keep them.
        self._contexts = {
            FIRST_NODE + index: Context(RUN_ID, FIRST_NODE + index, {"partition-id": index}, RecordDict(), {})
            for index in range(robots)
        }

    def set_run(self, run: Any) -> None:
        """Do nothing: there is one run."""

    @property
    def run(self) -> Any:
        """None: there is no record of the run."""
        return None

    def create_message(
        self, content: RecordDict, message_type: str, dst_node_id: int, group_id: str, ttl: float | None = None
    ) -> Message:
        """A message to a robot."""
        return Message(content, dst_node_id, message_type, group_id=group_id, ttl=ttl)

    def get_node_ids(self) -> list[int]:
        """Node numbers of all robots; in one process they are always connected."""
        return list(self._contexts)

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        """Have messages answered; returns the numbers under which ``pull_messages`` gives the replies."""
        names = []
        for message in messages:
            self._pushed += 1
            names.append(str(self._pushed))
            self._replies[names[-1]] = self._ask(message)
        return names

    def pull_messages(self, message_ids: Iterable[str]) -> list[Message]:
        """Replies to these messages, each of them once."""
        return [self._replies.pop(name) for name in message_ids if name in self._replies]

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Replies of the robots that took at most ``timeout`` seconds each."""
        replies = []
        for message in messages:
            started = self._clock()
            reply = self._ask(message)
            if timeout is None or self._clock() - started <= timeout:
                replies.append(reply)
        return replies

    def _ask(self, message: Message) -> Message:
        try:
            return self._app(message, self._contexts[message.metadata.dst_node_id])
        except Exception as error:  # as across a network, one robot's failure does not end the training of the others
            return Message(Error(APP_FAILED, f"{type(error).__name__}: {error}"), reply_to=message)


class NodeSelection:
    """The nodes that a strategy may choose from: all that its ``configure_train`` uses of a ``Grid``."""

    def __init__(self, nodes: Sequence[int]) -> None:
        self._nodes = list(nodes)

    def get_node_ids(self) -> list[int]:
        """The nodes."""
        return self._nodes


def strategy_moments(strategy: FedAvg) -> dict[str, dict[str, NDArray[Any]]]:
    """FedAdam's first and second moments, each an array by name; both are empty in other strategies."""
    return {moment: getattr(strategy, moment, None) or {} for moment in ("m_t", "v_t")}


def restore_moments(strategy: FedAvg, moments: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
    """Let a new strategy continue with the moments of an earlier one."""
    for moment, arrays in moments.items():
        if arrays:
            setattr(strategy, moment, dict(arrays))


def superlink_command(address: Address, certificates: Certificates | None) -> list[str]:
    """The SuperLink's command line; without certificates it neither encrypts nor authenticates."""
    security = ["--insecure"] if certificates is None else [*_tls_options(certificates), "--enable-supernode-auth"]
    return ["flower-superlink", *security, "--host", address.host, "--port", str(address.port)]


def supernode_command(
    address: Address, node_config: Mapping[str, str], certificates: Certificates | None, private_key: Path | None
) -> list[str]:
    """A robot's SuperNode's command line, except for the port on which its own processes reach it."""
    security = ["--insecure"]
    if certificates is not None:
        security = ["--root-certificates", str(certificates.ca.resolve()), *_tls_options(certificates)]
    if private_key is not None:
        security += ["--auth-supernode-private-key", str(private_key.resolve())]
    config = " ".join(f"{name}={json.dumps(value)}" for name, value in node_config.items())
    return [
        "flower-supernode", *security, "--superlink", str(address), "--host", LOOPBACK, "--node-config", config,
    ]  # fmt: skip


def register_command(public_key: Path) -> list[str]:
    """The command that lets the robot with this key join."""
    return ["flwr", "supernode", "register", str(public_key.resolve()), CONNECTION]


def run_command(app: Path) -> list[str]:
    """The command that starts the app in this folder on the SuperLink and follows it."""
    return ["flwr", "run", str(app), CONNECTION, "--stream"]


def daemon_environment(home: Path) -> dict[str, str]:
    """The environment of Flower's commands, with their configuration in the folder ``home``."""
    return {**QUIET, "FLWR_HOME": str(home)}


def write_connection(home: Path, address: Address, certificates: Certificates | None) -> None:
    """Write the configuration with which Flower's commands find the SuperLink."""
    trust = (
        "insecure = true"
        if certificates is None
        else f"root-certificates = {json.dumps(str(certificates.ca.resolve()))}"
    )
    home.mkdir(parents=True)
    (home / "config.toml").write_text(
        f'[superlink]\ndefault = "{CONNECTION}"\n[superlink.{CONNECTION}]\naddress = "{address}"\n{trust}\n',
        encoding="utf-8",
    )


def write_app(folder: Path, server_app: str, client_app: str, config: Mapping[str, str]) -> None:
    """Write an app for ``run_command``.

    Args:
        folder: is created.
        server_app: the ``ServerApp``, as `module:name` of an installed package.
        client_app: the ``ClientApp``, as `module:name`.
        config: configuration of the run, which both apps can read.
    """
    package = folder / "fcslam_fleet"
    package.mkdir(parents=True)
    values = "\n".join(f"{name} = {json.dumps(value)}" for name, value in config.items())
    (folder / "pyproject.toml").write_text(_APP_PROJECT + values + "\n", encoding="utf-8")
    (folder / "LICENSE").write_text("Apache-2.0\n", encoding="utf-8")
    (package / "__init__.py").write_text('"""Refers to the apps of fcslam, which is installed on every machine."""\n')
    lines = []
    # Flower searches the text of this file for assignments to the names of the two apps.
    for name, target in (("server", server_app), ("robot", client_app)):
        module, _, variable = target.partition(":")
        lines.append(f"import {module}\n\n{name} = {module}.{variable}\n")
    (package / "apps.py").write_text("\n".join(lines), encoding="utf-8")


_APP_PROJECT: Final = """[build-system]
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
"""


def _tls_options(certificates: Certificates) -> list[str]:
    files = {
        "--ssl-ca-certfile": certificates.ca,
        "--ssl-certfile": certificates.certificate,
        "--ssl-keyfile": certificates.key,
    }
    return [word for option, file in files.items() for word in (option, str(file.resolve()))]
