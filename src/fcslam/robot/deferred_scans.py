"""Scans that may show another place than the scans before them: which they are, and what they turn out to show.

A robot defers its records while its scans are doubtful, for one of four reasons: its odometry may be frozen, there was
a gap without odometry, it leaves a closed cabin, or the map does not explain the scans (``fcslam.lidar.lost``). Once
there are enough of them, they are compared with the map, and an ``Outcome`` says how to go on.
"""

from dataclasses import replace
from enum import Enum, auto

from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S, first_sweep
from fcslam.lidar.frontend import LidarConfig, LidarFrontend
from fcslam.lidar.lifts import LEAVING_M, LEAVING_SCANS, Cabin
from fcslam.lidar.lost import (
    DOUBTFUL_TRAVEL_M,
    GAP_TRAVEL_M,
    MOST_SCANS,
    SEEN_S,
    SETTLED_M,
    LostConfig,
    can_decide,
    drove_on,
    is_doubtful,
    is_in_reach,
    is_lost,
    is_unplaced,
    relocated,
    rode,
)
from fcslam.lidar.tracker import TrackingResult
from fcslam.records import CameraImage, FloatArray, LaserScan, frozen
from fcslam.robot.motion import RobotMotion
from fcslam.robot.motion_prediction import PREDICTED, MotionPrediction
from fcslam.robot.session import Session


class Outcome(Enum):
    """What doubtful scans show."""

    SAME_PLACE = auto()
    SAME_PLACE_OTHER_MAP = auto()
    """The robot drove on, and its newest keyscans are wrong: another local map begins, tied to the past by odometry."""
    OTHER_PLACE = auto()
    """The robot is lost."""
    OTHER_FLOOR = auto()
    """The robot took a lift."""


