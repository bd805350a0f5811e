"""The interface of recordings of all formats, and a recording as several robots."""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, Self

from fcslam.errors import SourceError
from fcslam.records import CameraModel, CloudScan, GnssFix, LaserModel, LaserScan, SensorRecord, frozen
from fcslam.sources.faults import Faults
from fcslam.sources.path_summary import PathSummary
from fcslam.sources.pose import UNKNOWN_POSE, pose_of, relative_pose


class Doubt(str):
    """A note that says that the map of the recording is wrong."""


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

    def survey(self) -> Survey:
        """Summarise the recording in one quick pass.

        Raises:
            SourceError: the recording is damaged, or cannot be mapped.
        """

    def records(self) -> Iterator[SensorRecord]:
        """Stream scans, odometry and images in file order; other records belong to the scan before them.

        A log is in memory as arrays meanwhile; of a bag, memory does not depend on its length. Every call starts a new
        pass. Raises as ``survey``.
        """


class Derived:
    """A recording that changes what another one says."""

    def __init__(self, source: Source) -> None:
        self.name, self._source = source.name, copy(source)

    def __copy__(self) -> Self:
        twin = object.__new__(type(self))
        twin.__dict__ |= self.__dict__ | {"_source": copy(self._source)}
        return twin

    @property
    def faults(self) -> Faults:
        """As in Source."""
        return self._source.faults

    def survey(self) -> Survey:
        """As in Source."""
        return self._source.survey()

    def records(self) -> Iterator[SensorRecord]:
        """As in Source."""
        return self._source.records()


def split(source: Source, parts: int) -> list[Source]:
    """Split a recording into robots ``<name>_1``, ``<name>_2`` ... of equal scan count (to within one), in file order.

    Each starts with a scan at the identity of its own odometry.

    Raises:
        SourceError: the recording has too few scans, or cannot be mapped.
    """
    count = source.survey().scan_count
    if not 1 <= parts <= count:
        raise SourceError(f"{source.name}: {count} scans cannot be cut into {parts} parts; choose 1 to {count}")
    bounds = [count * number // parts for number in range(parts + 1)]
    return [
        Part(source, first, end - first, f"{source.name}_{number}")
        for number, (first, end) in enumerate(pairwise(bounds), start=1)
    ]


class Part(Derived):
    """``count`` scans of a recording, from its scan ``first`` on, as a robot of its own."""

    def __init__(self, whole: Source, first: int, count: int, name: str) -> None:
        super().__init__(whole)
        self.name, self._first, self._count = name, first, count
        self._before = Faults({})
        """Faults of the scans before this part."""

    @property
    def faults(self) -> Faults:
        """As in Source, of this part only."""
        return self._source.faults.since(self._before)

    def survey(self) -> Survey:
        """As in Source."""
        track = PathSummary()
        for record in self.records():
            if isinstance(record, LaserScan | CloudScan):
                track.add(record.stamp, pose_of(record.T_odom_base))
        return replace(
            self._source.survey(),
            scan_count=track.count,
            duration_s=track.duration_s,
            path_length_m=track.length_m,
            faults=self.faults,
        )

    def records(self) -> Iterator[SensorRecord]:
        """As in Source; the first record is a scan at the identity, and others belong to the scan before them."""
        origin, seen = UNKNOWN_POSE, 0
        self._before = Faults({})
        for record in self._source.records():
            if isinstance(record, LaserScan | CloudScan):
                if seen == self._first + self._count:
                    return
                if seen == self._first:
                    self._before = self._source.faults if seen else self._before
                    origin = pose_of(record.T_odom_base)
                seen += 1
            if seen <= self._first:
                continue
            if isinstance(record, GnssFix | CloudScan) or record.T_odom_base is None:
                yield record
            else:
                yield replace(record, T_odom_base=frozen(relative_pose(origin, pose_of(record.T_odom_base))))
