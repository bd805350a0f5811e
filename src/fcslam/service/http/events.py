"""Events of the cloud for subscribers: the newest of each kind first, then all new ones."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass

MOST_WAITING = 100
"""Largest backlog of a slow subscriber, in events; it loses the oldest ones beyond."""


@dataclass(frozen=True, slots=True)
class Event:
    """One event."""

    kind: str
    number: int


class EventStream:
    """Events of missions from any thread to watchers in event loops."""

    def __init__(self, current: Callable[[], str] = str) -> None:
        """``current``: name of the mission that the present request is about, if there are several."""
        self._current = current
        self._lock = threading.Lock()
        self._newest: dict[tuple[str, str], Event] = {}
        self._watchers: dict[asyncio.Queue[Event], tuple[str, asyncio.AbstractEventLoop]] = {}

    def publish(self, kind: str, number: int, mission: str = "") -> None:
        """Send an event of a mission to all its subscribers."""
        event = Event(kind, number)
        with self._lock:
            self._newest[mission, kind] = event
            for queue, (watched, loop) in self._watchers.items():
                if watched == mission:
                    loop.call_soon_threadsafe(_put, queue, event)

    def watch(self) -> AsyncIterator[Event]:
        """Yield the newest event of each kind of the current mission, then each new event."""
        return self._watch(self._current())

    async def _watch(self, mission: str) -> AsyncIterator[Event]:
        queue: asyncio.Queue[Event] = asyncio.Queue(MOST_WAITING)
        with self._lock:
            for (named, _), event in self._newest.items():
                if named == mission:
                    _put(queue, event)
            self._watchers[queue] = mission, asyncio.get_running_loop()
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
