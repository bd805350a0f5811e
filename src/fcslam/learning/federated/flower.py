"""The adapter to Flower: the only module that imports it or knows what it does not document.

It relies on internals: who sends a message, how a message is serialised, what a strategy
asks of a ``Grid``.
``tests/learning/federated/test_flower.py`` checks each of them. To support another version of Flower, change
``SUPPORTED_VERSIONS`` and the requirement in pyproject.toml, and make that test pass.

Flower's SuperLink and SuperNode are not used. They run whatever app a caller submits, and their Control API asks for no
credentials; see docs/howto/federated.md.
"""

import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version as installed_version
from typing import Final, Protocol

from fcslam.errors import TrainingError

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
from flwr.common.serde import message_from_proto, message_to_proto  # noqa: E402
from flwr.proto.message_pb2 import Message as MessageProto  # noqa: E402
from flwr.serverapp.strategy import FedAvg, FedMedian  # noqa: E402
from flwr.supercore.task_identity import TaskIdentity  # noqa: E402

logging.getLogger("flwr").setLevel(logging.ERROR)

__all__ = [
    "FIRST_NODE",
    "RUN_ID",
    "Array",
    "ArrayRecord",
    "ClientApp",
    "ConfigRecord",
    "Context",
    "Error",
    "FedAvg",
    "FedMedian",
    "InProcessGrid",
    "Message",
    "MessageType",
    "MetricRecord",
    "NodeSelection",
    "RecordDict",
    "RobotGrid",
    "check_version",
    "error_reply",
    "message_to_bytes",
    "reply_from_bytes",
    "request_from_bytes",
    "use_own_identity",
]

RUN_ID: Final = 1
FIRST_NODE: Final = 2
"""Node number of the first robot; Flower reserves node 1 for the server."""
APP_FAILED: Final = 1001
"""Error code of a reply from an app that raised; smaller codes are Flower's, and 1000 is the client's own."""


def use_own_identity() -> None:
    """Say who sends the messages of this process, which a message asks; Flower's daemons do so for their processes."""
    TaskIdentity.task_id = TaskIdentity.run_id = TaskIdentity.node_id = RUN_ID


class RobotGrid(Protocol):
    """What carries the coordinator's messages to the robots: the part of Flower's ``Grid`` that is needed."""

    def nodes(self) -> dict[str, int]:
        """Node numbers of the connected robots, by their names."""

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """The replies to messages that arrive within ``timeout`` seconds."""


class InProcessGrid:
    """Calls the robots' apps in this process, one after another, without ports and daemons.

    Every robot has the whole deadline for itself, as if all worked at the same time.
    """

    def __init__(self, apps: Mapping[str, ClientApp], clock: Callable[[], float] = time.monotonic) -> None:
        use_own_identity()
        self._clock = clock
        self._nodes = {name: node for node, name in enumerate(apps, FIRST_NODE)}
        self._apps = dict(enumerate(apps.values(), FIRST_NODE))
        # Contexts stay from round to round, as Flower's daemons keep them.
        self._contexts = {node: Context(RUN_ID, node, {}, RecordDict(), {}) for node in self._apps}

    def nodes(self) -> dict[str, int]:
        """Node numbers of all robots: in one process they are always connected."""
        return self._nodes

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
        node = message.metadata.dst_node_id
        try:
            return self._apps[node](message, self._contexts[node])
        except Exception as error:  # as across a network, one robot's failure does not end the training of the others
            return error_reply(f"{type(error).__name__}: {error}", message)


class NodeSelection:
    """The nodes that a strategy may choose from: all that its ``configure_train`` uses of a ``Grid``."""

    def __init__(self, nodes: Sequence[int]) -> None:
        self._nodes = list(nodes)

    def get_node_ids(self) -> list[int]:
        """The nodes."""
        return self._nodes


def message_to_bytes(message: Message) -> bytes:
    """Serialise a message for the network; ``request_from_bytes`` and ``reply_from_bytes`` read it."""
    return bytes(message_to_proto(message).SerializeToString(deterministic=True))


def request_from_bytes(data: bytes) -> Message:
    """Read the server's message on a robot.

    Raises:
        ValueError: these bytes are not a message.
    """
    try:
        return message_from_proto(MessageProto.FromString(data))
    except Exception as error:  # Flower's parsers fail in many ways on bytes that they did not write
        raise ValueError(f"a message that cannot be read ({type(error).__name__})") from error


def reply_from_bytes(data: bytes, request: Message) -> Message:
    """Read a robot's reply to a request. Only content or error are taken from the bytes, so nobody can forge a sender.

    Raises:
        ValueError: these bytes are not a message.
    """
    reply = request_from_bytes(data)
    return Message(reply.error if reply.has_error() else reply.content, reply_to=request)


def error_reply(reason: str, request: Message) -> Message:
    """The reply in place of one that cannot be used."""
    return Message(Error(APP_FAILED, reason), reply_to=request)
