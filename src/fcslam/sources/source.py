"""The interface of recordings of all formats, and a recording as several robots."""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

from fcslam.errors import SourceError
from fcslam.records import CameraModel, CloudScan, GnssFix, LaserModel, LaserScan, SensorRecord, frozen
from fcslam.sources.faults import Faults
from fcslam.sources.pose import Pose, relative_pose


class ScanRange(NamedTuple):
    """Scans ``first`` (included) to ``end`` (excluded) of a recording, counted from 0 in file order."""

    first: int = 0
    end: int | None = None
    """None: to the end of the recording."""


WHOLE = ScanRange()


@dataclass(frozen=True, slots=True)
class Survey:
    """Summary of a recording."""

    scan_count: int
    """Scans that ``records`` yields; it yields fewer only if the ranges of a scan are damaged."""
    duration_s: float
    """Time between the earliest and the latest scan."""
    path_length_m: float
    """Length of the odometry's polyline through the scans, in file order."""
    lasers: tuple[LaserModel, ...]
    """One or more; the beams of their scans may vary (``geometry.beams.misfit``)."""
    faults: Faults
    """Faults of this pass, so without those of the ranges."""
    notes: tuple[str, ...] = ()
    """Choices that were made for the user, such as topics, as sentences."""
    camera: CameraModel | None = None
    """None if ``records`` yields no images."""


class Source(Protocol):
    """A recording of one robot. A shallow copy can be read side by side with the original."""

    @property
    def name(self) -> str:
        """The robot's name."""

    @property
    def faults(self) -> Faults:
        """Faults of the latest pass of ``records`` so far; complete when the pass has ended."""

    def survey(self, scans: ScanRange = WHOLE) -> Survey:
        """Summarise ``scans`` in one quick pass.

        Raises:
            SourceError: the recording is damaged, or cannot be mapped.
        """

    def records(self, scans: ScanRange = WHOLE) -> Iterator[SensorRecord]:
        """Stream scans, odometry and images in file order; other records belong to the scan before them.

        A log is in memory as arrays meanwhile; of a bag, memory does not depend on its length. Every call starts a new
        pass. Raises as ``survey``.
        """


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
            if isinstance(record, GnssFix | CloudScan):
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
