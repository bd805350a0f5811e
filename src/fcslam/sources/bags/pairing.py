"""Assigns odometry to scans and images at their own stamps.

Poses are interpolated between two readings; a scan with exactly the stamp of a reading gets that reading's pose.
Odometry may come later than the scan, so scans wait for it in the order of the recording. Where the clock of the
odometry steps back, earlier readings do not count any more.

A reading that was recorded a little late, after one with a later stamp, counts at its time.

Before the first and after the last reading, and at a step back of their clock, the nearest one within 1 s counts.
"""

from bisect import bisect_right, insort
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

from fcslam.records import FloatArray
from fcslam.sources.bags.camera import ImageMessage
from fcslam.sources.bags.imu import ImuReading
from fcslam.sources.bags.messages import OdometryReading, ScanMessage
from fcslam.sources.faults import Fault
from fcslam.sources.motion import OdometryUpdates, moving_sweep
from fcslam.sources.point_clouds import PointCloud
from fcslam.sources.pose import Pose, interpolated_pose

MAX_GAP_S = 1.0
"""Largest time between a scan and a reading outside of which it has no odometry."""

_LATE_S = 0.15
"""A reading may be recorded so long after one with a later stamp, as over a network."""
_LONGEST_QUEUE = 1000
"""Most past readings that are searched for a scan, and most waiting items; beyond, the oldest one waits no longer."""


class PosedScan(NamedTuple):
    """A scan with the odometry at its stamp."""

    scan: ScanMessage
    """Its sweep has the motion by odometry."""
    T_odom_base: Pose
    fault: Fault | None
    """Fault of the pose; with NO_ODOMETRY the pose is the identity."""
    gyro: FloatArray | None = None
    """Readings of a gyro since the previous scan, as in ``LaserScan``."""


class PosedImage(NamedTuple):
    """An image with the odometry at its stamp."""

    image: ImageMessage
    T_odom_base: Pose | None
    """None if there is no reading within 1 s."""


_stamp_of = attrgetter("stamp")

_PoseMatch = tuple[Pose, Fault | None]
"""A pose and its fault."""

Message = ScanMessage | ImageMessage | OdometryReading
Item = Message | ImuReading | PointCloud
"""What a message holds."""
Entry = PosedScan | PosedImage | OdometryReading


@dataclass(slots=True)
class _QueuedItem:
    number: int
    item: Message
    match: _PoseMatch | None


class OdometryPairing:
    """Pairs items as they come; each waits until the odometry at its stamp is known."""

    def __init__(self) -> None:
        self._readings: list[OdometryReading] = []
        """Readings of the present clock, in the order of their stamps."""
        self._queue: deque[_QueuedItem] = deque()
        self._updates = OdometryUpdates()

    @property
    def waiting(self) -> int:
        """Number of items that wait for odometry, or behind one that does."""
        return len(self._queue)

    def add(self, number: int, item: Message) -> Iterator[tuple[int, Entry]]:
        """Add the next item; yields those that wait no longer, in their order."""
        readings, queue = self._readings, self._queue
        if isinstance(item, OdometryReading):
            if readings and item.stamp < readings[-1].stamp - _LATE_S:  # the clock stepped back
                for waiting in queue:
                    waiting.match = waiting.match or _nearest_pose((readings[-1], item), waiting.item.stamp)
                readings[:] = [item]
            elif (readings and item.stamp < readings[-1].stamp) or self._updates.is_fresh(item.stamp, item.T_odom_base):
                insort(readings, item, key=_stamp_of)
                for waiting in queue:
                    waiting.match = waiting.match or _match(readings, waiting.item.stamp)
            del readings[:-_LONGEST_QUEUE]
            queue.append(_QueuedItem(number, item, (item.T_odom_base, None)))
        else:
            queue.append(_QueuedItem(number, item, _match(readings, item.stamp)))
        while queue and (self._is_complete(queue[0]) or len(queue) > _LONGEST_QUEUE):
            yield _with_pose(queue.popleft(), readings)

    def _is_complete(self, waiting: _QueuedItem) -> bool:
        """Whether the odometry at the stamp and, for a scan, during its sweep is known.

        Odometry that is late or has stopped does not hold a scan for longer than the next scan takes.
        """
        if waiting.match is None or not isinstance(waiting.item, ScanMessage) or waiting.item.sweep is None:
            return waiting.match is not None
        end_s = waiting.item.end
        is_covered = self._readings[-1].stamp >= end_s or self._readings[-1].stamp < waiting.item.stamp
        return is_covered or any(isinstance(each.item, ScanMessage) and each.item.end > end_s for each in self._queue)

    def flush(self) -> Iterator[tuple[int, Entry]]:
        """Yield all that wait, as no odometry comes any more."""
        while self._queue:
            yield _with_pose(self._queue.popleft(), self._readings)


def _with_pose(waiting: _QueuedItem, readings: list[OdometryReading]) -> tuple[int, Entry]:
    if isinstance(waiting.item, OdometryReading):
        return waiting.number, waiting.item
    match = waiting.match or _nearest_pose(readings, waiting.item.stamp)
    T_odom_base, fault = match
    if isinstance(waiting.item, ImageMessage):
        return waiting.number, PosedImage(waiting.item, None if fault is Fault.NO_ODOMETRY else T_odom_base)
    scan = waiting.item
    if scan.sweep is not None and fault is not Fault.NO_ODOMETRY:
        scan = scan._replace(sweep=moving_sweep(scan.sweep, scan.stamp, readings))
    return waiting.number, PosedScan(scan, T_odom_base, fault)


def _match(readings: list[OdometryReading], stamp: float) -> _PoseMatch | None:
    """The pose at a stamp; None if it is later than all readings."""
    if not readings or stamp > readings[-1].stamp:
        return None
    at = bisect_right(readings, stamp, key=_stamp_of)
    if at == 0:
        return _nearest_pose(readings[:1], stamp)
    before = readings[at - 1]
    if before.stamp == stamp:
        return (before.T_odom_base, None)
    after = readings[at]
    span_s = after.stamp - before.stamp
    pose = interpolated_pose(before.T_odom_base, after.T_odom_base, (stamp - before.stamp) / span_s)
    return (pose, Fault.ODOMETRY_GAP if span_s > MAX_GAP_S else None)


def _nearest_pose(readings: Iterable[OdometryReading], stamp: float) -> _PoseMatch:
    nearest = min(readings, key=lambda reading: abs(reading.stamp - stamp), default=None)
    if nearest is None or abs(nearest.stamp - stamp) > MAX_GAP_S:
        return ((0.0, 0.0, 0.0), Fault.NO_ODOMETRY)
    return (nearest.T_odom_base, Fault.HELD_ODOMETRY if nearest.stamp != stamp else None)
