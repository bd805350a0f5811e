"""Reads the messages of one robot as they come, and gives its scans and images their odometry.

The sectors of a turn are joined, the scans of several lasers come in the order of their stamps, and each waits until
the odometry at its stamp is known (``pairing``). ``gate`` decides which scans are consistent. A bag is a stream that
ends; a live robot asks which lasers are silent, and does not wait for them, or for odometry, for ever.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from fcslam.records import CloudScan, FloatArray, frozen
from fcslam.sources.bags.camera import ImageMessage
from fcslam.sources.bags.imu import ImuReading
from fcslam.sources.bags.messages import OdometryReading, ScanMessage
from fcslam.sources.bags.pairing import Entry, Item, Message, OdometryPairing, PosedImage, PosedScan
from fcslam.sources.bags.rig import RecordedLaser
from fcslam.sources.bags.sectors import SectorJoiner
from fcslam.sources.clouds_in_space import CloudReader
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import MAX_STEP_BACK_S, ScanGate
from fcslam.sources.point_clouds import PointCloud
from fcslam.sources.pose import UNKNOWN_POSE

_LONGEST_QUEUE = 20
"""Most scans of one laser that wait for scans of the others; beyond, another laser has paused."""

_MOST_CLOUDS = 3
"""Clouds that wait for the readings of other sensors; beyond, these have stopped."""
_AFTER_S = 0.02
"""Readings of a gyro so long after a scan show its end."""

Numbered = tuple[int, Entry]
"""An entry with the number of its message."""


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


class _Readings:
    """Readings of a sensor that no scan was given yet: rows that begin with their stamps."""

    def __init__(self, columns: int) -> None:
        self._rows: deque[tuple[float, ...]] = deque()
        self._columns = columns
        self.newest_s = -np.inf

    def add(self, *row: float) -> None:
        self._rows.append(row)
        self.newest_s = row[0]

    def take(self, end_s: float = np.inf) -> FloatArray:
        taken = []
        while self._rows and self._rows[0][0] <= end_s:
            taken.append(self._rows.popleft())
        return np.array(taken).reshape(-1, self._columns)


class SensorReader:
    """Turns scans, odometry and images into consistent entries with poses."""

    def __init__(
        self, lasers: Sequence[RecordedLaser], has_odometry: bool, audit: Audit, imu: Iterable[ImuReading] = ()
    ) -> None:
        """``audit`` counts the faults; ``imu`` are readings of the IMU of a robot without odometry."""
        self._joiners = {number: SectorJoiner() for number, laser in enumerate(lasers) if laser.is_in_sectors}
        self._merger = ScanMerger(len(lasers))
        self._pairing = OdometryPairing() if has_odometry else None
        self._imu = _Readings(7)
        for reading in imu:
            self._imu.add(reading.stamp, *reading.values)
        self._gates, self._audit = [ScanGate(laser.first.beams, audit) for laser in lasers], audit
        self._number = 0

    def add(self, number: int, item: Item) -> Iterator[Numbered]:
        """Read the next item of message ``number``; yields the entries that wait no longer.

        Nothing waits for an IMU; clouds are read by ``CloudStream``.
        """
        self._number = number
        if isinstance(item, ImuReading):
            self._imu.add(item.stamp, *item.values)
        elif isinstance(item, ScanMessage) and item.laser in self._joiners:
            for turn in self._joiners[item.laser].add(item):
                yield from self._posed(self._merger.add(number, turn))
        elif not isinstance(item, PointCloud):
            yield from self._posed(self._merger.add(number, item))

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
        for number, item in items:
            if self._pairing is not None:
                yield from self._admitted(self._pairing.add(number, item))
            elif isinstance(item, ScanMessage):
                yield from self._admitted([(number, PosedScan(item, UNKNOWN_POSE, None, self._turns(item.end)))])
            elif isinstance(item, ImageMessage):
                yield number, PosedImage(item, None)

    def _turns(self, end_s: float) -> FloatArray | None:
        """The readings of the gyro for a scan that ends at ``end_s``, as in ``LaserScan``."""
        has_gyro = self._imu.newest_s > -np.inf
        return frozen(self._imu.take(end_s + _AFTER_S)[:, (0, 3)]) if has_gyro else None

    def _admitted(self, entries: Iterable[Numbered]) -> Iterator[Numbered]:
        """The consistent entries; counts the faults of the rest. A scan without odometry is not consistent."""
        for number, entry in entries:
            if isinstance(entry, PosedScan):
                if not self._gates[entry.scan.laser].admits(number, entry.scan.stamp, entry.scan.beams):
                    continue
                if entry.fault is not None:
                    self._audit.add(entry.fault, number)
                if entry.fault is Fault.NO_ODOMETRY:
                    continue
            yield number, entry


class CloudStream:
    """Gives each cloud of a 3D LiDAR the readings of the other sensors, as they come.

    A cloud waits until all of them reach its end, but not for a sensor that is silent.
    """

    silent_lasers: frozenset[int] = frozenset()
    """As in ``SensorReader``: there is one LiDAR."""

    def __init__(self, reader: CloudReader, audit: Audit) -> None:
        """``audit`` counts the faults."""
        self._reader, self._audit = reader, audit
        self._wheels, self._imu = _Readings(4), _Readings(7)
        self._waiting: deque[tuple[int, PointCloud, float]] = deque()
        """Clouds with the numbers of their messages and the times of their last points."""
        self._newest_s = -np.inf

    def add(self, number: int, item: Item) -> Iterator[tuple[int, CloudScan]]:
        """Read the next cloud or reading of message ``number``; yields the clouds that wait no longer."""
        if isinstance(item, OdometryReading):
            self._wheels.add(item.stamp, *item.T_odom_base)
        elif isinstance(item, ImuReading):
            self._imu.add(item.stamp, *item.values)
        elif isinstance(item, PointCloud) and -MAX_STEP_BACK_S < item.stamp - self._newest_s <= 0.0:
            self._audit.add(Fault.REPEATED_STAMP, number)
        elif isinstance(item, PointCloud):
            self._newest_s = item.stamp
            end_s = item.stamp + float(self._reader.times_s(item).max(initial=0.0))
            self._waiting.append((number, item, end_s))
        while self._waiting and (len(self._waiting) > _MOST_CLOUDS or self._is_covered(self._waiting[0][2])):
            yield from self._next()

    @property
    def waits_for_odometry(self) -> bool:
        """Whether clouds wait for readings."""
        return bool(self._waiting)

    def skip_lasers(self) -> Iterator[tuple[int, CloudScan]]:
        """Yield nothing: as there is one LiDAR, none waits for another."""
        return iter(())

    def skip_odometry(self) -> Iterator[tuple[int, CloudScan]]:
        """Yield all that waits, with the readings that are there."""
        while self._waiting:
            yield from self._next()

    finish = skip_odometry

    def _is_covered(self, end_s: float) -> bool:
        return all(each.newest_s >= end_s or not np.isfinite(each.newest_s) for each in (self._wheels, self._imu))

    def _next(self) -> Iterator[tuple[int, CloudScan]]:
        number, cloud, _ = self._waiting.popleft()
        try:
            yield number, self._reader.scan(cloud, self._wheels.take(), self._imu.take())
        except ValueError:
            self._audit.add(Fault.NO_RETURN, number)
