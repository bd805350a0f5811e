"""Finds recordings in which the laser measures nothing, or in another unit, from a sample of their scans.

- Nothing: nearly no beam has a return.
- Another unit: the values are too large for a 2D LiDAR, and as varied as ranges. A driver that sends a large number for
  no return sends few different ones.
- Whole numbers: no laser rounds ranges to metres. Intensities are whole numbers.
- A placeholder: one value repeats exactly in many beams at most places of a drive, and values near it are rare. Along a
  wall they are not, as the beams beside the nearest one are a little longer, however coarse the ranges are.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import degrees, hypot, inf, remainder, tau
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fcslam.records import FloatArray, LaserScan, Ranges, frozen
from fcslam.sources.faults import FEWEST
from fcslam.sources.pose import Pose

FEWEST_RETURNS = 0.02
"""Share of the beams."""
LONGEST_USUAL_M = 50.0
"""Half of the returns of a 2D LiDAR are nearer."""
_VARIED, _MOST_COMMON = 0.5, 8
"""Share that the most common values have at most where values are varied, and their number."""
_TOO_FAR = 0.6
"""Share of varied values beyond the maximum that no laser has."""
_WHOLE, _FEWEST_VALUES = 0.95, 3
"""Share of the different values that are whole where all are, and their least number."""
_REPEATED, _PLACES = 0.1, 0.5
"""Share of the beams that have a placeholder, and of the places at which as many have it."""
_NEAR, _ABOVE_NEAR = 2, 5
"""How many values to each side are near another, and how many times more frequent than these a placeholder is."""
_KEPT = 256
"""Most scans that are kept."""
_APART = 0.3
"""Metres or radians between two places."""


_AT_FLOOR, _ASIDE = 0.88, 0.17
"""Share of the distance of the floor from which on ranges are of it, as robots nod; and least cosine of the angle to
its nearest point where it is seen."""


class FloorLine(NamedTuple):
    """The line in which a leaning laser sees the floor; it moves with the robot."""

    distance_m: float
    heading_rad: float
    """Direction of its nearest point, among the angles of the beams."""

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        return (
            f"the laser leans and sees the floor: a line {self.distance_m:.1f} m away, at "
            f"{degrees(self.heading_rad):.0f} deg among its beams, moves with the robot; mount it level"
        )

    def left_out(self, scan: LaserScan) -> LaserScan:
        """The scan with NaN, an invalid range, for what would be at the floor or beyond it."""
        ahead = np.cos(scan.laser.angles_rad() - self.heading_rad)
        is_floor = (ahead > _ASIDE) & (scan.ranges_m * ahead > _AT_FLOOR * self.distance_m)
        return replace(scan, ranges_m=frozen(np.where(is_floor, np.float32(np.nan), scan.ranges_m), np.float32))


class _Sample(NamedTuple):
    values: Ranges
    range_min_m: float
    range_max_m: float
    T_odom_base: Pose


class RangeSample:
    """Samples of the scans of one laser, spread over its recording."""

    def __init__(self, count: int) -> None:
        """``count`` scans are recorded, about."""
        self._samples: list[_Sample] = []
        self._seen, self._step = 0, 1 + count // _KEPT

    def add(self, T_odom_base: Pose, values: Ranges, range_min_m: float, range_max_m: float) -> None:
        """Add the next scan, with its values as sent and the ranges that are returns."""
        if self._seen % self._step == 0:
            self._samples.append(_Sample(values, range_min_m, range_max_m, T_odom_base))
        self._seen += 1

    def placeholders(self) -> tuple[float, ...]:
        """The values that are not ranges."""
        places = self._samples[:1]
        for sample in self._samples:
            if is_apart(places[-1].T_odom_base, sample.T_odom_base):
                places.append(sample)
        beams = sum(len(sample.values) for sample in places)
        if len(places) <= FEWEST:
            return ()
        values, counts = np.unique(np.concatenate([_returns(place) for place in places]), return_counts=True)
        found = []
        for value, count in zip(values[counts > _REPEATED * beams], counts[counts > _REPEATED * beams], strict=True):
            at_index = int(np.searchsorted(values, value))
            near = np.concatenate((counts[max(at_index - _NEAR, 0) : at_index], counts[at_index + 1 :][:_NEAR]))
            at = sum(np.count_nonzero(place.values == value) > _REPEATED * len(place.values) for place in places)
            if at > _PLACES * len(places) and count > _ABOVE_NEAR * near.max(initial=0):
                found.append(float(value))
        return tuple(found)

    def problem(self, which: str, remedy: str) -> str:
        """Why the recording cannot be mapped; empty if it can.

        Args:
            which: the laser, empty or with a blank before it.
            remedy: what to check if nearly no beam has a return.
        """
        if len(self._samples) < FEWEST:
            return ""
        returns = np.concatenate([_returns(one) for one in self._samples])
        beyond = np.concatenate([one.values[one.values >= one.range_max_m] for one in self._samples])
        beyond = beyond[beyond < inf]
        beams = sum(len(one.values) for one in self._samples)
        nearest, farthest = self._samples[0].range_min_m, self._samples[0].range_max_m
        limits = f"({nearest:g} m to {farthest:g} m)"
        large = beyond if len(beyond) > _TOO_FAR * beams and _is_varied(beyond) else returns
        middle = float(np.median(large)) if len(large) else 0.0
        different = np.unique(np.concatenate((returns, beyond)))
        is_whole = len(different) >= _FEWEST_VALUES and bool(np.mean(different == np.rint(different)) > _WHOLE)
        if large is beyond or (middle > LONGEST_USUAL_M and _is_varied(returns)):
            return (
                f"half of the ranges{which} are above {middle:g}, too much for metres {limits}; they seem to be in "
                f"another unit{', or intensities' * is_whole}, or range_max is too low: correct them and record again"
            )
        if is_whole:
            return (
                f"the ranges{which} are whole numbers, such as {different[len(different) // 2]:g}, and no distances in "
                "metres; check that the driver does not publish intensities in their place"
            )
        share = len(returns) / max(beams, 1)
        if share < FEWEST_RETURNS:
            return (
                f"only {share:.1%} of the beams{which} measure a range {limits} in {len(self._samples)} sampled scans; "
                f"check that the laser is not covered, {remedy}, and record again"
            )
        return ""


def without(values: Ranges, placeholders: Sequence[float]) -> Ranges:
    """The ranges with placeholders made invalid, NaN."""
    if not placeholders:
        return values
    is_placeholder = np.isin(values, np.array(placeholders, np.float32))
    return frozen(np.where(is_placeholder, np.float32(np.nan), values), np.float32)


def placeholder_note(path: Path, placeholders: Sequence[float], which: str) -> list[str]:
    """The notice about placeholders; empty without any."""
    shown = ", ".join(f"{value:g}" for value in placeholders)
    return [f"{path}: {shown} m repeats exactly in many beams{which} everywhere, so it is not a range"] * bool(shown)


def is_apart(a: Pose, b: Pose) -> bool:
    """Whether a robot at these poses sees the building from different places."""
    return hypot(b[0] - a[0], b[1] - a[1]) > _APART or abs(remainder(b[2] - a[2], tau)) > _APART


def _returns(sample: _Sample) -> FloatArray:
    values = sample.values.astype(np.float64)
    return values[(values > max(sample.range_min_m, 0.0)) & (values < sample.range_max_m)]


def _is_varied(values: FloatArray | Ranges) -> bool:
    counts = np.sort(np.unique(values, return_counts=True)[1])
    return bool(counts[-_MOST_COMMON:].sum() < _VARIED * len(values))
