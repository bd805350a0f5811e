"""A fleet of robots, and one in this process."""

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Protocol

from fcslam.learning.federated.client import FederatedClient, answer
from fcslam.learning.federated.messages import TrainingReply, TrainingRequest


class TrainingFleet(Protocol):
    """The robots that a coordinator trains with."""

    def robots(self) -> list[str]:
        """Names of the connected robots, sorted."""

    def ask(self, robots: Collection[str], request: TrainingRequest, deadline_s: float) -> Mapping[str, TrainingReply]:
        """The replies that arrive within the deadline, by robot."""


class InProcessFleet:
    """Clients in this process, one after another.

    Every robot has the whole deadline for itself, as if all worked at the same time.
    """

    def __init__(self, clients: Iterable[FederatedClient], clock: Callable[[], float] = time.monotonic) -> None:
        self._clients = {client.name: client for client in clients}
        self._clock = clock

    def robots(self) -> list[str]:
        """Names of all robots: in one process they are always connected."""
        return sorted(self._clients)

    def ask(self, robots: Collection[str], request: TrainingRequest, deadline_s: float) -> dict[str, TrainingReply]:
        """Replies of the robots that took at most the deadline each."""
        replies = {}
        for robot in robots:
            started = self._clock()
            reply = answer(self._clients[robot], request)
            if self._clock() - started <= deadline_s:
                replies[robot] = reply
        return replies
