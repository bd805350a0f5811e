"""The adapter to Flower: the only module that imports it or knows what it does not document.

It relies on internals: who sends a message, how a message is serialised, what a ``Grid`` has to offer.
``tests/learning/federated/test_flower.py`` checks each of them. To support another version of Flower, change
``SUPPORTED_VERSIONS`` and the requirement in pyproject.toml, and make that test pass.

Flower's SuperLink and SuperNode are not used. They run whatever app a caller submits, and their Control API asks for no
credentials; see docs/howto/federated.md.
"""

import logging
import os
import time
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version as installed_version
from typing import Any, Final

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
from flwr.serverapp import Grid  # noqa: E402
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
    "Grid",
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


class RobotGrid(Grid):
    """The part of a ``Grid`` that is the same whatever carries the messages."""

    def __init__(self) -> None:
        use_own_identity()

    @abstractmethod
    def robot_names(self) -> dict[int, str]:
        """Names of the robots by node number."""

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


class InProcessGrid(RobotGrid):
    """A ``Grid`` that calls the robots' apps in this process, one after another, without ports and daemons.

    Every robot has the whole deadline for itself, as if all worked at the same time.

    Args:
        apps: of the robots by name.
        clock: gives seconds since any fixed moment.
    """

    def __init__(self, apps: Mapping[str, ClientApp], clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._robots = dict(enumerate(apps.items(), FIRST_NODE))
        self._clock = clock
        self._replies: dict[str, Message] = {}
        self._pushed = 0
        # Contexts stay from round to round, as Flower's daemons keep them.
        self._contexts = {node: Context(RUN_ID, node, {}, RecordDict(), {}) for node in self._robots}

    def robot_names(self) -> dict[int, str]:
        """Names of the robots by node number."""
        return {node: name for node, (name, _) in self._robots.items()}

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
        node = message.metadata.dst_node_id
        try:
            return self._robots[node][1](message, self._contexts[node])
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
