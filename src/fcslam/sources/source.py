"""What every recording offers, whatever its format."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from fcslam.records import CameraModel, LaserModel, SensorRecord
from fcslam.sources.faults import Faults


class ScanRange(NamedTuple):
    """Scans ``first`` (included) to ``end`` (excluded) of a recording, counted from 0 in file order."""

    first: int = 0
    end: int | None = None
    """None: up to the end of the recording."""


WHOLE = ScanRange()


@dataclass(frozen=True, slots=True)
class Survey:
    """What one pass over a recording tells without reading the ranges."""

    scan_count: int
    """Scans that ``records`` yields; it yields fewer only where a range turns out not to be a number."""
    duration_s: float
    """Time between the earliest and the latest scan."""
    path_length_m: float
    """Length of the odometry's polyline through the scans, in file order."""
    laser: LaserModel
    faults: Faults
    """Of this pass, so without those of the ranges."""
    notes: tuple[str, ...] = ()
    """What was chosen where the recording leaves a choice, in sentences for people."""
    camera: CameraModel | None = None
    """None: ``records`` yields no images."""

    @property
    def beam_count(self) -> int:
        """Ranges in a scan."""
        return self.laser.beam_count


class Source(Protocol):
    """A recording of one robot. A shallow copy can be read side by side with the original."""

    @property
    def name(self) -> str:
        """The robot's name."""

    @property
    def faults(self) -> Faults:
        """What the latest pass of ``records`` has tolerated so far; complete once it has ended."""

    def survey(self, scans: ScanRange = WHOLE) -> Survey:
        """One quick pass that says what is in ``scans`` and refuses a recording that cannot be mapped.

        Raises:
            SourceError: the archive is truncated, there are no laser scans or no odometry, the beam count changes,
                time jumps back, or most of the recording is damaged.
        """

    def records(self, scans: ScanRange = WHOLE) -> Iterator[SensorRecord]:
        """Stream scans, odometry and images in file order; what is no scan goes with the scan before it.

        Memory does not depend on the recording's length. Every call starts a new pass.

        Raises:
            SourceError: as in ``survey``.
        """
