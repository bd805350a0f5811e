"""Events of the cloud for subscribers: the newest of each kind first, then all new ones."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass

WAITING = 100
"""Largest backlog of a slow subscriber, in events; it loses the oldest ones beyond."""


@dataclass(frozen=True, slots=True)
class Event:
    """One event."""

    kind: str
    number: int


class EventStream:
    """Events from any thread to watchers in event loops."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: dict[str, Event] = {}
        self._watchers: dict[asyncio.Queue[Event], asyncio.AbstractEventLoop] = {}

    def publish(self, kind: str, number: int) -> None:
        """Send an event to all subscribers."""
        event = Event(kind, number)
        with self._lock:
            self._newest[kind] = event
            for queue, loop in self._watchers.items():
                loop.call_soon_threadsafe(_put, queue, event)

    async def watch(self) -> AsyncIterator[Event]:
        """Yield the newest event of each kind, then each new event."""
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


class EventStreams:
    """The events of several missions; a subscriber follows those of the mission that its request is about."""

    def __init__(self, current: Callable[[], str]) -> None:
        """``current``: name of the mission that the present request is about."""
        self._current = current
        self._lock = threading.Lock()
        self._streams: dict[str, EventStream] = {}

    def publish(self, mission: str, kind: str, number: int) -> None:
        """Send an event of a mission to all its subscribers."""
        self._stream(mission).publish(kind, number)

    def watch(self) -> AsyncIterator[Event]:
        """Yield the newest event of each kind, then each new event."""
        return self._stream(self._current()).watch()

    def _stream(self, mission: str) -> EventStream:
        with self._lock:
            return self._streams.setdefault(mission, EventStream())


def _put(queue: asyncio.Queue[Event], event: Event) -> None:
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(event)
