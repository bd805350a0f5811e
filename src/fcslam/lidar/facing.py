"""Which way a laser faces: pairs of scans against the odometry between them.

A laser that is turned by a large angle, or mounted upside down, contradicts the odometry in every step. The points of a
scan are moved by the odometry to the pose of an earlier one, with each mounting that is possible. Where the mounting is
right, they have the ranges that were measured there.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice
from typing import Final, NamedTuple, Self

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.leaning import floor_line
from fcslam.lidar.scan import point_scan
from fcslam.lidar.straightness import Excess, excess_of
from fcslam.records import Beams, FloatArray, LaserScan
from fcslam.sources.returns import FloorLine

LEAST_MOVE_M: Final = 0.3
LEAST_TURN_RAD: Final = 0.3
"""Two scans are compared once the robot has moved or turned by so much."""
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
"""Least gain in agreement over any other mounting."""
SIGMAS: Final = 5.0
"""Least ratio of the gain to its standard deviation."""
CLEAR_LEAD, CLEAR_AGREEMENT = 0.15, 0.75
"""A mounting with this agreement and gain is certain, too: a short drive has too few pairs for the deviation."""
NO_AGREEMENT: Final = 0.4
"""Scans agree less with the stated mounting only if something is wrong."""
ENOUGH_PAIRS: Final = 10
"""Pairs with which that is certain, although no other mounting is."""

WHEELS: Final = 1.5
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


def distance_remedy(distance: float) -> str:
    """What to do about a robot whose distance by scans is ``distance`` of that by odometry."""
    wheels = "correct the radius of the wheels in its driver"
    if 1.0 / WHEELS < distance < WHEELS:
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
    points: FloatArray
    """Of the later scan in the frame of an upright laser, shape (N, 2), metres."""

    @classmethod
    def of(cls, before: LaserScan, after: LaserScan) -> Self:
        """A pair of scans."""
        at_laser = replace(after.laser, T_base_laser=(0.0, 0.0, 0.0))
        return cls(before, after, point_scan(after.ranges_m, at_laser).points)


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


def wrong_laser(scans: Sequence[LaserScan]) -> FloorLine | Excess | Contradiction | None:
    """What is wrong with how a laser is mounted or measures, by the scans of a ``FacingWatch``."""
    return floor_line(scans) or excess_of(scans) or contradicted_facing(scans)


class FacingWatch:
    """Collects scans of a live laser that tell how it faces and whether it measures distances."""

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


def _pairs(scans: Iterable[LaserScan]) -> tuple[list[ScanPair], list[ScanPair]]:
    """Pairs of scans one after the other with a move between them, and those with a turn."""
    moves: list[ScanPair] = []
    turns: list[ScanPair] = []
    first: LaserScan | None = None
    for scan in scans:
        if first is None or not 0.0 <= scan.stamp - first.stamp <= LONGEST_S:
            first = scan
            continue
        has_moved, has_turned = _moved(first, scan)
        if has_moved or has_turned:
            pairs = turns if has_turned else moves
            if len(pairs) < MOST_PAIRS:
                pairs.append(ScanPair.of(first, scan))
            first = scan
        if len(moves) == len(turns) == MOST_PAIRS:
            break
    return moves, turns


def _moved(first: LaserScan, scan: LaserScan) -> tuple[bool, bool]:
    """Whether the robot has moved and turned enough between two scans."""
    x, y, theta = se2.between(first.T_odom_base, scan.T_odom_base).tolist()
    return math.hypot(x, y) > LEAST_MOVE_M, abs(theta) > LEAST_TURN_RAD


def _agreement(pair: ScanPair, facing: Facing) -> float:
    """Mean agreement, 0 to 1, of the points of the later scan with the earlier one; NaN if too few are in its view."""
    before, after, in_laser = pair
    T_base_laser = se2.compose(before.laser.T_base_laser, (0.0, 0.0, math.radians(facing.turned_deg)))
    moved = se2.between(before.T_odom_base, after.T_odom_base) * (facing.distance, facing.distance, facing.turn)
    T_before_after = se2.compose(se2.inverse(T_base_laser), se2.compose(moved, T_base_laser))
    sign = -1.0 if facing.upside_down else 1.0
    points = se2.transform(T_before_after, in_laser * (1.0, sign))
    beams = before.laser.beams
    middle_rad = beams.angle_min_rad + 0.5 * beams.span_rad
    angle = se2.wrap_angle(sign * np.arctan2(points[:, 1], points[:, 0]) - middle_rad)
    beam = (angle + 0.5 * beams.span_rad) / beams.angle_increment_rad
    index = np.floor(beam).astype(np.intp)
    inside = (index >= 0) & (index < beams.beam_count - 1)
    index, share, distance = index[inside], (beam - index)[inside], np.hypot(points[:, 0], points[:, 1])[inside]
    left, right = before.ranges_m[index].astype(np.float64), before.ranges_m[index + 1].astype(np.float64)
    is_surface = (np.minimum(left, right) > 0.0) & (np.maximum(left, right) < before.laser.max_range_m)
    left, right, share, distance = left[is_surface], right[is_surface], share[is_surface], distance[is_surface]
    is_flat = np.abs(left - right) < LARGEST_STEP_M
    if np.count_nonzero(is_flat) < FEWEST_POINTS:
        return math.nan
    error_m = (distance - (left + share * (right - left)))[is_flat]
    return float(np.exp(-0.5 * (error_m / NOISE_M) ** 2).mean())
