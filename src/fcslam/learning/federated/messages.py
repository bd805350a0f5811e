"""The messages between the coordinator and the robots, as Flower's records: each writer beside its reader.

Replies come from outside, so nothing in them is trusted before it is checked.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import TrainingError, printable
from fcslam.learning.federated.flower import Array, ArrayRecord, ConfigRecord, Message, MetricRecord, RecordDict
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights

ARRAYS_KEY, CONFIG_KEY, METRICS_KEY = "arrays", "config", "metrics"
"""Names of the records in a message."""
PAIRS_KEY: Final = "pairs"
"""Name of the array in which a robot reports on the pairs that it holds out."""
EXAMPLES_KEY: Final = "num-examples"
"""Flower's name for the weight of an update in a mean."""
MAX_NAME_LENGTH: Final = 64
MAX_METRICS: Final = 32
"""A reply with more metrics than this is refused: fcslam's clients send fewer than ten."""
LARGEST_METRIC: Final = 1e6
"""Losses and metrics are of the order of 1. A larger one, or one that is not a number, would spoil a mean."""

MAX_REASON_LENGTH: Final = 300
"""Longer texts from a robot are cut, so that one robot cannot flood the table of rounds."""
MAX_REPLY_RATIO: Final = 2.0
"""A reply larger than this many times the weights that were sent is not deserialised."""


@dataclass(frozen=True, slots=True)
class ClientRequest:
    """A request to train or to evaluate, as a robot receives it."""

    weights: Weights
    version: str
    """Detector version of the weights."""
    round_number: int
    """From 0."""
    run_id: str
    """Identifies the run to clients that keep state over its rounds."""
    settings: FederatedSettings


def request_config(version: str, round_number: int, run_id: str, settings: FederatedSettings) -> ConfigRecord:
    """The part of a request that is sent beside the weights."""
    return ConfigRecord(
        {"version": version, "round": round_number, "run": run_id, "settings": settings.model_dump_json()}
    )


def read_request(content: RecordDict) -> ClientRequest:
    """Read a request on the robot.

    Raises:
        TrainingError: the content is not a request of this version of fcslam.
    """
    try:
        config = content[CONFIG_KEY]
        settings = FederatedSettings.model_validate_json(config["settings"])
        version, number, run_id = str(config["version"]), int(config["round"]), str(config["run"])
        return ClientRequest(record_to_weights(content[ARRAYS_KEY]), version, number, run_id, settings)
    except (KeyError, TypeError, ValueError) as error:
        raise TrainingError(
            f"the server's request cannot be read ({error}); install the same version of fcslam on both machines"
        ) from error


def client_reply(
    robot: str, version: str, metrics: Mapping[str, float], arrays: ArrayRecord | None = None
) -> RecordDict:
    """A robot's reply to a request that came with weights of this version."""
    records = {
        CONFIG_KEY: ConfigRecord({"robot": robot, "version": version}),
        METRICS_KEY: MetricRecord(dict(metrics)),
    }
    return RecordDict(records if arrays is None else records | {ARRAYS_KEY: arrays})


def reply_sender(content: RecordDict) -> tuple[str, str]:
    """The robot's name in a reply, and the version of the weights that the reply is about.

    Raises:
        ValueError: the reply does not name its sender, or the name is too long or not printable.
    """
    try:
        config = content[CONFIG_KEY]
        robot, version = config["robot"], config["version"]
    except (KeyError, TypeError) as error:
        raise ValueError("an answer without a name") from error
    if not (isinstance(robot, str) and 0 < len(robot) <= MAX_NAME_LENGTH and robot.isprintable()):
        raise ValueError("an answer without a usable name")
    return robot, str(version)


def reply_metrics(content: RecordDict) -> dict[str, float]:
    """The metrics in a reply.

    Raises:
        ValueError: the reply has no metrics, too many of them, some whose names are not identifiers, or some that are
            not plausible numbers.
    """
    record = content[METRICS_KEY]
    if not isinstance(record, MetricRecord):
        raise ValueError(f"a {type(record).__name__} in place of a {MetricRecord.__name__}")
    metrics = {str(name): float(value) for name, value in record.items() if isinstance(value, int | float)}
    if len(metrics) > MAX_METRICS or not all(name.isidentifier() and len(name) <= MAX_NAME_LENGTH for name in metrics):
        raise ValueError("metrics that the server did not request")
    odd = next((name for name, value in metrics.items() if not abs(value) <= LARGEST_METRIC), None)
    if odd is not None:
        raise ValueError(f"{odd} is {metrics[odd]:g}")
    return metrics