class DeferredScans:
    """The records since the first doubtful scan."""

    def __init__(self, robot: str, config: LidarConfig, lost: LostConfig, motion: RobotMotion) -> None:
        self._robot, self._config, self._lost, self._motion = robot, config, lost, motion
        self._records: list[LaserScan | CameraImage] = []
        self._gap_s = 0.0
        """Time before the first of them in which nothing shows the motion; 0: there was no gap."""
        self._cabin = Cabin()
        self._own_map: LidarFrontend | None = None
        """Matches scans without odometry with each other, from the second one on."""
        self._T_odom_first = se2.IDENTITY
        """Pose of the first one of them, shape (3,)."""

    def __len__(self) -> int:
        """Number of deferred records."""
        return len(self._records)

    @property
    def scans(self) -> list[LaserScan]:
        """The scans among the records."""
        return [record for record in self._records if isinstance(record, LaserScan)]

    def follows_gap(self, before: LaserScan, scan: LaserScan, session: Session) -> bool:
        """Whether nothing shows the motion between two scans of a robot without odometry."""
        is_gap = self._motion.prediction is not None and scan.stamp - before.stamp > LONGEST_GAP_S
        return is_gap and session.newest is not None and self._lost.doubted > 0.0

    def begin_gap(self, gap_s: float) -> None:
        """Defer the scans from the next one on, as nothing shows the motion in the ``gap_s`` seconds before it."""
        self._gap_s = gap_s

    def watch_cabin(self, scan: LaserScan, session: Session) -> None:
        """Follow the next scan in and out of a cabin, once something is known from before its door closed."""
        if session.lidar.settled_m < SETTLED_M:
            self._cabin.leave()
        else:
            self._cabin.add(scan)

    def leave_cabin(self) -> None:
        """Nothing is known any more from before the door of a cabin closed."""
        self._cabin.leave()

    def is_doubtful(self, tracking: TrackingResult, session: Session) -> bool:
        """Whether a localized scan may show another place than those before it."""
        if self._motion.may_be_frozen or self._gap_s:
            return True
        return is_doubtful(tracking, session.lidar, self._lost, self._cabin.is_leaving)

    def add(self, record: LaserScan | CameraImage) -> None:
        """Defer a record as it is."""
        self._records.append(record)

    def add_doubtful(self, scan: LaserScan, tracking: TrackingResult, session: Session) -> None:
        """Defer a doubtful scan, where odometry or the match with the scans deferred before puts it."""
        prediction = self._motion.prediction
        self.add(scan if prediction is None else self._follow(prediction, scan, tracking, session))

    @property
    def can_decide(self) -> bool:
        """Whether there are enough scans to compare them with the map."""
        travel_m, most = GAP_TRAVEL_M if self._gap_s else DOUBTFUL_TRAVEL_M, MOST_SCANS
        if self._cabin.is_leaving:
            travel_m, most = LEAVING_M, LEAVING_SCANS
        return not self._motion.may_be_frozen and can_decide(self.scans, travel_m, most)

    @property
    def must_decide(self) -> bool:
        """Whether the scans are compared even if no more follow: only after a gap, if there are two."""
        return self._gap_s > 0.0 and len(self.scans) > 1

    def decide(self, session: Session) -> Outcome:
        """Compare the scans with the newest keyscans of the session; a robot found elsewhere is moved there."""
        outcome = self._outcome(self.scans, session)
        self._cabin.leave()
        return outcome

    def take(self) -> list[LaserScan | CameraImage]:
        """End the deferral; returns the records."""
        records, self._records, self._gap_s = self._records, [], 0.0
        return records

    def place_first(self, second: LaserScan) -> LaserScan:
        """Give the first scan the motion during it that the second one shows; returns the first one."""
        first = self._records[0]
        assert isinstance(first, LaserScan)  # images are deferred only behind a scan
        self._records[0] = first = replace(first, sweep=first_sweep(first, second, PREDICTED))
        return first

    def _outcome(self, scans: list[LaserScan], session: Session) -> Outcome:
        lidar, prediction = session.lidar, self._motion.prediction
        if self._cabin.is_leaving and not self._gap_s:
            return Outcome.OTHER_FLOOR if rode(scans, lidar, self._cabin.closed_s) else Outcome.SAME_PLACE
        if not self._gap_s and is_lost(scans, lidar):
            is_whole = self._motion.odometry.jumps == session.jumps
            is_driving = is_whole and drove_on(session.explained, scans, lidar)
            return Outcome.SAME_PLACE_OTHER_MAP if is_driving else Outcome.OTHER_PLACE
        if prediction is None:
            return Outcome.SAME_PLACE
        found = relocated(scans, lidar)
        if found is not None and is_in_reach(found, scans[0], lidar, self._gap_s):
            self._move(prediction, lidar.T_odom_base(found), scans[0].T_odom_base)
            return Outcome.SAME_PLACE
        is_elsewhere = found is not None and not self._gap_s
        if is_elsewhere or self._gap_s > SEEN_S or is_unplaced(scans[0], lidar):
            return Outcome.OTHER_PLACE
        return Outcome.SAME_PLACE

    def _move(self, prediction: MotionPrediction, T_odom_found: FloatArray, T_odom_first: FloatArray) -> None:
        """Predict the first scan where it was found, and the others after it."""
        T = se2.compose(T_odom_found, se2.inverse(T_odom_first))
        prediction.move(T)
        self._records = [
            replace(record, T_odom_base=frozen(se2.compose(T, record.T_odom_base)))
            if isinstance(record, LaserScan)
            else record
            for record in self._records
        ]

    def _follow(
        self, prediction: MotionPrediction, scan: LaserScan, tracking: TrackingResult, session: Session
    ) -> LaserScan:
        """A doubtful scan of a robot without odometry, with its motion.

        The first one is where the map has it. As they may show another place, the others are matched with each other.
        """
        if not self._records:
            self._own_map, self._T_odom_first = None, session.in_odom(scan.stamp, tracking.tracked)
            return prediction.follow(scan, self._T_odom_first, tracking.tracked.sweep)
        origin = self._T_odom_first
        if self._own_map is None:
            first = self.place_first(scan)
            self._own_map = LidarFrontend(self._robot, self._config, PREDICTED)
            self._own_map.process(first)
            prediction.begin(first, origin)
            scan = prediction.predict(scan)
        scan, own = self._motion.track(scan, self._own_map, lambda tracked: se2.compose(origin, tracked.T_local_base))
        scan = prediction.follow(scan, se2.compose(origin, own.tracked.T_local_base), own.tracked.sweep)
        self._own_map.process(scan, own._replace(T_odom_base=scan.T_odom_base))
        return scan
