"""Scan-to-submap tracking: every scan is matched; odometry only starts the match and steadies it."""

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.correlative import SearchWindow, search
from fcslam.lidar.evidence import CLEAR, CLEAR_GAIN, FAR, LEAST_KNOWN, judged_by, over_steps, resolve
from fcslam.lidar.field import CELL_M, SurfelField
from fcslam.lidar.matching import FIXED, WIDE_SCALE_M, ScanMatch, match_scan, seen_information
from fcslam.lidar.odometry import FIRST_MATCHES, PRIOR_TAIL, OdometryError, OdometryModel, OdometryTrust, odometry_error
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.records import FloatArray, LaserScan, Sweep
from fcslam.sources.motion import STILL_M, STILL_RAD

GOOD_SIGMA = 0.3
"""The points of a good match, by which odometry is judged, fix the position in every direction to this share of
odometry's error by the model, so that its distance from odometry is the error of odometry. The match is clear, too."""
SEARCH_SIGMA_M = 0.02
"""Limit in metres, for a match that explains the known area: its points must fix the position so well in every
direction. Along a bare wall the points hardly distinguish poses, and the pattern of the beams favours some.
"""
LONG_STEP_M, LONG_STEP_RAD, JUMP_SHARE, JUMP_GAIN = 0.3, 0.35, 0.85, 20.0
"""Odometry may jump, as when its driver restarts at zero. After a step so long that the scan contradicts, the robot is
also looked for where it was. There the scan must show what it did before: so large a share of the points on surfaces,
and a log-likelihood higher by ``JUMP_GAIN``."""
LARGEST_VELOCITY = 30.0
"""Largest velocity of a robot in a sweep, m/s and rad/s: a match that says more is wrong."""
PRIOR_SCALE = 3.0
"""Standard deviation of the position in the prior of a match, per learned one: points count fully in the matcher."""
UNSURE_M = 0.05
"""Learned standard deviation of odometry, in metres, beyond which a match has several starts. After a long step a match
may end at a maximum of the likelihood that is nearer to odometry than the right one."""
CLUTTER_SCALE_M = 0.5 * WIDE_SCALE_M
"""Least scale of the loss of points without a normal after such a step, metres: a hedge then shows other points."""
UNSURE_SUPPORTED = 0.2
"""``SUPPORTED`` after such a step: odometry alone errs by more than a match of which less is known."""
NO_INFORMATION = np.zeros((3, 3))
_DIRECTIONS = np.array([(0.0, 0.0, 0.0), *product((-1.0, 1.0), repeat=3)])


POINT_SPACING_M = CELL_M
"""Least distance between consecutive points of a scan that are matched, metres."""
POINT_LIMIT = 180
"""Largest number of points of a scan that are matched."""
BUFFER_KEYSCANS = 60
"""Keyscans of one laser in a full running buffer."""
SUPPORTED = 0.30
"""Least share of a scan's points on known surfaces; below it, odometry alone gives the pose."""
DOUBTFUL = 0.75
"""Least share of the points in known area on surfaces; below it, a correlative search starts."""
SEARCH_WINDOW = SearchWindow(radius_m=1.0, angle_rad=0.5)
"""The correlative search after a doubtful match."""


class TrackedScan(NamedTuple):
    """One scan's pose in the tracker's own smooth frame."""

    T_local_base: FloatArray
    information: FloatArray
    """Information of the scan's points, over (x, y) in the local frame and theta, shape (3, 3); zeros if odometry alone
    gives the pose."""
    scan: PointScan | None
    """The scan's points in ``base``; None if the robot stands still and the points were not computed."""
    sweep: Sweep | None = None
    """Times of the beams, and the motion as the scan was matched."""


class TrackerState(NamedTuple):
    """From where a tracker goes on."""

    T_local_base: FloatArray
    """Pose of the last scan, shape (3,)."""
    T_odom_base: FloatArray | None = None
    """The same by wheel odometry; None before the first scan."""
    moved_m: float = 0.0
    turned_rad: float = 0.0
    """Travel and turn since the last accepted match, by odometry."""
    matched_here: frozenset[tuple[float, float, float]] = frozenset()
    """Mountings of the lasers whose scans were matched since the robot last moved."""
    trust: OdometryTrust = OdometryTrust()
    """Trust in odometry, learned from all matches."""


