"""The part that all live robots share: it takes scans, tracks them at once and reports events."""

import logging
import math
import threading
from abc import ABC, abstractmethod
from collections import defaultdict, deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from fcslam.errors import InputError
from fcslam.lidar.facing import Contradiction, watch_facing
from fcslam.lidar.leaning import wrong_laser
from fcslam.live.inputs import Lasers, checked_lasers, checked_robot, checked_scan, checked_stamp
from fcslam.live.records import EventKind, RobotEvent, RobotPose
from fcslam.mission.mission import MissionConfig
from fcslam.records import CloudScan, FloatArray, LaserScan, SensorRecord, checked_pose, frozen
from fcslam.robot.frontend import NewestScan, RobotFrontend
from fcslam.sources.returns import FloorLine
from fcslam.wire.messages import Packet

if TYPE_CHECKING:
    from fcslam.robot.frontend3d import NewestTurn, RobotFrontend3d

UNDETERMINED_S = 1.0
"""The robot reports scans without odometry that leave a direction open for longer."""
WARNINGS = EventKind.LOST, EventKind.FLOOR, EventKind.UNDETERMINED, EventKind.OFFLINE, EventKind.FAILED
"""Events that are logged as warnings; the others are information."""

_OTHER_LIDAR: Final[dict[type, str]] = {
    CloudScan: "this is a turn of a 3D LiDAR; make the robot with lidar_3d=True",
    LaserScan: "this is a scan of a 2D LiDAR; make the robot without lidar_3d",
}

_log = logging.getLogger(__name__)


