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
from fcslam.lidar.own_body import LEAST_MOVE_M, LEAST_TURN_RAD
from fcslam.lidar.scan import beam_times, rays_of
from fcslam.records import Beams, FloatArray, LaserScan, frozen

LONGEST_S: Final = 4.0
"""Scans farther apart in time are not compared: odometry drifts."""
MOST_COMPARED: Final = 3000
"""Scans that are read at most."""
MOST_PAIRS: Final = 40
"""Pairs with a move that are compared, and as many with a turn."""
SCANS_WATCHED: Final = 60
"""Scans of a live laser that are compared."""
FEWEST_PAIRS: Final = 5
"""Fewer pairs say nothing."""
FEW_PAIRS: Final = 20
"""About so many pairs decide whether another mounting is worth the search with all pairs."""
FEWEST_POINTS: Final = 20
"""Fewer common points of two scans are not compared."""
NOISE_M: Final = 0.1
"""Standard deviation of the ranges with the odometry between two scans."""
LARGEST_STEP_M: Final = 0.3
"""Beams side by side whose ranges differ by more see two things."""
WIDEST_GAP: Final = 3.0
"""Beams with a larger angle between them, as a multiple of the usual one, are not side by side."""
STEPS_DEG: Final = (30, 3)
"""Between the mountings that are tried, first and around the best."""
DISTANCES: Final = (0.25, 0.35, 0.5, 0.7, 1.4, 2.0, 2.8, 4.0)
TURNS: Final = (0.5, 0.75, 1.33, 2.0)
"""Scales of the distance and of turns that are tried; then those between."""
SQUARE_DEG: Final = 3
"""A laser that is turned by nearly a multiple of a right angle is turned by it."""
ENOUGH_AGREEMENT: Final = 0.75
"""Agreement with which a mounting is right."""
LEAST_AGREEMENT: Final = 0.6
"""Least agreement with the right mounting; below, the scans do not fit the odometry in any way."""
LEAST_TURNED: Final = 0.45
"""The same with the right scale of turns."""
LEAST_GAIN: Final = 0.1
"""Least gain in agreement over the stated mounting."""
LEAST_LEAD: Final = 0.05
"""Least gain in agreement over any other mounting, and of other ranges."""
SIGMAS: Final = 5.0
"""Least ratio of the gain to its standard deviation."""
CLEAR_LEAD, CLEAR_AGREEMENT = 0.15, 0.75
"""A mounting with this agreement and gain is certain, too: a short drive has too few pairs for the deviation."""
NO_AGREEMENT: Final = 0.4
"""Scans agree less with the stated mounting only if something is wrong."""
ENOUGH_PAIRS: Final = 10
"""Pairs with which that is certain, although no other mounting is."""

FAR_M, FAR_RAD = 1.0, 0.8
"""Two scans that are so far apart see the same walls from elsewhere, which shows whether ranges are too long."""
EXCESS_STEP_M: Final = 0.05
LEAST_EXCESS_M, LARGEST_EXCESS_M = 0.1, 1.0

LARGEST_WHEEL_SCALE: Final = 1.5
"""Distances that differ by a larger factor may be due to the unit of the ranges."""
BENT: Final = 1.15
"""Turns that differ by a larger factor may be due to the angles of the beams."""
LARGEST_SPAN_DEG: Final = 400.0
"""No beams span more than a turn, with the error of an estimate."""
UNITS_M: Final = {"feet": 0.3048, "inches": 0.0254}
SAME_UNIT: Final = 0.1
"""Largest relative difference of a distance from that of a unit."""


class Facing(NamedTuple):
    """How a laser faces, against its stated mounting."""

    turned_deg: float = 0.0
    """Seen from above, to the left."""
    upside_down: bool = False
    """Whether it is upside down where it is said to be upright, or the other way round."""
    distance: float = 1.0
    """Distance of the robot per distance by odometry."""
    turn: float = 1.0
    """Turn of the robot per turn by odometry."""