def weights_to_record(weights: Weights) -> ArrayRecord:
    """Serialise weights."""
    return ArrayRecord({name: Array(np.asarray(array, order="C")) for name, array in weights.items()})


def record_to_weights(record: object) -> dict[str, NDArray[np.float32]]:
    """Deserialise weights. Names, shapes, types and values are not checked, see ``weights_error``.

    Raises:
        ValueError: this is not a record of arrays, or one of its arrays cannot be read.
    """
    checked = _array_record(record)
    try:
        arrays = {str(name): array.numpy() for name, array in checked.items()}
    except Exception as error:  # NumPy's parser fails in many ways on bytes that it did not write
        raise ValueError(f"an array that cannot be read: {type(error).__name__}") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError("an archive in place of an array")
    return arrays


def record_bytes(record: object) -> int:
    """Size of the serialised arrays of a record [bytes].

    Raises:
        ValueError: this is not a record of arrays.
    """
    return sum(len(array.data) for array in _array_record(record).values())


@dataclass(frozen=True)
class GlobalModel:
    """Weights of the whole fleet, with everything that is derived from them. Each of it is derived once."""

    weights: Weights
    version: str
    """Detector version of the weights."""

    @cached_property
    def record(self) -> ArrayRecord:
        """The serialised weights."""
        return weights_to_record(self.weights)

    @cached_property
    def size_bytes(self) -> int:
        """Size of the serialised weights."""
        return record_bytes(self.record)


def _array_record(record: object) -> ArrayRecord:
    if not isinstance(record, ArrayRecord):
        raise ValueError(f"a {type(record).__name__} in place of a {ArrayRecord.__name__}")
    return record


@dataclass(slots=True)
class RoundReplies:
    """The updates of a round by robot, and the reasons why other robots gave none."""

    weights: dict[str, dict[str, NDArray[np.float32]]] = field(default_factory=dict)
    losses: dict[str, dict[str, float]] = field(default_factory=dict)
    messages: dict[str, Message] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    bytes_up: int = 0
    """Size of the serialised weights of all replies that could be read."""

    def leave_out(self, robot: str, reason: str) -> None:
        """Remove a robot's update from the round."""
        self.left_out[robot] = printable_line(reason)
        for kept in (self.weights, self.losses, self.messages):
            kept.pop(robot, None)

    def add_notes(self, notes: Mapping[str, str]) -> None:
        """Report other problems of the round beside the robots that are left out, by what they concern."""
        for subject, reason in notes.items():
            self.left_out.setdefault(subject, printable_line(reason))


def printable_line(text: str) -> str:
    """The text as one printable line of at most ``MAX_REASON_LENGTH`` characters."""
    words = " ".join(printable(text).split())
    return words if len(words) <= MAX_REASON_LENGTH else f"{words[: MAX_REASON_LENGTH - 3]}..."


def read_replies(replies: Iterable[Message], robots: Mapping[int, str], sent: GlobalModel) -> RoundReplies:
    """Read the replies to a training request.

    ``screen`` checks the arrays afterwards. ``robots`` has the names of those that were asked, by Flower's node number.
    """
    found, limit = RoundReplies(), MAX_REPLY_RATIO * sent.size_bytes
    for reply in replies:
        robot = robots.get(reply.metadata.src_node_id)
        if robot is None:
            continue
        if reply.has_error():
            found.leave_out(robot, reply.error.reason or f"error {reply.error.code}")
            continue
        try:
            name, base = reply_sender(reply.content)
            if (name, base) != (robot, sent.version):
                raise ValueError(f"an answer by {name} about version {base}, not by {robot} about {sent.version}")
            size = record_bytes(reply.content[ARRAYS_KEY])
            if size > limit:
                raise ValueError(f"{size} bytes, where {limit:.0f} were enough")
            weights, losses = record_to_weights(reply.content[ARRAYS_KEY]), reply_metrics(reply.content)
        except (ValueError, KeyError, TypeError, EOFError) as error:
            found.leave_out(robot, f"an answer that cannot be read ({error})")
            continue
        found.bytes_up += size
        found.weights[robot], found.losses[robot], found.messages[robot] = weights, losses, reply
    for robot in robots.values():
        if robot not in found.weights and robot not in found.left_out:
            found.leave_out(robot, "no answer: gone, or later than the deadline")
    return found
