"""A fleet on several machines: robots fetch their requests and bring their replies."""

import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from math import inf
from typing import Final

from fcslam.learning.federated.messages import TrainingReply, TrainingRequest, read_reply, write_request

ONLINE_S: Final = 60.0
"""A robot that has been silent for longer is gone."""
MAX_REPLY_RATIO: Final = 2.0
"""A reply larger than this many times the request is not read."""
REPLY_OVERHEAD_BYTES: Final = 64 * 1024
"""Room in a reply beside the weights: names, metrics, shapes."""
MAX_ROBOTS: Final = 1000
"""Robots of a fleet."""


@dataclass(frozen=True, slots=True)
class PendingRequest:
    """A request that waits for a robot's reply."""

    number: int
    data: bytes
    """The serialised request."""


@dataclass(slots=True)
class FleetMember:
    """A robot, its request and its reply."""

    seen_s: float = -inf
    request: PendingRequest | None = None
    reply: TrainingReply | None = None


@dataclass(slots=True)
class FleetGrid:
    """Requests and replies of the robots of a fleet. Any thread may call.

    A request stays with its robot until the reply is there or nobody waits for it any more. So a robot that starts
    again gets it again, and only the first reply counts.
    """

    clock: Callable[[], float] = time.monotonic
    _members: dict[str, FleetMember] = field(default_factory=dict)
    _issued: int = 0
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def admits(self, robot: str) -> bool:
        """Whether the fleet has room for a robot."""
        with self._changed:
            if robot not in self._members and len(self._members) < MAX_ROBOTS:
                self._members[robot] = FleetMember()
            return robot in self._members

    def mark_online(self, robot: str) -> None:
        """Note that an admitted robot asks for requests or works on one: rounds wait for it."""
        with self._changed:
            self._members[robot].seen_s = self.clock()

    def next_request(self, robot: str) -> PendingRequest | None:
        """The request that the robot should work on now; None if no request waits."""
        self.mark_online(robot)
        return self._members[robot].request

    def reply_limit(self, robot: str, number: int) -> int:
        """Largest size of the reply to a request [bytes]; 0 if the robot has no such request."""
        request = self._members[robot].request
        if request is None or request.number != number:
            return 0
        return int(MAX_REPLY_RATIO * len(request.data)) + REPLY_OVERHEAD_BYTES

    def store_reply(self, robot: str, number: int, data: bytes) -> bool:
        """Take a robot's reply; false if nobody waits for it."""
        try:
            reply = read_reply(data)  # without the lock: it may take long
        except ValueError as error:
            return self.refuse_reply(robot, number, str(error))
        return self._close(robot, number, reply)

    def refuse_reply(self, robot: str, number: int, reason: str) -> bool:
        """Put an error in the place of a robot's reply; false if nobody waits for it."""
        return self._close(robot, number, TrainingReply(robot, "", error=reason))

    def robots(self) -> list[str]:
        """Names of the robots that were heard of a short time ago, sorted."""
        with self._changed:
            now = self.clock()
            return sorted(robot for robot, member in self._members.items() if now - member.seen_s <= ONLINE_S)

    def ask(
        self, robots: Collection[str], request: TrainingRequest, deadline_s: float = inf
    ) -> dict[str, TrainingReply]:
        """Replies that arrive within the deadline. Nobody waits for a robot that is gone."""
        data, end = write_request(request), self.clock() + deadline_s
        with self._changed:
            asked = {robot: self._members[robot] for robot in robots}
            for member in asked.values():
                self._issued += 1
                member.request, member.reply = PendingRequest(self._issued, data), None
            while self._is_awaited(asked) and self.clock() < end:
                self._changed.wait(1.0)  # wakes up to see whether a robot has gone
            for member in asked.values():
                member.request = None
            return {robot: member.reply for robot, member in asked.items() if member.reply is not None}

    def _close(self, robot: str, number: int, reply: TrainingReply) -> bool:
        with self._changed:
            member = self._members[robot]
            if member.request is None or member.request.number != number:
                return False
            member.request, member.reply = None, reply
            self._changed.notify_all()
            return True

    def _is_awaited(self, asked: Collection[str]) -> bool:
        return any(self._members[robot].request is not None for robot in self.robots() if robot in asked)