class Contradiction(NamedTuple):
    """A mounting that the scans contradict."""

    facing: Facing
    """How the laser faces; the default: not known."""
    agreement: float
    """Mean agreement of the points with the odometry, 0 to 1, as the laser faces."""
    stated_agreement: float
    """The same with the stated mounting."""
    beams: Beams
    """Of the laser, as stated."""

    @property
    def is_correctable(self) -> bool:
        """Whether another mounting, and nothing else, makes the scans fit the odometry."""
        return self.facing != Facing() and (self.facing.distance, self.facing.turn) == (1.0, 1.0)

    def __str__(self) -> str:
        """Why the mounting or the odometry cannot be right, and what to do."""
        return self.line(
            "correct the mounting in tf, or give --sensors laser-pose=X,Y,THETA[,upside-down], or correct the signs of "
            "the odometry"
        )

    def line(self, remedy: str) -> str:
        """The same with the remedy of a wrong mounting."""
        (turned_deg, upside_down, distance, turn), claims = self.facing, []
        if self.facing == Facing():
            return (
                f"the scans contradict the odometry: only {100 * self.stated_agreement:.0f} % of the points agree, and "
                "no other mounting is certain; check the mounting, that the ranges are distances in the order of their "
                "beams, and that both are of one robot"
            )
        if upside_down:
            claims.append(
                "turns go the other way: the laser is upside down, or is upright and stated upside down, or its beams "
                "go clockwise"
            )
        if turned_deg:
            side = "left" if turned_deg > 0.0 else "right"
            claims.append(f"the laser is turned by about {abs(turned_deg):.0f} deg to the {side} of what is stated")
        if distance != 1.0:
            claims.append(f"the robot's distance is {distance:.2f} of what odometry says")
            remedy = distance_remedy(distance)
        elif turn != 1.0:
            claims.append(f"the robot's turn is {turn:.2f} of what odometry says")
            remedy = turn_remedy(turn, self.beams)
        return (
            f"the scans contradict the odometry: {', and '.join(claims)} (then {100 * self.agreement:.0f} % of the "
            f"points agree, and {100 * self.stated_agreement:.0f} % as stated); {remedy}"
        )


class Excess(NamedTuple):
    """Ranges that are all too long by the same length."""

    excess_m: float
    """Below 0: they are too short."""
    agreement: float
    """Mean agreement of the points with the odometry, 0 to 1, without the excess."""
    stated_agreement: float
    """The same with the ranges as stated."""

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        wrong = "long" if self.excess_m > 0.0 else "short"
        return (
            f"the ranges are too {wrong} by about {abs(self.excess_m):.2f} m: without it {100 * self.agreement:.0f} % "
            f"of the points agree with the odometry, and {100 * self.stated_agreement:.0f} % as stated; correct the "
            "zero of the laser in its driver"
        )


def distance_remedy(distance: float) -> str:
    """What to do about a robot whose distance by scans is ``distance`` of that by odometry."""
    wheels = "correct the radius of the wheels in its driver"
    if 1.0 / LARGEST_WHEEL_SCALE < distance < LARGEST_WHEEL_SCALE:
        return wheels
    seem = (
        f", which seem to be {unit}" for unit, metres in UNITS_M.items() if abs(distance * metres - 1.0) < SAME_UNIT
    )
    return f"{wheels}, or the unit of the ranges{next(seem, '')}"


def turn_remedy(turn: float, beams: Beams) -> str:
    """What to do about a robot whose turn by scans is ``turn`` of that by odometry."""
    wheels = "correct the distance of the wheels in its driver"
    if 1.0 / BENT < turn < BENT:
        return wheels
    span_deg = math.degrees(beams.span_rad + beams.angle_increment_rad)
    if span_deg / turn > LARGEST_SPAN_DEG:
        return wheels
    return f"{wheels}, or the angles of the beams, which then span {span_deg / turn:.0f} deg and not {span_deg:.0f}"


class ScanPair(NamedTuple):
    """Two scans of one laser with a motion between them."""

    before: LaserScan
    after: LaserScan


