"""Reads the messages of one robot as they come, and gives its scans and images their odometry.

The sectors of a turn are joined, the scans of several lasers come in the order of their stamps, and each waits until
the odometry at its stamp is known (``pairing``). ``gate`` decides which scans are consistent. A bag is a stream that
ends; a live robot asks which lasers are silent, and does not wait for them, or for odometry, for ever.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from fcslam.records import Beams
from fcslam.sources.bags.merging import ScanMerger
from fcslam.sources.bags.messages import ScanMessage
from fcslam.sources.bags.pairing import Entry, EntryGate, Message, OdometryPairing, without_odometry
from fcslam.sources.bags.sectors import SectorJoiner
from fcslam.sources.faults import Audit

Numbered = tuple[int, Entry]
"""An entry with the number of its message."""


class ReadLaser(NamedTuple):
    """How the messages of a laser are read."""

    beams: Beams
    is_in_sectors: bool


class SensorReader:
    """Turns scans, odometry and images into consistent entries with poses."""

    def __init__(self, lasers: Sequence[ReadLaser], has_odometry: bool, audit: Audit) -> None:
        """``audit`` counts the faults."""
        self._joiners = {number: SectorJoiner() for number, laser in enumerate(lasers) if laser.is_in_sectors}
        self._merger = ScanMerger(len(lasers))
        self._pairing = OdometryPairing() if has_odometry else None
        self._gate = EntryGate((laser.beams for laser in lasers), audit)
        self._number = 0

    def add(self, number: int, item: Message) -> Iterator[Numbered]:
        """Read the next item of message ``number``; yields the entries that wait no longer."""
        self._number = number
        joined: Iterable[Message] = (item,)
        if isinstance(item, ScanMessage) and item.laser in self._joiners:
            joined = self._joiners[item.laser].add(item)
        for each in joined:
            yield from self._posed(self._merger.add(number, each))

    def finish(self) -> Iterator[Numbered]:
        """Yield all that waits, as no more messages come."""
        for joiner in self._joiners.values():
            for turn in joiner.flush():
                yield from self._posed(self._merger.add(self._number, turn))
        yield from self._posed(self._merger.flush())
        yield from self.skip_odometry()

    @property
    def silent_lasers(self) -> set[int]:
        """Lasers for which two or more scans of another one wait."""
        return self._merger.awaited

    @property
    def waits_for_odometry(self) -> bool:
        """Whether scans or images wait."""
        return self._pairing is not None and self._pairing.waiting > 0

    def skip_lasers(self) -> Iterator[Numbered]:
        """Wait no longer for the silent lasers, until they send again."""
        yield from self._posed(self._merger.give_up())

    def skip_odometry(self) -> Iterator[Numbered]:
        """Give what waits for odometry the nearest pose, or none."""
        if self._pairing is not None:
            yield from self._admitted(self._pairing.flush())

    def _posed(self, items: Iterable[tuple[int, Message]]) -> Iterator[Numbered]:
        if self._pairing is None:
            yield from self._admitted(without_odometry(items))
            return
        for number, item in items:
            yield from self._admitted(self._pairing.add(number, item))

    def _admitted(self, entries: Iterable[Numbered]) -> Iterator[Numbered]:
        return (entry for entry in entries if self._gate.admits(*entry))
