"""Records of a live robot: poses, counts and events."""

import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np

from fcslam.geometry import se2
from fcslam.geometry.groups import SE2, SE3, compose
from fcslam.lidar.tracker import SEARCH_SIGMA_M, weakest_sigma_m
from fcslam.records import FloatArray, frozen
from fcslam.robot.backend_runner import worker_process
from fcslam.robot.outbox import WaitingPackets
from fcslam.robot.track import ScanBelief
from fcslam.wire.http_transport import HttpTransport

_PLANAR: Final = np.ix_((0, 1, 5), (0, 1, 5))
"""x, y and heading of a covariance in space."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotPose:
    """Where a robot is at one scan, in its map."""

    stamp: float
    """Stamp of the scan, seconds."""
    T_map_base: FloatArray
    """Pose (x, y, theta) of ``base`` in the robot's map, shape (3,), metres and radians. It jumps when a correction
    arrives; ``T_map_odom`` holds the jump, so a controller that works in ``odom`` sees none. NaN in a finished map
    where the robot is not localized."""
    T_odom_base: FloatArray | None
    """The odometry that was given with the scan, shape (3,); None without odometry."""
    quality: float
    """Share of the scan's points in known area that lie on known surfaces, in [0, 1]; NaN if the scan was not
    compared: it is the first one, or the robot stands still. In a finished map: that of the walls seen lately; 0 where
    the robot is not localized."""
    is_localized: bool
    """False while the scans contradict the map, and after that until the robot's place in the map is found again; in a
    finished map also until it is found first."""
    map_index: int | None
    """Identifies the map; robots with the same index share it. It may change when maps join. None: the robot is in
    a map of its own that has no index yet."""
    _belief: ScanBelief
    _before: FloatArray
    """Covariance of the keyscan before in the map, shape (3, 3); 0 in a map of the robot's own, which begins there."""
    T_map_base_6d: FloatArray | None = None
    """The pose with six degrees of freedom, (x, y, z, qx, qy, qz, qw), shape (7,); None in a map in 2D."""

    @property
    def pose(self) -> FloatArray:
        """The pose with all degrees of freedom that the map has, shape (3,) or (7,)."""
        return self.T_map_base if self.T_map_base_6d is None else self.T_map_base_6d

    @property
    def x(self) -> float:
        """Metres."""
        return float(self.T_map_base[0])

    @property
    def y(self) -> float:
        """Metres."""
        return float(self.T_map_base[1])

    @property
    def theta(self) -> float:
        """Radians, in [-pi, pi)."""
        return float(self.T_map_base[2])

    @property
    def is_determined(self) -> bool:
        """Whether the scan fixes the position in every direction.

        Where it does not, as in a bare corridor, the odometry gives the motion along it; without odometry nothing does.
        A robot that stands still keeps its pose: True.
        """
        points = self._belief.points
        return points is None or weakest_sigma_m(points) <= SEARCH_SIGMA_M

    @property
    def covariance(self) -> FloatArray:
        """Covariance of ``T_map_base`` over (x, y, theta) along the axes of ``map``, shape (3, 3), m^2, m rad, rad^2.

        It is that of the match with the surfaces that the robot saw last; in a finished map, that of the match with the
        map is added. The error of the map is not part of it. NaN where ``T_map_base`` is.
        """
        covariance = self._covariance
        return frozen(self._before + (covariance if len(covariance) == SE2.freedom else covariance[_PLANAR]))

    @property
    def covariance_6d(self) -> FloatArray:
        """The same over (x, y, z) and the rotations about the axes of ``map``, shape (6, 6); 0 where a robot with a 2D
        LiDAR measures nothing."""
        covariance, planar = self._covariance, np.zeros((SE3.freedom, SE3.freedom))
        planar[_PLANAR] = self.covariance
        return frozen(planar if len(covariance) == SE2.freedom else covariance)

    @property
    def _covariance(self) -> FloatArray:
        covariance = self._belief.covariance()
        group = SE2 if len(covariance) == SE2.freedom else SE3
        turned = np.array(self.T_map_base if group is SE2 else self.T_map_base_6d)
        turned[: group.axes] = 0.0
        turn = group.adjoint(turned)
        return turn @ covariance @ turn.T

    @property
    def T_map_odom(self) -> FloatArray | None:
        """Where the frame of the given odometry lies in the map, shape (3,): the transform ``map -> odom`` of ROS
        REP 105. None without odometry, and in a finished map where the robot is not localized."""
        if self.T_odom_base is None or np.isnan(self.T_map_base[0]):
            return None
        return frozen(se2.compose(self.T_map_base, se2.inverse(self.T_odom_base)))

    @property
    def T_map_odom_6d(self) -> FloatArray | None:
        """The same with six degrees of freedom, shape (7,); None in a map in 2D, too."""
        if self.T_odom_base is None or self.T_map_base_6d is None:
            return None
        return frozen(compose(self.T_map_base_6d, se2.inverse(self.T_odom_base)))

    @property
    def z(self) -> float:
        """Metres; 0 in a map in 2D."""
        return 0.0 if self.T_map_base_6d is None else float(self.T_map_base_6d[2])