def contradicted_facing(scans: Iterable[LaserScan]) -> Contradiction | None:
    """How the laser faces if it is certainly not as stated; None if the scans fit the odometry or say nothing.

    If it faces as stated in the result, the scans fit the odometry in no certain way.

    Args:
        scans: of one laser, with odometry; as many are read as are needed.
    """
    trial = _Trial(*_pairs(islice(scans, MOST_COMPARED)))
    as_stated = trial.agreements(Facing())
    if len(trial.pairs) < FEWEST_PAIRS or trial.mean(as_stated) > ENOUGH_AGREEMENT:
        return None
    few = trial.thinned()
    if few.mean(few.agreements(_best(few)[0])) - few.mean(few.agreements(Facing())) < 0.5 * LEAST_GAIN:
        return trial.without_mounting(as_stated)
    best, scores = _best(trial)
    square_deg = 90 * round(best.turned_deg / 90)
    if abs(best.turned_deg - square_deg) <= SQUARE_DEG:
        best = best._replace(turned_deg=square_deg)
    upright = best._replace(upside_down=False)
    if best.upside_down and not trial.leads(trial.agreements(best), trial.agreements(upright), LEAST_LEAD):
        best = upright  # moves alone do not tell
    found = trial.agreements(best)
    far = [each for each in scores if abs(math.remainder(each.turned_deg - best.turned_deg, 360)) > STEPS_DEG[0]]
    if best.distance == 1.0:
        far += [each for each in scores if each.distance != 1.0]
    if best.turn == 1.0:
        far += [each for each in scores if each.turn != 1.0]
    is_certain = trial.leads(found, as_stated, LEAST_GAIN) and all(
        trial.leads(found, scores[each], LEAST_LEAD) for each in far
    )
    least = LEAST_AGREEMENT if best.turn == 1.0 else LEAST_TURNED  # where angles are wrong, moves never agree
    if not is_certain or trial.mean(found) < least:
        return trial.without_mounting(as_stated)
    turned_deg = math.remainder(best.turned_deg, 360)
    beams = trial.pairs[0].before.laser.beams
    return Contradiction(best._replace(turned_deg=turned_deg), trial.mean(found), trial.mean(as_stated), beams)


