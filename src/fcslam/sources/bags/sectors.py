"""Joins the sectors of a turn to one scan, from a laser that publishes each turn in several messages."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import nan, remainder, tau
from typing import Final

import numpy as np

from fcslam.geometry.beams import ROUNDING, SAME_VIEW_BEAMS
from fcslam.records import Beams, Sweep
from fcslam.sources.bags.messages import LONGEST_SWEEP_S, SHORTEST_SWEEP_S, ScanMessage, measured_ranges, reversed_sweep

NARROWEST_RAD, WIDEST_RAD = 0.01 * tau, 0.75 * tau
"""Field of view of a sector."""
WIDEST_HALF_RAD: Final = 3.0
"""Sectors of half a turn follow each other in either direction; they are taken to be counter-clockwise."""
LEAST_SHARE: Final = 1.0 / 3.0
"""Share of the scans that go on with a sector; it is a half for two sectors that leave a part of the turn out."""


def are_sectors(scans: Sequence[ScanMessage]) -> bool:
    """Whether many of these successive scans go on where the one before them ends."""
    return sum(_follows(a, b) for a, b in pairwise(scans)) > LEAST_SHARE * len(scans)


class SectorJoiner:
    """Joins the sectors of one laser as they come."""

    def __init__(self) -> None:
        self._sectors: list[ScanMessage] = []
        self._is_clockwise = False

    def add(self, sector: ScanMessage) -> Iterator[ScanMessage]:
        """Add the next sector; yields a turn that is complete."""
        if len(self._sectors) == 1:
            self._is_clockwise = _is_clockwise(self._sectors[0], sector)
        if self._sectors and not self._goes_on(sector):
            yield from self.flush()
        self._sectors.append(sector)
        beams = sector.beams
        if self._begin(sector) + beams.beam_count > _turn_beams(beams) - SAME_VIEW_BEAMS:
            yield from self.flush()

    def flush(self) -> Iterator[ScanMessage]:
        """Yield the turn so far."""
        if self._sectors:
            yield self._joined()
            self._sectors = []

    def _goes_on(self, sector: ScanMessage) -> bool:
        first, last = self._sectors[0], self._sectors[-1]
        end = self._begin(last) + last.beams.beam_count
        begin = self._begin(sector)
        return (
            _is_alike(first, sector)
            and 0.0 <= sector.stamp - first.stamp < LONGEST_SWEEP_S
            and begin > end - SAME_VIEW_BEAMS
            and begin + sector.beams.beam_count < _turn_beams(first.beams) + SAME_VIEW_BEAMS
        )

    def _begin(self, sector: ScanMessage) -> int:
        """Beams from the beginning of the turn to that of a sector, in the order in which they are measured."""
        first = self._sectors[0]
        forward_rad = sector.beams.angle_min_rad - first.beams.angle_min_rad
        if self._is_clockwise:
            forward_rad = first.beams.span_rad - forward_rad - sector.beams.span_rad
        count = _turn_beams(first.beams)
        return round(forward_rad / first.beams.angle_increment_rad) % count

    def _joined(self) -> ScanMessage:
        first, last = self._sectors[0], self._sectors[-1]
        count, increment_rad = _turn_beams(first.beams), first.beams.angle_increment_rad
        ranges_m = np.full(count, nan, np.float32)
        for sector in self._sectors:
            at = (self._begin(sector) + np.arange(sector.beams.beam_count)) % count
            ranges_m[at] = measured_ranges(sector)[::-1] if self._is_clockwise else measured_ranges(sector)
        begin_s, end_s = (_middle_s(sector) - first.stamp for sector in (first, last))
        begin, end = (self._begin(sector) + 0.5 * (sector.beams.beam_count - 1) for sector in (first, last))
        beam_s = (end_s - begin_s) / (end - begin) if end > begin else 0.0
        first_s = begin_s - begin * beam_s
        sweep = Sweep(first_s, first_s + (count - 1) * beam_s) if count * beam_s > SHORTEST_SWEEP_S else None
        first_rad = first.beams.angle_min_rad
        if self._is_clockwise:
            first_rad += first.beams.span_rad - (count - 1) * increment_rad
            ranges_m, sweep = ranges_m[::-1], reversed_sweep(sweep)
        return first._replace(
            beams=Beams(count, remainder(first_rad, tau), increment_rad),
            range_min_m=min(sector.range_min_m for sector in self._sectors),
            range_max_m=max(sector.range_max_m for sector in self._sectors),
            raw_ranges_m=ranges_m,
            sweep=sweep,
        )


def joined_turns(sectors: Sequence[ScanMessage]) -> list[ScanMessage]:
    """The complete turns of successive sectors; the last one as it is if none is complete."""
    joiner = SectorJoiner()
    return [turn for sector in sectors for turn in joiner.add(sector)] or list(joiner.flush())


def _follows(a: ScanMessage, b: ScanMessage) -> bool:
    if not _is_alike(a, b):
        return False
    increment_rad, step_rad = a.beams.angle_increment_rad, b.beams.angle_min_rad - a.beams.angle_min_rad
    forward_rad = remainder(step_rad - a.beams.beam_count * increment_rad, tau)
    backward_rad = remainder(step_rad + b.beams.beam_count * increment_rad, tau)
    return min(abs(forward_rad), abs(backward_rad)) < SAME_VIEW_BEAMS * increment_rad


def _is_alike(a: ScanMessage, b: ScanMessage) -> bool:
    increment_rad, other_rad = a.beams.angle_increment_rad, b.beams.angle_increment_rad
    is_sector = all(NARROWEST_RAD < each.beams.span_rad < WIDEST_RAD for each in (a, b))
    return a.frame == b.frame and is_sector and abs(other_rad - increment_rad) <= ROUNDING * increment_rad


def _is_clockwise(a: ScanMessage, b: ScanMessage) -> bool:
    if a.sweep is not None:
        return a.sweep.last_s < a.sweep.first_s
    turned_rad = remainder(b.beams.angle_min_rad - a.beams.angle_min_rad, tau)
    return -WIDEST_HALF_RAD < turned_rad < 0.0


def _turn_beams(beams: Beams) -> int:
    return round(tau / beams.angle_increment_rad)


def _middle_s(sector: ScanMessage) -> float:
    return sector.stamp + (0.0 if sector.sweep is None else 0.5 * (sector.sweep.first_s + sector.sweep.last_s))