class LocalizationState(StrEnum):
    """Whether a robot knows its pose in its map."""

    MAPPING = "mapping"
    """It was never lost on this floor."""
    LOST = "lost"
    """It maps in a new session, whose transform to the map and to its earlier sessions is not known yet."""
    RELOCALIZED = "relocalized"
    """It was lost, and its new session is joined to the map."""
    LOCALIZED = "localized"
    """It knows its pose in a finished map."""
    NOT_LOCALIZED = "not localized"
    """It does not know its pose in a finished map."""


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """State of a robot: its place in the map, its connection, and counts since its start."""

    waiting: WaitingPackets = WaitingPackets(0, 0)  # noqa: RUF009
    """Packets that the server has not confirmed."""
    confirmed: int = 0
    """Packets that the server has confirmed."""
    sent_bytes: int = 0
    """Bytes of the packets that were sent, each time that they were."""
    left_out: int = 0
    """Places that are not sent, because the state folder or the budget has no room for them."""
    refused: int = 0
    """Packets that the server will never store."""
    trouble: str | None = None
    """Why packets do not arrive; None if they do, or if there is no server."""
    is_catching_up: bool = False
    """Whether a resumed recording has not yet reached the point of interruption."""
    scans: int = 0
    keyscans: int = 0
    map_index: int | None = None
    """Index of the robot's map; None before the first correction."""
    correction_age_s: float | None = None
    """Age of the newest correction; None before the first, and in a finished map."""
    quality: float = 0.0
    """Quality of the newest correction, in [0, 1]: how well other sessions support the robot's place in the map."""
    times_lost: int = 0
    """Number of times the robot was lost since it started or came to its floor."""
    notices: tuple[str, ...] = ()
    """Messages about packets of another mission, refused packets, the last detector update, a failed back end, jumps
    of the odometry, and settings without effect, if there were any."""
    is_localized: bool | None = None
    """Whether the robot knows its pose in a finished map; None if it makes a map of its own."""

    @property
    def localization(self) -> LocalizationState:
        """Whether the robot knows its pose."""
        if self.is_localized is not None:
            return LocalizationState.LOCALIZED if self.is_localized else LocalizationState.NOT_LOCALIZED
        if not self.times_lost:
            return LocalizationState.MAPPING
        return LocalizationState.RELOCALIZED if self.quality > 0.0 else LocalizationState.LOST


class EventKind(StrEnum):
    """Kinds of events of a live robot."""

    LOST = "lost"
    """The scans contradict the map: the robot maps in a new session until its place is found. In a finished map, it is
    searched for again."""
    FLOOR = "floor"
    """The robot is on another floor, and maps in a new session."""
    LOCALIZED = "localized"
    """The place of the robot in a finished map is found."""
    RELOCALIZED = "relocalized"
    """The place of a lost robot in the map is found."""
    JOINED = "joined"
    """The robot's map got another index: it joined another map, or maps were renumbered."""
    CORRECTED = "corrected"
    """A correction moved the robot in its map, as a loop closure does."""
    UNDETERMINED = "undetermined"
    """The robot has no odometry, and for a second its scans have not fixed its position in every direction: along a
    bare corridor, or among few walls, it may move unseen."""
    FLEET = "fleet"
    """Robots came into the robot's map, or left it: maps joined or split, or a robot was taken out."""
    OFFLINE = "offline"
    """The server cannot be reached; packets wait in the state folder."""
    ONLINE = "online"
    """The server confirms packets, for the first time or again."""
    FAILED = "failed"
    """A part of the robot stopped working; it goes on without."""


@dataclass(frozen=True, slots=True)
class RobotEvent:
    """Something that happened to a live robot."""

    kind: EventKind
    stamp: float
    """Stamp of the newest scan, seconds."""
    text: str
    """One line for people."""


class Wiring(NamedTuple):
    """What a live robot takes from the computer, and what fcslam's own commands ask of it."""

    executor: Executor | None = None
    """Runs the back end and the map, in its only worker. None: a process of its own, which ends with the robot."""
    clock: Callable[[], float] = time.monotonic
    """Seconds of any origin, for the age of corrections and for retries."""
    sleep: Callable[[float], None] = time.sleep
    """Sleeps for a number of seconds while ``finish`` waits for the server."""
    recording: str = "live"
    """Fingerprint of the recording that is played, and of the settings."""
    resumes: bool = False
    """Whether the robot read the recording before and was interrupted; its packets come again."""
    keeps_keyframes: bool = False
    """Whether the camera's keyframes stay in the state folder until the next start, for a process that learns."""
    transport: HttpTransport | None = None
    """Connection to a cloud of a test. None: that to the robot's server, if it has one."""

    def started(self, stack: ExitStack) -> Executor:
        """The executor; a process of the robot's own ends with ``stack``."""
        if self.executor is not None:
            return self.executor
        executor = worker_process()
        stack.callback(executor.shutdown, cancel_futures=True)
        return executor


WIRED: Final = Wiring()
