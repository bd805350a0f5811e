"""Scans that may show another place than the scans before them: which they are, and what they turn out to show.

A robot defers its records while its scans are doubtful, for one of four reasons: its odometry may be frozen, there was
a gap without odometry, it leaves a closed cabin, or the map does not explain the scans (``fcslam.lidar.lost``). Once
there are enough of them, they are compared with the map, and an ``Outcome`` says how to go on.
"""

from enum import Enum, auto

from fcslam.lidar.lifts import LEAVING_M, LEAVING_SCANS, Cabin
from fcslam.lidar.lost import (
    DOUBTFUL_TRAVEL_M,
    GAP_TRAVEL_M,
    MOST_SCANS,
    SETTLED_M,
    LostConfig,
    can_decide,
    is_doubtful,
    is_lost,
)
from fcslam.lidar.tracker import TrackingResult
from fcslam.records import CameraImage, LaserScan
from fcslam.robot.predicted_motion import Deferred
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

    def __init__(self, config: LostConfig) -> None:
        self._config = config
        self._records: Deferred = []
        self._gap_s = 0.0
        """Time before the first of them in which nothing shows the motion; 0: there was no gap."""
        self._cabin = Cabin()

    def __len__(self) -> int:
        """Number of deferred records."""
        return len(self._records)

    def follows_gap(self, before: LaserScan, scan: LaserScan, session: Session) -> bool:
        """Whether nothing shows the motion between two scans, and there is a map in which to look for the later one."""
        return self._config.doubted > 0.0 and session.is_unseen(before, scan)

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
        if session.may_be_frozen or self._gap_s:
            return True
        return is_doubtful(tracking, session.lidar, self._config, self._cabin.is_leaving)

    def add(self, record: LaserScan | CameraImage) -> None:
        """Defer a record as it is."""
        self._records.append(record)

    def add_doubtful(self, scan: LaserScan, tracking: TrackingResult, session: Session) -> None:
        """Defer a doubtful scan, with its motion since those before it."""
        self.add(session.follow(self._records, scan, tracking))

    def can_decide(self, session: Session) -> bool:
        """Whether there are enough scans to compare them with the map."""
        travel_m, most = GAP_TRAVEL_M if self._gap_s else DOUBTFUL_TRAVEL_M, MOST_SCANS
        if self._cabin.is_leaving:
            travel_m, most = LEAVING_M, LEAVING_SCANS
        return not session.may_be_frozen and can_decide(self._scans, travel_m, most)

    @property
    def must_decide(self) -> bool:
        """Whether the scans are compared even if no more follow: only after a gap, if there are two."""
        return self._gap_s > 0.0 and len(self._scans) > 1

    def decide(self, session: Session) -> Outcome:
        """Compare the scans with the newest keyscans of the session; scans that are found elsewhere are moved there."""
        outcome = self._outcome(self._scans, session)
        self._cabin.leave()
        return outcome

    def begin_motion(self, second: LaserScan, session: Session) -> LaserScan:
        """Give the first scan the motion that the second one shows; returns the second one, predicted from it."""
        return session.begin_motion(self._records, second)

    def take(self) -> Deferred:
        """End the deferral; returns the records."""
        records, self._records, self._gap_s = self._records, [], 0.0
        return records

    @property
    def _scans(self) -> list[LaserScan]:
        return [record for record in self._records if isinstance(record, LaserScan)]

    def _outcome(self, scans: list[LaserScan], session: Session) -> Outcome:
        if self._cabin.is_leaving and not self._gap_s:
            return Outcome.OTHER_FLOOR if is_lost(scans, session.lidar, self._cabin.closed_s) else Outcome.SAME_PLACE
        if not self._gap_s and is_lost(scans, session.lidar):
            return Outcome.SAME_PLACE_OTHER_MAP if session.drove_on(scans) else Outcome.OTHER_PLACE
        return Outcome.SAME_PLACE if session.relocate(self._records, self._gap_s) else Outcome.OTHER_PLACE
