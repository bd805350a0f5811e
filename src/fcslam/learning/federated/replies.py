"""The robots' replies of one round. They come from outside, so nothing in them is trusted before it is checked."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import printable
from fcslam.learning.federated.flower import Message
from fcslam.learning.federated.messages import (
    ARRAYS_KEY,
    GlobalModel,
    record_bytes,
    record_to_weights,
    reply_metrics,
    reply_sender,
)

MAX_REASON_LENGTH: Final = 300
"""Longer texts from a robot are cut, so that one robot cannot flood the table of rounds."""
MAX_REPLY_RATIO: Final = 2.0
"""A reply larger than this many times the weights that were sent is not deserialised."""


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

    Args:
        replies: Flower's messages; ``screen`` checks their arrays afterwards.
        robots: names of the robots that were asked, by Flower's node number.
        sent: the weights that they were sent.
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
