"""The grid of a fleet on several machines: robots fetch their requests and bring their replies."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

from fcslam.learning.federated.flower import (
    FIRST_NODE,
    Message,
    error_reply,
    message_to_bytes,
    reply_from_bytes,
    use_own_identity,
)
from fcslam.learning.federated.messages import MAX_REPLY_RATIO

ONLINE_S: Final = 60.0
"""A robot that has been silent for longer is gone."""
REPLY_OVERHEAD_BYTES: Final = 64 * 1024
"""Room in a reply beside the weights: names, metrics, shapes."""
MAX_ROBOTS: Final = 1000
"""Robots of a fleet."""


@dataclass(frozen=True, slots=True)
class Request:
    """A message that waits for a robot's reply."""

    number: int
    message: Message
    data: bytes
    """The serialised message."""


class FleetGrid:
    """Requests and replies of the robots of a fleet. Any thread may call.

    A request stays with its robot until the reply is there or nobody waits for it any more. So a robot that starts
    again gets it again, and only the first reply counts.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        use_own_identity()
        self._clock = clock
        self._nodes: dict[str, int] = {}
        self._seen: dict[int, float] = {}
        self._requests: dict[int, deque[Request]] = {}
        self._replies: dict[int, Message] = {}
        self._issued = 0
        self._changed = threading.Condition()

    def admits(self, robot: str) -> bool:
        """Whether the fleet has room for a robot."""
        with self._changed:
            return self._node(robot) is not None

    def mark_online(self, robot: str) -> None:
        """Note that a robot asks for requests or works on one: rounds wait for it."""
        with self._changed:
            self._online(robot)

    def next_request(self, robot: str) -> Request | None:
        """The request that the robot should work on now; None if no request waits."""
        with self._changed:
            waiting = self._requests.get(self._online(robot) or 0)
            return waiting[0] if waiting else None

    def reply_limit(self, robot: str, number: int) -> int:
        """Largest size of the reply to a request [bytes]; 0 if the robot has no such request."""
        with self._changed:
            request = self._open_request(robot, number)
            return 0 if request is None else int(MAX_REPLY_RATIO * len(request.data)) + REPLY_OVERHEAD_BYTES

    def store_reply(self, robot: str, number: int, data: bytes) -> bool:
        """Take a robot's reply; false if nobody waits for it."""
        with self._changed:
            request = self._open_request(robot, number)
        if request is None:
            return False
        return self._close(robot, number, _read_reply(data, request.message))  # read without the lock: it may take long

    def refuse_reply(self, robot: str, number: int, reason: str) -> None:
        """Put an error in the place of a robot's reply."""
        with self._changed:
            request = self._open_request(robot, number)
        if request is not None:
            self._close(robot, number, error_reply(reason, request.message))

    def nodes(self) -> dict[str, int]:
        """Node numbers of the robots that were heard of a short time ago."""
        with self._changed:
            now = self._clock()
            return {robot: node for robot, node in self._nodes.items() if now - self._seen.get(node, -inf) <= ONLINE_S}

    def push_messages(self, messages: Iterable[Message]) -> list[int]:
        """Let robots fetch messages; returns the numbers under which ``pull_messages`` gives the replies."""
        numbers = []
        with self._changed:
            for message in messages:
                self._issued += 1
                request = Request(self._issued, message, message_to_bytes(message))
                self._requests[message.metadata.dst_node_id].append(request)
                numbers.append(request.number)
        return numbers

    def pull_messages(self, numbers: Iterable[int]) -> list[Message]:
        """Replies to these messages that are there, each of them once."""
        with self._changed:
            return [self._replies.pop(number) for number in numbers if number in self._replies]

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Replies that arrive within ``timeout`` seconds. Nobody waits for a robot that is gone."""
        numbers = self.push_messages(messages)
        end = None if timeout is None else self._clock() + timeout
        with self._changed:
            while self._is_awaited(numbers) and (end is None or self._clock() < end):
                self._changed.wait(1.0)  # wakes up to see whether a robot has gone
            for waiting in self._requests.values():
                for request in [request for request in waiting if request.number in numbers]:
                    waiting.remove(request)
        return self.pull_messages(numbers)

    def _close(self, robot: str, number: int, reply: Message) -> bool:
        with self._changed:
            request = self._open_request(robot, number)
            if request is None:
                return False
            self._replies[number] = reply
            self._requests[self._nodes[robot]].remove(request)
            self._changed.notify_all()
            return True

    def _is_awaited(self, numbers: Sequence[int]) -> bool:
        return any(request.number in numbers for node in self.nodes().values() for request in self._requests[node])

    def _node(self, robot: str) -> int | None:
        if robot not in self._nodes and len(self._nodes) < MAX_ROBOTS:
            self._nodes[robot] = FIRST_NODE + len(self._nodes)
            self._requests[self._nodes[robot]] = deque()
        return self._nodes.get(robot)

    def _online(self, robot: str) -> int | None:
        node = self._node(robot)
        if node is not None:
            self._seen[node] = self._clock()
        return node

    def _open_request(self, robot: str, number: int) -> Request | None:
        waiting = self._requests.get(self._nodes.get(robot, 0), ())
        return next((request for request in waiting if request.number == number), None)


def _read_reply(data: bytes, request: Message) -> Message:
    """The reply in these bytes, or an error if they are none."""
    try:
        return reply_from_bytes(data, request)
    except ValueError as error:
        return error_reply(str(error), request)
