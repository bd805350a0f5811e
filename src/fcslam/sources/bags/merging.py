"""Merges the scans of several lasers of one robot in time."""

from collections import deque
from collections.abc import Iterable, Iterator

from fcslam.sources.bags.messages import ScanMessage
from fcslam.sources.bags.pairing import Message

_LONGEST_QUEUE = 20
"""Most scans of one laser that wait for scans of the others; beyond, another laser has paused."""


def merge_scans(items: Iterable[tuple[int, Message]], laser_count: int) -> Iterator[tuple[int, Message]]:
    """Yield the items in their order, but the scans of ``laser_count`` lasers by their stamps.

    The scans of each laser keep their order. The messages between scans do not wait.
    """
    if laser_count == 1:
        yield from items
        return
    queues: list[deque[tuple[int, ScanMessage]]] = [deque() for _ in range(laser_count)]
    for number, item in items:
        if not isinstance(item, ScanMessage):
            yield number, item
            continue
        queues[item.laser].append((number, item))
        while all(queues) or len(queues[item.laser]) > _LONGEST_QUEUE:
            yield _earliest(queues)
    while any(queues):
        yield _earliest(queues)


def _earliest(queues: list[deque[tuple[int, ScanMessage]]]) -> tuple[int, ScanMessage]:
    return min((queue for queue in queues if queue), key=lambda queue: queue[0][1].stamp).popleft()
