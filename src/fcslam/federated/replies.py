"""What robots answered in a round, read as what it is: something from outside."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.federated.flower import Message
from fcslam.federated.messages import (
    ARRAYS_KEY,
    record_bytes,
    record_to_weights,
    reply_metrics,
    reply_sender,
    weights_to_record,
)
from fcslam.federated.weights import Weights

MAX_REASON_LENGTH: Final = 300
MAX_REPLY_RATIO: Final = 2.0
"""An answer's size, in sizes of what was asked about; one that is larger is not unpacked."""


@dataclass(slots=True)
class RoundReplies:
    """Updates by robot, and why others gave none."""

    weights: dict[str, dict[str, NDArray[np.float32]]] = field(default_factory=dict)
    losses: dict[str, dict[str, float]] = field(default_factory=dict)
    messages: dict[str, Message] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    bytes_up: int = 0

    def leave_out(self, robot: str, reason: str) -> None:
        """Whatever the robot sent, it does not count."""
        self.left_out[robot] = printable_line(reason)
        for kept in (self.weights, self.losses, self.messages):
            kept.pop(robot, None)

    def mention(self, reasons: Mapping[str, str]) -> None:
        """What else was amiss, shown and kept in the same place."""
        for what, reason in reasons.items():
            self.left_out.setdefault(what, printable_line(reason))


def printable_line(text: str) -> str:
    """A short line of printable text."""
    words = " ".join("".join(sign if sign.isprintable() else " " for sign in text).split())
    return words if len(words) <= MAX_REASON_LENGTH else f"{words[: MAX_REASON_LENGTH - 3]}..."


def read_replies(replies: Any, robots: Mapping[int, str], version: str, asked: Weights) -> RoundReplies:
    """Answers of these robots, by node, to ``asked`` weights of this version; arrays are checked by ``screen``."""
    answers, most = RoundReplies(), MAX_REPLY_RATIO * record_bytes(weights_to_record(asked))
    for reply in replies:
        robot = robots.get(reply.metadata.src_node_id)
        if robot is None:
            continue
        if reply.has_error():
            answers.leave_out(robot, reply.error.reason or f"error {reply.error.code}")
            continue
        try:
            name, base = reply_sender(reply.content)
            if (name, base) != (robot, version):
                raise ValueError(f"an answer by {name} about version {base}, not by {robot} about {version}")
            size = record_bytes(reply.content[ARRAYS_KEY])
            if size > most:
                raise ValueError(f"{size} bytes, where {most:.0f} were enough")
            weights, losses = record_to_weights(reply.content[ARRAYS_KEY]), reply_metrics(reply.content)
        except (ValueError, KeyError, TypeError, EOFError) as error:
            answers.leave_out(robot, f"an answer that cannot be read ({error})")
            continue
        answers.bytes_up += size
        answers.weights[robot], answers.losses[robot], answers.messages[robot] = weights, losses, reply
    for robot in robots.values():
        if robot not in answers.weights and robot not in answers.left_out:
            answers.leave_out(robot, "no answer: gone, or later than the deadline")
    return answers
