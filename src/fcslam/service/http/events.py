"""What happens in the cloud, for whoever watches: the newest of each kind, and then all that follows."""

import asyncio
import threading
from collections.abc import AsyncIterator
from dataclasses import dataclass

WAITING = 100
"""Events that a slow watcher may be behind; then it loses the oldest."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something happened."""

    kind: str
    number: int


class EventStream:
    """Events from any thread to watchers in event loops."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: dict[str, Event] = {}
        self._watchers: dict[asyncio.Queue[Event], asyncio.AbstractEventLoop] = {}

    def publish(self, kind: str, number: int) -> None:
        """Tell all watchers."""
        event = Event(kind, number)
        with self._lock:
            self._newest[kind] = event
            for queue, loop in self._watchers.items():
                loop.call_soon_threadsafe(_put, queue, event)

    async def watch(self) -> AsyncIterator[Event]:
        """The newest event of each kind, then each that comes."""
        queue: asyncio.Queue[Event] = asyncio.Queue(WAITING)
        with self._lock:
            for event in self._newest.values():
                _put(queue, event)
            self._watchers[queue] = asyncio.get_running_loop()
        try:
            while True:
                yield await queue.get()
        finally:
            with self._lock:
                del self._watchers[queue]


def _put(queue: asyncio.Queue[Event], event: Event) -> None:
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(event)
