"""Splits one recording into several robots."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace

from fcslam.errors import SourceError
from fcslam.records import GnssFix, LaserScan, SensorRecord, frozen
from fcslam.sources.faults import Faults
from fcslam.sources.pose import Pose, relative_pose
from fcslam.sources.source import WHOLE, ScanRange, Source, Survey


def split(source: Source, parts: int) -> list[Source]:
    """Split a recording into robots ``<name>_1``, ``<name>_2`` ... of equal scan count (to within one), in file order.

    Each starts with a scan at the identity of its own odometry.

    Raises:
        SourceError: the recording has too few scans, or cannot be mapped.
    """
    count = source.survey().scan_count
    if not 1 <= parts <= count:
        raise SourceError(f"{source.name}: {count} scans cannot be cut into {parts} parts; choose 1 to {count}")
    bounds = [count * number // parts for number in range(parts)]
    ends = [*bounds[1:], None]
    ranges = map(ScanRange, bounds, ends)
    return [Part(source, scans, f"{source.name}_{number}") for number, scans in enumerate(ranges, start=1)]


class Part:
    """A range of scans of a recording as a robot of its own."""

    def __init__(self, whole: Source, scans: ScanRange, name: str) -> None:
        self._whole = copy(whole)
        """A copy with its own pass, because parts are read concurrently."""
        self._scans = scans
        self.name = name

    @property
    def faults(self) -> Faults:
        """As in Source, of this part only."""
        return self._whole.faults

    def survey(self, scans: ScanRange = WHOLE) -> Survey:
        """As in Source; scans are counted from the part's first."""
        return self._whole.survey(self._within(scans))

    def records(self, scans: ScanRange = WHOLE) -> Iterator[SensorRecord]:
        """As in Source; the first record is a scan at the identity, and records before it are dropped."""
        origin: Pose | None = None
        for record in self._whole.records(self._within(scans)):
            if isinstance(record, GnssFix):
                yield record
                continue
            pose: Pose | None = None if record.T_odom_base is None else tuple(record.T_odom_base.tolist())
            if origin is None and isinstance(record, LaserScan):
                origin = pose
            if origin is not None:
                yield record if pose is None else replace(record, T_odom_base=frozen(relative_pose(origin, pose)))

    def _within(self, scans: ScanRange) -> ScanRange:
        ends = [self._scans.end] if scans.end is None else [self._scans.end, self._scans.first + scans.end]
        return ScanRange(self._scans.first + scans.first, min((end for end in ends if end is not None), default=None))
