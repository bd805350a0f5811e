"""What was wrong with a recording that could be read all the same."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType


class Fault(StrEnum):
    """A kind of fault that is tolerated, counted and reported."""

    BROKEN_LINE = "broken lines skipped"
    BEAM_COUNT = "scans with another beam count skipped"
    MISPLACED_SCAN = "scans recorded far back in time skipped"
    TIME_REVERSAL = "steps back in time kept"
    NO_STAMP = "scans without a stamp taken as 1 s apart"
    REPEATED_STAMP = "scans with the stamp of the scan before kept"
    NON_FINITE_RANGE = "ranges that are no finite number made invalid"
    NEGATIVE_RANGE = "negative ranges made invalid"


@dataclass(frozen=True, slots=True)
class Tally:
    """How often a kind of fault occurred."""

    count: int = 0
    first_line: int = 0
    """Line (or message) of the recording, counted from 1, with the first one; 0 when there is none."""
    largest_s: float = 0.0
    """Largest step back in time, of the kinds that have one."""


@dataclass(frozen=True, slots=True)
class Faults:
    """The faults of one pass over a recording; false when there are none, its text is one line for people."""

    tallies: Mapping[Fault, Tally]

    def __getitem__(self, kind: Fault) -> Tally:
        return self.tallies.get(kind, Tally())

    def __bool__(self) -> bool:
        return bool(self.tallies)

    def __str__(self) -> str:
        return ", ".join(_describe(kind, self.tallies[kind]) for kind in Fault if kind in self.tallies) or "no faults"


class Audit:
    """Counts faults while a recording is read."""

    def __init__(self) -> None:
        self._tallies: dict[Fault, Tally] = {}

    def add(self, kind: Fault, line: int, count: int = 1, step_s: float = 0.0) -> None:
        """Count ``count`` faults at ``line``."""
        before = self._tallies.get(kind, Tally(first_line=line))
        self._tallies[kind] = Tally(before.count + count, before.first_line, max(before.largest_s, step_s))

    def clear(self) -> None:
        """Forget what was counted."""
        self._tallies.clear()

    def faults(self) -> Faults:
        """The faults counted so far."""
        return Faults(MappingProxyType(dict(self._tallies)))


def _describe(kind: Fault, tally: Tally) -> str:
    largest = f", largest {tally.largest_s:.3g} s" if tally.largest_s else ""
    return f"{kind}: {tally.count} (first: line {tally.first_line}{largest})"