class TrackingResult(NamedTuple):
    """The match of one scan, and the state of the tracker after it (see ``ScanTracker.commit``)."""

    tracked: TrackedScan
    state: TrackerState
    explained: float = math.nan
    """Share of the scan's points that lie on a surface of the running buffer, also if the match is not accepted."""
    known: float = math.nan
    """Share of the scan's points near any surface; NaN, as ``explained``, if the scan was not matched."""

    @property
    def quality(self) -> float:
        """Share of the points in known area that lie on a surface; NaN if the scan was not matched."""
        return self.explained / self.known if self.known > 0.0 else math.nan


class ScanTracker:
    """Tracks one robot in a running buffer of keyscans (Karto), kept as two overlapping surfel fields.

    Scans are matched against the older field. When it is full it is dropped, and the younger one, half full, takes its
    place. So a scan always sees between half a buffer and a full one, and nothing is ever removed from a field.
    """

    def __init__(self, odometry: OdometryModel) -> None:
        self._odometry = odometry
        self._fields: list[tuple[SurfelField, int]] = []
        self._state = TrackerState(np.zeros(3))

    def localize(self, scan: LaserScan) -> TrackingResult:
        """Find the pose of the next scan; the tracker does not change before ``commit``."""
        # 1. Prediction: the last pose, moved by odometry.
        state, predicted = self._state, self._predicted(scan)
        T_local_guess, moved_m, turned_rad = predicted.T_local_base, predicted.moved_m, predicted.turned_rad
        by_odometry = TrackedScan(T_local_guess, NO_INFORMATION, None, scan.sweep)
        # The scans of a robot that has not moved since the last match are not matched.
        is_still = self._odometry.is_measured and moved_m < STILL_M and turned_rad < STILL_RAD
        matched_here = (state.matched_here if is_still else frozenset()) | {scan.laser.T_base_laser}
        if self._fields and is_still and matched_here == state.matched_here:
            return TrackingResult(by_odometry, predicted)
        # 2. Scan to points.
        points = point_scan(scan.matched_ranges_m, scan.laser, scan.sweep)
        if not self._fields:
            return TrackingResult(by_odometry._replace(scan=points), predicted._replace(matched_here=matched_here))
        # 3. Scan matching; a doubtful match starts a correlative search, also where the robot was if odometry may have
        #    jumped. A match against odometry needs evidence.
        error = odometry_error(moved_m, turned_rad, self._odometry)
        thinned = points.thinned(POINT_SPACING_M, POINT_LIMIT)
        velocity = self._velocity_information(scan.sweep)
        step_m, step_rad = moved_m - state.moved_m, turned_rad - state.turned_rad
        is_long = step_m > LONG_STEP_M or step_rad > LONG_STEP_RAD
        match, innovation = self._match(points, thinned, T_local_guess, error, turned_rad, velocity, is_long)
        has_jumped = contradicts = False
        if match.explained < DOUBTFUL and is_long:
            other, stayed = self._match(points, thinned, state.T_local_base, error, turned_rad, velocity)
            is_fixed = weakest_sigma_m(other.information) < SEARCH_SIGMA_M
            is_better = other.log_likelihood > match.log_likelihood + JUMP_GAIN
            if is_fixed and is_better and other.explained >= JUMP_SHARE:
                match, innovation, T_local_guess, has_jumped = other, stayed, state.T_local_base, True
        if self._odometry.is_measured:  # a prediction was right only as long as the motion went on as before
            learned = over_steps(state.trust.scale(error), moved_m, step_m)
            field, fitting = self._fields[0][0], match
            match, contradicts = resolve(thinned, field, T_local_guess, match, learned, turned_rad, velocity)
            if match is not fitting:
                innovation = se2.motion(T_local_guess, match.T_field_base)
        # 4. A match that explains too little is not accepted: odometry alone gives the pose.
        if match.explained < (UNSURE_SUPPORTED if self._is_unsure(error) else SUPPORTED):
            tracked = by_odometry._replace(T_local_base=T_local_guess, scan=points)
            return TrackingResult(tracked, predicted._replace(T_local_base=T_local_guess), match.explained, match.known)
        information = match.information
        if not self._odometry.is_measured:
            information = seen_information(thinned, self._fields[0][0], match)
        tracked = TrackedScan(match.T_field_base, information, points, _corrected(scan.sweep, match.velocity))
        # 5. A good match shows how far odometry can be trusted, and every match how likely scans are here.
        learns = _is_good(match, error) and not (contradicts or has_jumped)
        accepted = TrackerState(
            match.T_field_base,
            scan.T_odom_base,
            matched_here=matched_here,
            trust=state.trust.learn(innovation, error, self._measured(scan)) if learns else state.trust,
        )
        return TrackingResult(tracked, accepted, match.explained, match.known)

    def commit(self, result: TrackingResult) -> None:
        """Continue from the pose that ``localize`` found."""
        self._state = result.state

    def insert(self, points: PointScan, T_local_base: FloatArray, laser_count: int = 1) -> None:
        """Add a keyscan in its ``base`` to the running buffer, which the keyscans of some lasers share."""
        capacity = laser_count * BUFFER_KEYSCANS
        if not self._fields or (len(self._fields) == 1 and self._fields[0][1] >= capacity // 2):
            self._fields.append((SurfelField(T_local_base), 0))
        elif self._fields[0][1] >= capacity:
            self._fields = [self._fields[1], (SurfelField(T_local_base), 0)]
        for field, _ in self._fields:
            field.insert(points, T_local_base)
        self._fields = [(field, count + 1) for field, count in self._fields]

    @property
    def trust(self) -> OdometryTrust:
        """Trust in odometry, learned from all matches so far."""
        return self._state.trust

    def T_odom_base(self, T_local_base: FloatArray) -> FloatArray:
        """Pose by odometry, shape (3,), of a scan that is predicted at ``T_local_base``, shape (3,)."""
        last = np.zeros(3) if self._state.T_odom_base is None else self._state.T_odom_base
        return se2.compose(last, se2.between(self._state.T_local_base, T_local_base))

    def empty_buffer(self) -> None:
        """Forget all keyscans: the pose goes on by odometry until the next one is inserted."""
        self._fields = []

    def _predicted(self, scan: LaserScan) -> TrackerState:
        """The state moved by odometry to a scan that is not matched."""
        state = self._state
        last = scan.T_odom_base if state.T_odom_base is None else state.T_odom_base
        x, y, turn = motion = state.trust.motion(se2.motion(last, scan.T_odom_base))
        return state._replace(
            T_local_base=se2.compose(state.T_local_base, motion),
            T_odom_base=scan.T_odom_base,
            moved_m=state.moved_m + math.hypot(x, y),
            turned_rad=state.turned_rad + abs(turn),
        )

    def _measured(self, scan: LaserScan) -> se2.Pose:
        """Motion that odometry measured since the last match; zeros if the last scan was not matched."""
        last = self._state.T_odom_base
        if not self._odometry.is_measured or last is None or self._state.moved_m > 0.0:
            return 0.0, 0.0, 0.0
        return se2.motion(last, scan.T_odom_base)

    def _is_unsure(self, error: OdometryError) -> bool:
        return self._odometry.is_measured and self._state.trust.position * error.position_m > UNSURE_M

    def _velocity_information(self, sweep: Sweep | None) -> FloatArray:
        """Information of the velocity in a sweep, shape (3,), by odometry's error in the motion during the sweep."""
        if sweep is None:
            return FIXED
        duration_s, (x, y, theta) = sweep.duration_s, sweep.mean_velocity
        moved_m, turned_rad = duration_s * math.hypot(x, y), duration_s * abs(theta)
        error = self._state.trust.scale(odometry_error(moved_m, turned_rad, self._odometry))
        position, heading = duration_s / error.position_m, duration_s / error.heading_rad
        return np.array((position**2, position**2, heading**2))

    def _match(
        self,
        points: PointScan,
        thinned: PointScan,
        T_local_guess: FloatArray,
        error: OdometryError,
        turned_rad: float,
        velocity: FloatArray,
        is_long_step: bool = False,
    ) -> tuple[ScanMatch, se2.Pose]:
        """The match at a guess, and its pose relative to that."""
        field = self._fields[0][0]
        learned = self._state.trust.scale(error)
        if self._is_unsure(error):
            match = _likeliest(thinned, field, T_local_guess, learned, velocity)
        else:
            # Walls give the heading nearly everywhere, the position not: along a bare one only wheels do.
            prior = OdometryError(min(error.position_m, PRIOR_SCALE * learned.position_m), error.heading_rad)
            tail = PRIOR_TAIL if self._state.trust.matches >= FIRST_MATCHES else math.inf
            match = match_scan(thinned, field, T_local_guess, prior.information, velocity, prior_tail=tail)
        innovation = se2.motion(T_local_guess, match.T_field_base)
        contradicts = judged_by(learned, turned_rad).mahalanobis2(innovation) >= FAR**2
        is_doubtful = match.explained < DOUBTFUL * match.known or contradicts
        if not is_doubtful and not is_long_step:
            return match, innovation
        best, _ = search(points, field, T_local_guess, SEARCH_WINDOW, visible_only=True, better_than=match.T_field_base)
        if np.array_equal(best, match.T_field_base):
            return match, innovation
        other = match_scan(thinned, field, best, NO_INFORMATION, velocity)
        other_innovation = se2.motion(T_local_guess, other.T_field_base)
        gain = other.log_likelihood + learned.log_likelihood(other_innovation)
        gain -= match.log_likelihood + learned.log_likelihood(innovation)
        # The best of many poses explains some points by chance.
        is_fixed = is_doubtful or weakest_sigma_m(other.information) < SEARCH_SIGMA_M
        return (other, other_innovation) if is_fixed and gain > CLEAR_GAIN else (match, innovation)


def _likeliest(
    scan: PointScan, field: SurfelField, T_local_guess: FloatArray, learned: OdometryError, velocity: FloatArray
) -> ScanMatch:
    """The likeliest match of several starts: the guess, and one standard deviation from it in every direction."""
    deviations = _DIRECTIONS * (learned.position_m, learned.position_m, learned.heading_rad)
    matches = (
        match_scan(scan, field, start, NO_INFORMATION, velocity, clutter_scale_m=CLUTTER_SCALE_M)
        for start in se2.compose(T_local_guess, deviations)
    )
    return max(
        matches,
        key=lambda match: match.log_likelihood + learned.log_likelihood(se2.motion(T_local_guess, match.T_field_base)),
    )


def _corrected(sweep: Sweep | None, velocity: FloatArray) -> Sweep | None:
    if sweep is None:
        return None
    x, y, theta = np.clip(np.add(sweep.velocity, velocity), -LARGEST_VELOCITY, LARGEST_VELOCITY).tolist()
    return sweep._replace(velocity=(x, y, theta))


def _is_good(match: ScanMatch, error: OdometryError) -> bool:
    explains = match.explained >= CLEAR * match.known and match.known >= LEAST_KNOWN
    return explains and weakest_sigma_m(match.information) <= GOOD_SIGMA * error.position_m


def weakest_sigma_m(information: FloatArray) -> float:
    """Standard deviation of the position by a scan's points, in the direction that they fix least, metres.

    ``information`` is over (x, y) and theta, shape (3, 3); infinity if the points fix no position.
    """
    (xx, xy), (_, yy) = information[:2, :2].tolist()
    weakest = 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy)  # the lesser eigenvalue
    return weakest**-0.5 if weakest > 0.0 else math.inf
