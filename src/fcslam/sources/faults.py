"""Faults of a recording that are tolerated, counted and reported."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum


class Fault(StrEnum):
    """Kinds of tolerated faults; the value is the text of the report."""

    BROKEN_LINE = "broken lines skipped"
    BROKEN_MESSAGE = "broken messages skipped"
    BROKEN_IMAGE = "missing or damaged images skipped"
    OTHER_BEAMS = "scans with the beams of another laser skipped"
    NO_ODOMETRY = "scans without odometry within 1 s skipped"
    HELD_ODOMETRY = "scans beyond the odometry's ends given its nearest pose"
    FROZEN_ODOMETRY = "scans that change while the odometry stands still; after ten in a row, only matching places them"
    REPEATED_SCAN = "scans that repeat the previous scan skipped"
    ODOMETRY_JUMP = "jumps of the odometry bridged by scan matching"
    ODOMETRY_GAP = "scans in gaps of the odometry of more than 1 s kept"
    MISPLACED_SCAN = "scans recorded far back in time skipped"
    CLOCK_STEP = "steps back of the clock, where a new session begins"
    TIME_REVERSAL = "steps back in time kept"
    NO_STAMP = "scans without a stamp taken as 1 s apart"
    REPEATED_STAMP = "scans with the stamp of the previous scan"
    INVALID_RANGE = "ranges that are negative or not finite made invalid"
    FIX_AT_ZERO = "GNSS fixes at latitude 0, longitude 0 skipped"
    NO_LATITUDE = "GNSS fixes with a latitude beyond 90 degrees (another unit, or a longitude) skipped"
    NO_FIX = "GNSS messages without a fix skipped"
    UNKNOWN_FIX = "GNSS fixes of unknown status used"
    NO_RETURN = "scans without a return placed by odometry alone; they clear no cells"


FEWEST = 10
"""Fewer scans, poses or faults of one kind show nothing."""


@dataclass(frozen=True, slots=True)
class FaultCount:
    """Number of faults of one kind."""

    count: int = 0
    first_line: int = 0
    """Line (or message of its topic) of the first fault, counted from 1; 0 if unknown."""
    largest_s: float = 0.0
    """Largest step back in time, for kinds of faults that have one."""


@dataclass(frozen=True, slots=True)
class Faults:
    """The faults of one pass over a recording; false without faults. ``str`` gives a one-line summary."""

    counts: Mapping[Fault, FaultCount]
    unit: str = "line"
    """Unit that ``FaultCount.first_line`` counts."""

    def __getitem__(self, kind: Fault) -> FaultCount:
        return self.counts.get(kind, FaultCount())

    def __bool__(self) -> bool:
        return bool(self.counts)

    def since(self, before: "Faults") -> "Faults":
        """These faults without those counted ``before``, after which the first of a kind is not known."""
        found = {}
        for kind, its in self.counts.items():
            if count := its.count - before[kind].count:
                found[kind] = FaultCount(count, 0 if kind in before.counts else its.first_line, its.largest_s)
        return Faults(found, self.unit)

    def plus(self, kind: Fault, count: int) -> "Faults":
        """These faults and ``count`` more, found by the robot and not by the reader."""
        return Faults({**self.counts, kind: FaultCount(self[kind].count + count)}, self.unit) if count else self

    def __str__(self) -> str:
        return ", ".join(self._describe(kind) for kind in Fault if kind in self.counts) or "no faults"

    def _describe(self, kind: Fault) -> str:
        found = self.counts[kind]
        largest = f", largest {found.largest_s:.3g} s" if found.largest_s else ""
        first = f" (first: {self.unit} {found.first_line}{largest})" if found.first_line else ""
        return f"{kind}: {found.count}{first}"


class Audit:
    """Counts faults while a recording is read."""

    def __init__(self, unit: str = "line") -> None:
        self._unit = unit
        self._counts: dict[Fault, FaultCount] = {}

    def add(self, kind: Fault, line: int, count: int = 1, step_s: float = 0.0) -> None:
        """Add ``count`` faults at ``line``."""
        before = self._counts.get(kind, FaultCount(first_line=line))
        self._counts[kind] = FaultCount(before.count + count, before.first_line, max(before.largest_s, step_s))

    def faults(self) -> Faults:
        """The faults counted so far."""
        return Faults(dict(self._counts), self._unit)
