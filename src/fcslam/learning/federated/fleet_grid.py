"""A fleet on several machines: robots fetch their requests and bring their replies."""

import threading
import time
from collections.abc import Callable, Collection
from math import inf
from typing import Final

from fcslam.learning.federated.messages import TrainingReply, TrainingRequest, read_reply, write_request

ONLINE_S: Final = 60.0
"""A robot that has been silent for longer is gone."""
REPLY_OVERHEAD_BYTES: Final = 64 * 1024
"""A reply that is larger than the request by more than this is not read."""
MAX_ROBOTS: Final = 1000
"""Robots of a fleet."""


class FleetGrid:
    """Requests and replies of the robots of a fleet. Any thread may call.

    A request stays with its robot until the reply is there or nobody waits for it any more. So a robot that starts
    again gets it again, and only the first reply counts.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen_s: dict[str, float] = {}
        self._request = 0, b""
        self._awaited: set[str] = set()
        self._replies: dict[str, TrainingReply] = {}
        self._changed = threading.Condition()

    def admits(self, robot: str) -> bool:
        """Whether the fleet has room for a robot, which is now there: rounds wait for it."""
        with self._changed:
            if robot not in self._seen_s and len(self._seen_s) >= MAX_ROBOTS:
                return False
            self._seen_s[robot] = self._clock()
            return True

    def next_request(self, robot: str) -> tuple[int, bytes] | None:
        """Number and bytes of the request that the robot should work on now; None if no request waits."""
        with self._changed:
            return self._request if robot in self._awaited else None

    def reply_limit(self, robot: str, number: int) -> int:
        """Largest size of the reply to a request [bytes]; 0 if the robot has no such request."""
        request = self.next_request(robot)
        if request is None or request[0] != number:
            return 0
        return len(request[1]) + REPLY_OVERHEAD_BYTES

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
            now = self._clock()
            return sorted(robot for robot, seen_s in self._seen_s.items() if now - seen_s <= ONLINE_S)

    def ask(
        self, robots: Collection[str], request: TrainingRequest, deadline_s: float = inf
    ) -> dict[str, TrainingReply]:
        """Replies that arrive within the deadline."""
        data = write_request(request)
        with self._changed:
            self._request = self._request[0] + 1, data
            self._awaited, self._replies = set(robots), {}
            self._changed.wait_for(lambda: not self._awaited, min(deadline_s, threading.TIMEOUT_MAX))
            self._awaited = set()
            return self._replies

    def _close(self, robot: str, number: int, reply: TrainingReply) -> bool:
        with self._changed:
            if robot not in self._awaited or self._request[0] != number:
                return False
            self._awaited.discard(robot)
            self._replies[robot] = reply
            self._changed.notify_all()
            return True
