"""Flower in one process: a ``Grid`` that calls each robot's app itself, one after another. No ports, no daemons."""

import time
from collections.abc import Callable, Iterable
from typing import Any

from fcslam.federated.flower import ClientApp, Context, Error, Grid, Message, RecordDict, TaskIdentity

RUN_ID = 1
FAILED = 1001


class InProcessGrid(Grid):
    """Robots 0 to ``robots`` - 1, whose number is ``partition-id`` in their contexts; these outlive rounds.

    Robots answer one after another, and each has the deadline for itself, as if they worked at the same time. ``clock``
    gives seconds.
    """

    def __init__(self, app: ClientApp, robots: int, clock: Callable[[], float] = time.monotonic) -> None:
        TaskIdentity.task_id = TaskIdentity.run_id = TaskIdentity.node_id = RUN_ID
        self._app, self._clock = app, clock
        self._replies: dict[str, Message] = {}
        self._pushed = 0
        # Flower reserves node 1 for the server.
        self._contexts = {
            index + 2: Context(RUN_ID, index + 2, {"partition-id": index}, RecordDict(), {}) for index in range(robots)
        }

    def set_run(self, run: Any) -> None:
        """There is one run."""

    @property
    def run(self) -> Any:
        """There is no record of it."""
        return None

    def create_message(
        self, content: RecordDict, message_type: str, dst_node_id: int, group_id: str, ttl: float | None = None
    ) -> Message:
        """A message to a robot."""
        return Message(content, dst_node_id, message_type, group_id=group_id, ttl=ttl)

    def get_node_ids(self) -> list[int]:
        """All robots: in one process nobody is away."""
        return list(self._contexts)

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        """Have them answered."""
        names = []
        for message in messages:
            self._pushed += 1
            names.append(str(self._pushed))
            self._replies[names[-1]] = self._ask(message)
        return names

    def pull_messages(self, message_ids: Iterable[str]) -> list[Message]:
        """Answers that are there, which are forgotten then."""
        return [self._replies.pop(name) for name in message_ids if name in self._replies]

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Answers of all robots that took at most ``timeout`` seconds each."""
        answers = []
        for message in messages:
            began = self._clock()
            reply = self._ask(message)
            if timeout is None or self._clock() - began <= timeout:
                answers.append(reply)
        return answers

    def _ask(self, message: Message) -> Message:
        try:
            return self._app(message, self._contexts[message.metadata.dst_node_id])
        except Exception as error:  # a robot's fault ends the fleet's training no more than it would across a network
            return Message(Error(FAILED, f"{type(error).__name__}: {error}"), reply_to=message)
