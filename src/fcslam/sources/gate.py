"""Consistency rules for the scans of a recording, the same for all formats.

- Steps back in time. The clocks of one robot disagree by up to a second (the Intel log has 631 steps back, the largest
  0.9 s). Scans stay in file order, in which the odometry is consistent. A scan more than 2 s before both preceding
  scans is misplaced and skipped (both, because one of them may have a damaged stamp far ahead). A recording with more
  than 1 % misplaced scans is rejected.
- A clock that steps back, and stays there for ten scans, is kept from the tenth on: a robot begins a new session there
  (``is_clock_step``).
- Beams. The beams of one laser may vary from scan to scan; ``geometry.beams.misfit`` decides whether a scan can be of
  the laser. One that cannot is skipped. A recording in which these are the majority is rejected.
- Equal stamps are kept. Some logs were printed with too few digits or without a clock.
"""

from collections.abc import Sequence
from math import inf
from pathlib import Path

from fcslam.errors import SourceError
from fcslam.geometry.beams import misfit
from fcslam.records import Beams
from fcslam.sources.faults import FEWEST, Audit, Fault, Faults

MAX_STEP_BACK_S = 2.0
"""Largest tolerated step back in time; the messages of one clock are recorded within it of each other's delay."""
TOLERATED_SHARE = 0.01
"""Largest share of inconsistent scans in a recording."""
FIRST_MESSAGES = 20
"""Number of first messages that decide what a sensor is, as which beams a laser has."""


def usual_beams(scans: Sequence[Beams]) -> Beams:
    """The beams of the first of the ``scans`` that agrees with most of them."""
    return max(scans, key=lambda declared: sum(misfit(beams, declared) is None for beams in scans))


def is_clock_step(before_s: Sequence[float], stamp: float) -> bool:
    """Whether a scan is more than 2 s before both preceding ones; one of them may have a wrong stamp."""
    return min(before_s) - stamp > MAX_STEP_BACK_S


class ScanGate:
    """Filters inconsistent scans of one laser out and counts them."""

    def __init__(self, beams: Beams, audit: Audit) -> None:
        self._beams = beams
        self._audit = audit
        self._before_s = (-inf, -inf)
        """Stamps of the two preceding scans."""
        self._misplaced: list[tuple[int, float]] = []
        """Numbers and stamps of the newest misplaced scans in a row."""

    def admits(self, number: int, stamp: float, beams: Beams | None) -> bool:
        """Whether the scan on line (or in message) ``number`` is consistent; counts its faults.

        ``beams`` are None if nothing is known about them.
        """
        if beams is None or misfit(beams, self._beams) is not None:
            self._audit.add(Fault.OTHER_BEAMS, number)
            return False
        step_back_s = self._before_s[1] - stamp
        if is_clock_step(self._before_s, stamp):
            if self._misplaced and not 0.0 <= stamp - self._misplaced[-1][1] <= MAX_STEP_BACK_S:
                self._misplaced.clear()
            self._misplaced.append((number, stamp))
            if len(self._misplaced) < FEWEST:
                self._audit.add(Fault.MISPLACED_SCAN, number, step_s=step_back_s)
                return False
            self._audit.add(Fault.CLOCK_STEP, self._misplaced[0][0], step_s=step_back_s)
        elif step_back_s > 0.0:
            self._audit.add(Fault.TIME_REVERSAL, number, step_s=step_back_s)
        elif step_back_s == 0.0:
            self._audit.add(Fault.REPEATED_STAMP, number)
        self._misplaced.clear()
        self._before_s = self._before_s[1], stamp
        return True


def check_consistency(path: Path, faults: Faults, scan_count: int, odometry_count: int, first_errors: str = "") -> None:
    """Reject a recording with too many inconsistent or damaged scans; ``first_errors`` say what is damaged."""
    broken = sum(faults[kind].count for kind in (Fault.BROKEN_LINE, Fault.BROKEN_MESSAGE))
    other, misplaced = faults[Fault.OTHER_BEAMS], faults[Fault.MISPLACED_SCAN]
    if broken > scan_count + odometry_count:
        raise SourceError(
            f"{path}: most {faults.unit}s are damaged{first_errors}, {faults}; copy or export the recording again"
        )
    if other.count > scan_count:
        raise SourceError(
            f"{path}: {faults.unit} {other.first_line}: {other.count} scans are not of the laser of the first ones "
            f"({scan_count} scans are): other beams; give one recording for each laser"
        )
    skipped_at_step = (FEWEST - 1) * faults[Fault.CLOCK_STEP].count
    if misplaced.count - skipped_at_step > TOLERATED_SHARE * scan_count:
        raise SourceError(
            f"{path}: {faults.unit} {misplaced.first_line}: time jumps back by up to {misplaced.largest_s:.6g} s, "
            "again and again; record it with one clock"
        )