class LiveTracker(ABC):
    """Tracks the scans of one robot in the thread that adds them; a subclass knows where they are in a map."""

    _frontend: "RobotFrontend | RobotFrontend3d"
    _executor: Executor
    """The worker beside the tracker: for what no pose must wait for."""
    _stack: ExitStack
    """Resources that end with the robot."""

    def __init__(
        self, name: str, laser: Lasers | None, config: MissionConfig, on_event: Callable[[RobotEvent], None] | None
    ) -> None:
        self.name = checked_robot(name)
        self._lasers = checked_lasers(laser)
        self._config = config
        self._on_event = on_event
        self._lock = threading.RLock()
        self._newest_s = -math.inf
        self._scans = 0
        self._pose: RobotPose | None = None
        self._determined_s = -math.inf
        """Stamp of the newest scan that fixed the position; infinity after the event that none does."""
        self._is_finished = self._is_closed = False
        self._facing: defaultdict[tuple[float, float, float], list[LaserScan]] = defaultdict(list)
        self._examined: deque[Future[FloorLine | Contradiction | None]] = deque()
        """What the worker finds wrong with each laser: it takes as long as hundreds of scans."""
        self._told: set[str] = set()

    @abstractmethod
    def _take(self, packets: list[Packet]) -> None:
        """Pass the next packets of the front end on."""

    @abstractmethod
    def _pose_of(
        self, newest: "NewestScan | NewestTurn", T_smooth_base: FloatArray, T_odom_base: FloatArray | None
    ) -> RobotPose:
        """The pose of the newest scan, given that in the tracker's frame, shape (P,), and by odometry, shape (3,)."""

    @abstractmethod
    def _tell(self) -> None:
        """Tell what happened between two scans."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add_scan(
        self, ranges_m: ArrayLike, stamp: float, odometry: ArrayLike | None = None, laser: str = ""
    ) -> RobotPose:
        """Localize the next scan, and return its pose.

        Args:
            ranges_m: metres, one for each beam. NaN, negative, or at least ``max_range_m``: invalid; inf: no return,
                which clears the floor. If their number varies from scan to scan, they are spread over the laser's field
                of view.
            stamp: seconds. It may step back by 2 s at most, as clocks of several sensors disagree.
            odometry: pose (x, y, theta) of ``base`` by wheel odometry at the stamp, metres and radians; its origin does
                not matter. None for all scans: there is no odometry, and scan matching alone gives the motion; an event
                says where the scans do not determine it.
            laser: which one, if there are several.

        Raises:
            InputError: the ranges do not fit the laser, the clock went back by more than 2 s, a number cannot be used,
                or the robot is finished. The scan is ignored, and the next one may be added.
        """
        if laser not in self._lasers:
            raise InputError(f"laser {laser!r} is not known; known: {', '.join(map(repr, self._lasers)) or 'none'}")
        with self._lock:
            stamp = checked_stamp(stamp, self._newest_s)
            T_odom_base = self._odometry(odometry)
            return self._process(checked_scan(ranges_m, stamp, T_odom_base, self._lasers[laser]))

    def add(self, record: SensorRecord) -> RobotPose | None:
        """Add the next record of any sensor, as a recording yields them; returns the pose of a scan.

        The caller vouches for the record: unlike ``add_scan``, this checks nothing.
        """
        with self._lock:
            if isinstance(record, LaserScan | CloudScan):
                if not isinstance(record, self._frontend.scans):
                    raise InputError(f"{self.name}: {_OTHER_LIDAR[type(record)]}")
                return self._process(record)
            self._take(self._processed(record))
            return None

    @property
    def pose(self) -> RobotPose | None:
        """The pose of the newest scan; None before the first."""
        return self._pose

    @property
    def odometry_jumps(self) -> int:
        """Number of jumps of the odometry so far."""
        return self._frontend.jumps

    def close(self) -> None:
        """End the worker and the connection at once. Packets that the server does not have wait in the state folder.

        A second call does nothing.
        """
        self._is_finished = self._is_closed = True
        self._stack.close()

    @property
    def _session(self) -> int:
        return len(self._frontend.tracks) - 1

    def _processed(self, record: SensorRecord) -> list[Packet]:
        self._require_unfinished()
        return self._frontend.process(record)

    def _require_unfinished(self) -> None:
        if self._is_finished:
            raise InputError(f"{self.name}: the robot is finished; make a new Robot to go on")

    def _odometry(self, given: ArrayLike | None) -> FloatArray:
        if self._pose is not None and (given is None) is not (self._pose.T_odom_base is None):
            raise InputError(
                f"{self.name}: some scans have odometry and some have not; give it with every scan or with none"
            )
        return frozen(np.full(3, np.nan)) if given is None else checked_pose("odometry", given)

    def _process(self, scan: LaserScan | CloudScan) -> RobotPose:
        """Localize a scan and report events. A scan that repeats the previous one gets its pose."""
        before = self._frontend.newest
        self._take(self._processed(scan))
        if self._pose is not None and self._frontend.newest is before:
            return self._pose
        self._newest_s = max(self._newest_s, scan.stamp)
        self._scans += 1
        newest = self._newest()
        T_smooth_base = self._frontend.scan_poses.in_odom(newest.pose)
        T_odom_base = None if np.isnan(scan.T_odom_base).any() else scan.T_odom_base
        pose = self._pose = self._pose_of(newest, T_smooth_base, T_odom_base)
        if self._frontend.lacks_odometry:
            self._tell_undetermined(pose)
        if (fault := self._frontend.odometry_fault) is not None:
            self._tell_failure(f"the odometry {fault}; scan matching alone gives the motion")
        if isinstance(scan, LaserScan) and (watched := watch_facing(self._facing[scan.laser.T_base_laser], scan)):
            with suppress(RuntimeError):  # a worker that has ended is told by what needs it
                self._examined.append(self._executor.submit(wrong_laser, watched))
        self._tell_examined()
        self._tell()
        return pose

    def _tell_undetermined(self, pose: RobotPose) -> None:
        if pose.is_determined or self._scans == 1:
            self._determined_s = pose.stamp
        elif pose.stamp > self._determined_s + UNDETERMINED_S:
            self._determined_s = math.inf
            self._event(
                EventKind.UNDETERMINED,
                "the scans do not fix the position in every direction, and there is no odometry: the robot may move "
                "unseen",
            )

    def _tell_examined(self) -> None:
        while self._examined and self._examined[0].done():
            examined = self._examined.popleft()
            error = examined.exception()
            if error is not None:
                _log.warning("%s: how its laser faces was not examined: %s", self.name, error)
            elif (found := examined.result()) is not None:
                self._tell_failure(f"{found}; not corrected")

    def _tell_failure(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self._event(EventKind.FAILED, text)

    def _event(self, kind: EventKind, text: str) -> None:
        level = logging.WARNING if kind in WARNINGS else logging.INFO
        _log.log(level, "%s: %s", self.name, text)
        if self._on_event is not None:
            self._on_event(RobotEvent(kind, self._newest_s, text))

    def _newest(self) -> "NewestScan | NewestTurn":
        newest = self._frontend.newest
        assert newest is not None  # there is one after a scan
        return newest
