"""Merges the scans of several lasers of one robot in time."""

from collections import deque
from collections.abc import Iterator

from fcslam.sources.bags.messages import ScanMessage
from fcslam.sources.bags.pairing import Message

_LONGEST_QUEUE = 20
"""Most scans of one laser that wait for scans of the others; beyond, another laser has paused."""


class ScanMerger:
    """Puts the scans of several lasers in the order of their stamps, as they come."""

    def __init__(self, laser_count: int) -> None:
        self._queues: list[deque[tuple[int, ScanMessage]]] = [deque() for _ in range(laser_count)]
        self._silent: set[int] = set()
        """Lasers that no scan waits for."""

    def add(self, number: int, item: Message) -> Iterator[tuple[int, Message]]:
        """Add the next item; yields those that wait no longer. Only scans wait."""
        if len(self._queues) == 1 or not isinstance(item, ScanMessage):
            yield number, item
            return
        self._silent.discard(item.laser)
        self._queues[item.laser].append((number, item))
        while self._is_complete() or len(self._queues[item.laser]) > _LONGEST_QUEUE:
            yield self._earliest()

    @property
    def awaited(self) -> set[int]:
        """Lasers for which two or more scans of another one wait."""
        if max(map(len, self._queues)) < 2:
            return set()
        return {laser for laser, queue in enumerate(self._queues) if not queue} - self._silent

    def give_up(self) -> Iterator[tuple[int, Message]]:
        """Wait no longer for the awaited lasers, until they send again; yields what waited for them."""
        self._silent |= self.awaited
        while self._is_complete():
            yield self._earliest()

    def flush(self) -> Iterator[tuple[int, Message]]:
        """Yield all scans that wait."""
        while any(self._queues):
            yield self._earliest()

    def _is_complete(self) -> bool:
        return any(self._queues) and all(queue or laser in self._silent for laser, queue in enumerate(self._queues))

    def _earliest(self) -> tuple[int, ScanMessage]:
        return min((queue for queue in self._queues if queue), key=lambda queue: queue[0][1].stamp).popleft()
