"""Which way a laser faces: pairs of scans against the odometry between them.

A laser that is turned by a large angle, or mounted upside down, contradicts the odometry in every step. The points of a
scan are moved by the odometry to the pose of an earlier one, with each mounting that is possible. Where the mounting is
right, they have the ranges that were measured there.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.lidar import calibration
from fcslam.lidar.calibration import FEWEST_PAIRS
from fcslam.lidar.own_body import moved_or_turned
from fcslam.lidar.scan import beam_times, rays_of
from fcslam.records import FloatArray, LaserScan
from fcslam.sources.point_clouds import GAP_PER_SPACING

LONGEST_S: Final = 2.0 * calibration.LONGEST_S
"""Scans farther apart in time are not compared: odometry drifts."""
SCANS_WATCHED: Final = 60
"""Scans of a live laser that are compared."""
MOST_COMPARED: Final = 50 * SCANS_WATCHED
"""Most scans of a recording that are read; many are too near to the previous one."""
MOST_PAIRS: Final = SCANS_WATCHED
"""Pairs with a move that are compared, and as many with a turn."""
ENOUGH_PAIRS: Final = 2 * FEWEST_PAIRS
"""Pairs with which it is certain that the stated mounting is wrong, although no other one is right."""
FEWEST_POINTS: Final = 20
"""Fewer common points of two scans are not compared."""
NOISE_M: Final = 0.1
"""Standard deviation of the ranges with the odometry between two scans."""
LARGEST_STEP_M: Final = 3.0 * NOISE_M
"""Beams side by side whose ranges differ by more see two things."""
STEPS_DEG: Final = (30, 3)
"""Between the mountings that are tried, first and around the best; nearly a multiple of a right angle counts as one."""
ENOUGH_AGREEMENT: Final = 0.75
"""Agreement with which a mounting is right."""
LEAST_AGREEMENT: Final = 0.6
"""Least agreement with the right mounting; below, the scans do not fit the odometry in any way."""
NO_AGREEMENT: Final = 1.0 - LEAST_AGREEMENT
"""Scans agree less with the stated mounting only if something is wrong."""
LEAST_GAIN: Final = 0.1
"""Least gain in agreement over the stated mounting."""
LEAST_LEAD: Final = 0.5 * LEAST_GAIN
"""Least gain in agreement over any other mounting."""
SIGMAS: Final = 5.0
"""Least ratio of the gain to its standard deviation."""
CLEAR_LEAD: Final = 3.0 * LEAST_LEAD
"""A right mounting with this gain is certain, too: a short drive has too few pairs for the deviation."""


class Facing(NamedTuple):
    """How a laser faces, against its stated mounting."""

    turned_deg: float = 0.0
    """Seen from above, to the left."""
    upside_down: bool = False
    """Whether it is upside down where it is said to be upright, or the other way round."""


AS_STATED: Final = Facing()
_Pair = tuple[LaserScan, LaserScan]
"""Two scans of one laser with a motion between them."""


class Contradiction(NamedTuple):
    """A mounting that the scans contradict."""

    facing: Facing
    """How the laser faces; ``AS_STATED``: not known."""
    agreement: float
    """Mean agreement of the points with the odometry, 0 to 1, as the laser faces."""
    stated_agreement: float
    """The same with the stated mounting."""

    def __str__(self) -> str:
        """Why the mounting or the odometry cannot be right, and what to do."""
        return self.line(
            "correct the mounting in tf, or give --sensors laser-pose=X,Y,THETA[,upside-down], or correct the signs of "
            "the odometry"
        )

    def line(self, remedy: str) -> str:
        """The same with the remedy of a wrong mounting."""
        turned_deg, upside_down = self.facing
        if self.facing == AS_STATED:
            return (
                f"the scans contradict the odometry: only {100 * self.stated_agreement:.0f} % of the points agree, and "
                "no other mounting is certain; check the mounting, the times of the beams, that the ranges are "
                "distances in metres and in the order of their beams, and that both are of one robot"
            )
        claims = []
        if upside_down:
            claims.append(
                "turns go the other way: the laser is upside down, or is upright and stated upside down, or its beams "
                "go clockwise"
            )
        if turned_deg:
            side = "left" if turned_deg > 0.0 else "right"
            claims.append(f"the laser is turned by about {abs(turned_deg):.0f} deg to the {side} of what is stated")
        return (
            f"the scans contradict the odometry: {', and '.join(claims)} (then {100 * self.agreement:.0f} % of the "
            f"points agree, and {100 * self.stated_agreement:.0f} % as stated); {remedy}"
        )


def contradicted_facing(scans: Iterable[LaserScan]) -> Contradiction | None:
    """How a laser faces if it is certainly not as stated; None if the scans fit the odometry or say nothing.

    If it faces as stated in the result, the scans fit the odometry in no certain way.
    """
    moves, turns = _pairs(islice(scans, MOST_COMPARED))
    trial = _Trial(moves, turns)
    as_stated = trial.agreements(AS_STATED)
    stated = trial.mean(as_stated)
    if len(trial.pairs) < FEWEST_PAIRS or stated > ENOUGH_AGREEMENT:
        return None
    coarse, fine = STEPS_DEG
    facings = [Facing(turned, flipped) for flipped in (False, True) for turned in range(0, 360, coarse)]
    some = _Trial(moves[::FEWEST_PAIRS], turns[::FEWEST_PAIRS])
    if stated > NO_AGREEMENT and max(facings, key=lambda facing: some.mean(some.agreements(facing))) == AS_STATED:
        return None  # a fifth of the pairs tells that no other mounting is right
    scores = {facing: trial.agreements(facing) for facing in facings}
    best = max(scores, key=lambda facing: trial.mean(scores[facing]))
    near = (best._replace(turned_deg=best.turned_deg + step) for step in range(-coarse // 2, coarse // 2 + 1, fine))
    best = max(near, key=lambda facing: trial.mean(trial.agreements(facing)))
    square_deg = 90 * round(best.turned_deg / 90)
    if abs(best.turned_deg - square_deg) <= fine:
        best = best._replace(turned_deg=square_deg)
    upright = best._replace(upside_down=False)
    if best.upside_down and not trial.leads(trial.agreements(best), trial.agreements(upright), LEAST_LEAD):
        best = upright  # moves alone do not tell
    found = trial.agreements(best)
    others = (scores[each] for each in scores if abs(math.remainder(each.turned_deg - best.turned_deg, 360)) > coarse)
    if (
        trial.mean(found) >= LEAST_AGREEMENT
        and trial.leads(found, as_stated, LEAST_GAIN)
        and all(trial.leads(found, other, LEAST_LEAD) for other in others)
    ):
        best = best._replace(turned_deg=math.remainder(best.turned_deg, 360))
        return Contradiction(best, trial.mean(found), stated)
    is_wrong = np.count_nonzero(np.isfinite(as_stated)) >= ENOUGH_PAIRS and stated <= NO_AGREEMENT
    return Contradiction(AS_STATED, stated, stated) if is_wrong else None


def part_agreement(scans: Iterable[LaserScan], part: Callable[[LaserScan], LaserScan]) -> float:
    """Mean agreement, 0 to 1, of a part of each scan with the scan before a move; NaN if few scans have it."""
    moves, _ = _pairs(islice(scans, MOST_COMPARED))
    found = np.array([_agreement((before, part(after)), AS_STATED) for before, after in moves])
    found = found[np.isfinite(found)]
    return float(found.mean()) if len(found) >= FEWEST_PAIRS else math.nan


def watch_facing(watched: list[LaserScan], scan: LaserScan) -> Sequence[LaserScan]:
    """Add the next scan of a live laser to those that tell how it faces; returns them once, when they are enough."""
    if len(watched) == SCANS_WATCHED or (watched and not any(moved_or_turned(watched[-1], scan))):
        return ()
    watched.append(scan)
    return watched if len(watched) == SCANS_WATCHED else ()


class _Trial:
    """Pairs of scans on which mountings are compared; those with a turn count as much as those with a move."""

    def __init__(self, moves: list[_Pair], turns: list[_Pair]) -> None:
        kinds = [moves, turns] if min(len(moves), len(turns)) >= FEWEST_PAIRS else [[*moves, *turns]]
        self.pairs = [pair for kind in kinds for pair in kind]
        self._weights = np.array([1.0 / len(kind) for kind in kinds for _ in kind])

    def agreements(self, facing: Facing) -> FloatArray:
        return np.array([_agreement(pair, facing) for pair in self.pairs])

    def mean(self, agreements: FloatArray) -> float:
        known = np.isfinite(agreements)
        weights = self._weights[known]
        return float((weights * agreements[known]).sum() / weights.sum()) if known.any() else 0.0

    def leads(self, scores: FloatArray, others: FloatArray, least: float) -> bool:
        gains = scores - others
        known = np.isfinite(gains)
        if np.count_nonzero(known) < FEWEST_PAIRS:
            return False
        weights, gain = self._weights[known] / self._weights[known].sum(), self.mean(gains)
        sigma = math.sqrt(float((weights**2 * (gains[known] - gain) ** 2).sum()))
        is_clear = gain > CLEAR_LEAD and self.mean(scores) > ENOUGH_AGREEMENT
        return is_clear or gain > max(least, SIGMAS * sigma)


def _pairs(scans: Iterable[LaserScan]) -> tuple[list[_Pair], list[_Pair]]:
    moves: list[_Pair] = []
    turns: list[_Pair] = []
    first: LaserScan | None = None
    for scan in scans:
        if first is None or not 0.0 <= scan.stamp - first.stamp <= LONGEST_S:
            first = scan
            continue
        has_moved, has_turned = moved_or_turned(first, scan)
        if has_moved or has_turned:
            pairs = turns if has_turned else moves
            if len(pairs) < MOST_PAIRS:
                pairs.append((first, scan))
            first = scan
        if len(moves) == len(turns) == MOST_PAIRS:
            break
    return moves, turns


def _agreement(pair: _Pair, facing: Facing) -> float:
    """Mean agreement, 0 to 1, of the points of the later scan with the earlier one; NaN if too few are in its view."""
    before, after = pair
    T_base_laser = se2.compose(before.laser.T_base_laser, (0.0, 0.0, math.radians(facing.turned_deg)))
    T_before_after = _in_laser(se2.between(before.T_odom_base, after.T_odom_base), T_base_laser)
    surface, is_surface = _points(before, T_base_laser, facing.upside_down)
    points, is_return = _points(after, T_base_laser, facing.upside_down)
    points = se2.transform(T_before_after, points[is_return])
    directions, ranges_m = np.arctan2(surface[:, 1], surface[:, 0]), np.hypot(surface[:, 0], surface[:, 1])
    order = np.argsort(directions)
    directions, ranges_m, is_surface = directions[order], ranges_m[order], is_surface[order]
    angle, distance_m = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    right = np.searchsorted(directions, angle)
    inside = (right > 0) & (right < len(directions))
    right, angle, distance_m = right[inside], angle[inside], distance_m[inside]
    left = right - 1
    gap_rad, step_m = directions[right] - directions[left], ranges_m[right] - ranges_m[left]
    is_flat = is_surface[left] & is_surface[right] & (np.abs(step_m) < LARGEST_STEP_M)
    is_flat &= gap_rad < GAP_PER_SPACING * abs(before.laser.angle_increment_rad)
    if np.count_nonzero(is_flat) < FEWEST_POINTS:
        return math.nan
    share = (angle - directions[left]) / np.maximum(gap_rad, 1e-9)
    error_m = (distance_m - (ranges_m[left] + share * step_m))[is_flat]
    return float(np.exp(-0.5 * (error_m / NOISE_M) ** 2).mean())


def _in_laser(moved: FloatArray, T_base_laser: FloatArray) -> FloatArray:
    return se2.compose(se2.inverse(T_base_laser), se2.compose(moved, T_base_laser))


def _points(scan: LaserScan, T_base_laser: FloatArray, upside_down: bool) -> tuple[FloatArray, NDArray[np.bool_]]:
    """The ends of the beams in the frame of the upright laser at the stamp, and which of them are returns.

    They are placed by the motion of the odometry during the scan. Shapes (beam_count, 2) and (beam_count,).
    """
    laser = scan.laser
    is_return = (scan.ranges_m > 0.0) & (scan.ranges_m < laser.max_range_m)
    ranges_m = np.where(is_return, scan.ranges_m, laser.max_range_m).astype(np.float64)
    _, directions = rays_of(replace(laser, T_base_laser=(0.0, 0.0, 0.0)))
    points = ranges_m[:, None] * directions * (1.0, -1.0 if upside_down else 1.0)
    if scan.sweep is None:
        return points, is_return
    moved = scan.sweep.displacement(beam_times(laser, scan.sweep)[:, None])
    return se2.transform(_in_laser(moved, T_base_laser), points[:, None])[:, 0], is_return