def _best(trial: "_Trial") -> tuple[Facing, dict[Facing, FloatArray]]:
    """The mounting with the largest agreement, and the agreements of those that were tried first."""
    coarse, fine = STEPS_DEG
    scores = {
        facing: trial.agreements(facing)
        for facing in (
            *(Facing(turned, flipped) for flipped in (False, True) for turned in range(0, 360, coarse)),
            *(Facing(distance=distance) for distance in DISTANCES),
            *(Facing(turn=turn) for turn in TURNS),
        )
    }
    best = max(scores, key=lambda facing: trial.mean(scores[facing]))
    near = [best._replace(turned_deg=best.turned_deg + step) for step in range(-coarse // 2, coarse // 2 + 1, fine)]
    if best.distance != 1.0:
        near = [best._replace(distance=best.distance * 1.04**step) for step in range(-5, 6)]
    elif best.turn != 1.0:
        near = [best._replace(turn=best.turn * 1.04**step) for step in range(-4, 5)]
    return max(near, key=lambda facing: trial.mean(trial.agreements(facing))), scores


def excess_of(scans: Iterable[LaserScan]) -> Excess | None:
    """By how much all ranges are too long; None if they fit the odometry as well as stated, or say nothing.

    Two views of one wall from different places agree only with the right ranges, whatever its shape.
    """
    trial = _Trial(*_pairs(islice(scans, MOST_COMPARED), FAR_M, FAR_RAD))
    if len(trial.pairs) < ENOUGH_PAIRS:
        return None

    def agreements(excess_m: float) -> FloatArray:
        shorter = [ScanPair(_shorter(before, excess_m), _shorter(after, excess_m)) for before, after in trial.pairs]
        return np.array([_agreement(pair, Facing()) for pair in shorter])

    as_stated = found = agreements(0.0)
    excess_m = 0.0
    for step_m in (EXCESS_STEP_M, -EXCESS_STEP_M):
        while abs(excess_m) < LARGEST_EXCESS_M:
            further = agreements(excess_m + step_m)
            if trial.mean(further) <= trial.mean(found):
                break
            excess_m, found = excess_m + step_m, further
    if abs(excess_m) < LEAST_EXCESS_M or not trial.leads(found, as_stated, LEAST_LEAD):
        return None
    return Excess(excess_m, trial.mean(found), trial.mean(as_stated))


def _shorter(scan: LaserScan, by_m: float) -> LaserScan:
    """The scan with shorter returns; those that are not long enough are invalid."""
    is_return = (scan.ranges_m > 0.0) & (scan.ranges_m < scan.laser.max_range_m)
    return replace(scan, ranges_m=frozen(np.where(is_return, scan.ranges_m - by_m, scan.ranges_m), np.float32))


def part_agreement(scans: Iterable[LaserScan], part: Callable[[LaserScan], LaserScan]) -> float:
    """Mean agreement, 0 to 1, of a part of each scan with the scan before a move; NaN if few scans have it."""
    moves, _ = _pairs(islice(scans, MOST_COMPARED))
    found = np.array([_agreement(ScanPair(before, part(after)), Facing()) for before, after in moves])
    found = found[np.isfinite(found)]
    return float(found.mean()) if len(found) >= FEWEST_PAIRS else math.nan


class FacingWatch:
    """Collects scans of a live laser that tell how it faces."""

    def __init__(self) -> None:
        self._scans: list[LaserScan] = []

    def add(self, scan: LaserScan) -> Sequence[LaserScan]:
        """Add the next scan of the laser; returns the scans once, when its robot has moved enough."""
        if len(self._scans) == SCANS_WATCHED or (self._scans and not any(_moved(self._scans[-1], scan))):
            return ()
        self._scans.append(scan)
        return self._scans if len(self._scans) == SCANS_WATCHED else ()


class _Trial:
    """Pairs of scans on which mountings are compared; those with a turn count as much as those with a move."""

    def __init__(self, moves: list[ScanPair], turns: list[ScanPair]) -> None:
        self._moves, self._turns = moves, turns
        kinds = [moves, turns] if min(len(moves), len(turns)) >= ENOUGH_PAIRS // 2 else [[*moves, *turns]]
        self.pairs = [pair for kind in kinds for pair in kind]
        self._weights = np.array([1.0 / len(kind) for kind in kinds for _ in kind])

    def thinned(self) -> "_Trial":
        """About ``FEW_PAIRS`` of the pairs."""
        step = max(1, len(self.pairs) // FEW_PAIRS)
        return _Trial(self._moves[::step], self._turns[::step])

    def agreements(self, facing: Facing) -> FloatArray:
        """Agreement of each pair with a mounting; NaN if too few points are common."""
        return np.array([_agreement(pair, facing) for pair in self.pairs])

    def mean(self, agreements: FloatArray) -> float:
        """Mean of those that are known."""
        known = np.isfinite(agreements)
        weights = self._weights[known]
        return float((weights * agreements[known]).sum() / weights.sum()) if known.any() else 0.0

    def leads(self, scores: FloatArray, others: FloatArray, least: float) -> bool:
        """Whether one mounting is certainly better than another."""
        gains = scores - others
        known = np.isfinite(gains)
        if np.count_nonzero(known) < FEWEST_PAIRS:
            return False
        weights, gain = self._weights[known] / self._weights[known].sum(), self.mean(gains)
        sigma = math.sqrt(float((weights**2 * (gains[known] - gain) ** 2).sum()))
        is_clear = gain > CLEAR_LEAD and self.mean(scores) > CLEAR_AGREEMENT
        return is_clear or gain > max(least, SIGMAS * sigma)

    def without_mounting(self, as_stated: FloatArray) -> Contradiction | None:
        """That the stated mounting is wrong and no other certain; None if it may be right."""
        if np.count_nonzero(np.isfinite(as_stated)) < ENOUGH_PAIRS or self.mean(as_stated) > NO_AGREEMENT:
            return None
        agreement = self.mean(as_stated)
        return Contradiction(Facing(), agreement, agreement, self.pairs[0].before.laser.beams)


def _pairs(
    scans: Iterable[LaserScan], least_m: float = LEAST_MOVE_M, least_rad: float = LEAST_TURN_RAD
) -> tuple[list[ScanPair], list[ScanPair]]:
    """Pairs of scans one after the other with a move between them, and those with a turn."""
    moves: list[ScanPair] = []
    turns: list[ScanPair] = []
    first: LaserScan | None = None
    for scan in scans:
        if first is None or not 0.0 <= scan.stamp - first.stamp <= LONGEST_S:
            first = scan
            continue
        has_moved, has_turned = _moved(first, scan, least_m, least_rad)
        if has_moved or has_turned:
            pairs = turns if has_turned else moves
            if len(pairs) < MOST_PAIRS:
                pairs.append(ScanPair(first, scan))
            first = scan
        if len(moves) == len(turns) == MOST_PAIRS:
            break
    return moves, turns


def _moved(
    first: LaserScan, scan: LaserScan, least_m: float = LEAST_MOVE_M, least_rad: float = LEAST_TURN_RAD
) -> tuple[bool, bool]:
    """Whether the robot has moved and turned enough between two scans."""
    x, y, theta = se2.between(first.T_odom_base, scan.T_odom_base).tolist()
    return math.hypot(x, y) > least_m, abs(theta) > least_rad


def _agreement(pair: ScanPair, facing: Facing) -> float:
    """Mean agreement, 0 to 1, of the points of the later scan with the earlier one; NaN if too few are in its view."""
    before, after = pair
    T_base_laser = se2.compose(before.laser.T_base_laser, (0.0, 0.0, math.radians(facing.turned_deg)))
    T_before_after = _in_laser(se2.between(before.T_odom_base, after.T_odom_base), T_base_laser, facing)
    surface, is_surface = _points(before, T_base_laser, facing)
    points, is_return = _points(after, T_base_laser, facing)
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
    is_flat &= gap_rad < WIDEST_GAP * abs(before.laser.angle_increment_rad)
    if np.count_nonzero(is_flat) < FEWEST_POINTS:
        return math.nan
    share = (angle - directions[left]) / np.maximum(gap_rad, 1e-9)
    error_m = (distance_m - (ranges_m[left] + share * step_m))[is_flat]
    return float(np.exp(-0.5 * (error_m / NOISE_M) ** 2).mean())


def _in_laser(moved: FloatArray, T_base_laser: FloatArray, facing: Facing) -> FloatArray:
    """Motions of the base by odometry, shape (..., 3), as those of the laser that faces so."""
    moved = moved * (facing.distance, facing.distance, facing.turn)
    return se2.compose(se2.inverse(T_base_laser), se2.compose(moved, T_base_laser))


def _points(scan: LaserScan, T_base_laser: FloatArray, facing: Facing) -> tuple[FloatArray, NDArray[np.bool_]]:
    """The ends of the beams in the frame of the upright laser at the stamp, and which of them are returns.

    They are placed by the motion of the odometry during the scan. Shapes (beam_count, 2) and (beam_count,).
    """
    laser = scan.laser
    is_return = (scan.ranges_m > 0.0) & (scan.ranges_m < laser.max_range_m)
    ranges_m = np.where(is_return, scan.ranges_m, laser.max_range_m).astype(np.float64)
    directions = rays_of(replace(laser, T_base_laser=(0.0, 0.0, 0.0))).directions
    points = ranges_m[:, None] * directions * (1.0, -1.0 if facing.upside_down else 1.0)
    if scan.sweep is None:
        return points, is_return
    moved = scan.sweep.displacement(beam_times(laser, scan.sweep)[:, None])
    return se2.transform(_in_laser(moved, T_base_laser, facing), points[:, None])[:, 0], is_return
