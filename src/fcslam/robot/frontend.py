"""The front end of one robot: sensor records in, packets out. It knows no network and no other robot.

It localizes every scan at once. Everything else is the work of the back end (``fcslam.robot.backend``), which may run
beside it: packets then come out later, but in the same order and with the same contents.

While scans are doubtful (``fcslam.lidar.lost``), records are deferred. If they show the same place as before, they are
processed normally. If they show another place, the robot is lost: its session ends before the doubtful scans, and a new
one begins with them, as after a restart. So no unmeasured motion enters a map. After a ride in a lift
(``fcslam.lidar.lifts``), the new session is on a floor without a name: the cloud finds out whether it knows this one.
"""

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field

from fcslam.errors import FeatureError
from fcslam.geometry import se2
from fcslam.lidar.first_motion import first_sweep
from fcslam.lidar.frontend import LidarFrontend, ScanPose
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
    has_moved_unseen,
    is_doubtful,
    is_in_reach,
    is_lost,
    is_unplaced,
    relocated,
    rode,
)
from fcslam.lidar.odometry import WHEELS, OdometryModel
from fcslam.lidar.tracker import DOUBTFUL, TrackedScan, TrackingResult
from fcslam.records import (
    CameraImage,
    DetectorFile,
    FloatArray,
    GnssFix,
    KeyscanFix,
    KeyscanId,
    LaserScan,
    SensorRecord,
    Sweep,
    frozen,
)
from fcslam.robot.backend import (
    BackendInput,
    NewDetector,
    NewImage,
    NewKeyscan,
    PlaceKeyframes,
    RobotBackend,
    SessionConfig,
    SessionEnd,
    essential,
)
from fcslam.robot.backend_runner import BackendRunner, InlineBackend
from fcslam.robot.mapped_scans import MappedScans
from fcslam.robot.motion_prediction import LONGEST_S, PREDICTED, MotionPrediction
from fcslam.robot.odometry_gate import OdometryGate, OdometryLimits, WheelCheck
from fcslam.robot.track import ScanTrack
from fcslam.sources.contradictions import RepeatedScans
from fcslam.sources.gate import is_clock_step
from fcslam.wire.messages import Body, Hello, Packet

LATE_S = 0.5
"""Largest time between a fix and the scan whose pose it measures."""
MOST_FIXES = 100
"""Fixes that wait for a scan; older ones are dropped."""


class RobotConfig(SessionConfig):
    """Settings of one robot."""

    lost: LostConfig = Field(default=LostConfig(), description="when the robot is lost and starts a new session")
    odometry: OdometryLimits = Field(
        default=OdometryLimits(), description="jumps of the wheel odometry, which scan matching bridges"
    )


@dataclass(frozen=True, slots=True)
class _Waiting:
    """An input that the back end has not handled yet."""

    input: BackendInput
    output: "Future[list[Body]]"
    epoch: int
    time: float
    """The largest stamp so far."""


class NewestScan(NamedTuple):
    """The tracker's result for the newest scan."""

    pose: ScanPose
    tracked: TrackedScan
    quality: float
    """Share of the points in known area that lie on a surface; NaN if the scan was not matched."""
    is_deferred: bool
    """Whether it waits for the decision whether the robot is lost."""


class RobotFrontend:
    """Turns the sensor records of a robot into packets; the poses of all scans stay on the robot.

    The epoch of a packet is the number of its session, from 0.
    """

    def __init__(
        self,
        robot: str,
        config: RobotConfig,
        backend: BackendRunner | None = None,
        mark: Callable[[LaserScan], LaserScan] = lambda scan: scan,
    ) -> None:
        """Start the first session.

        Args:
            robot: its name.
            config: its settings.
            backend: runs the back end beside this front end; None: it runs inline.
            mark: marks the beams of a scan that hit other robots, before it is matched.

        Raises:
            FeatureError: the detector of camera images is a network whose weights cannot be used.
        """
        self.robot = robot
        self.tracks: list[ScanTrack] = []
        """Poses of the scans, by session."""
        self.backend_failure: str | None = None
        """Why the back end ended early; from then on the robot sends neither closures nor places. None if it works."""
        self.odometry = OdometryGate(config.odometry)
        """Jumps of the odometry so far."""
        self.prediction: MotionPrediction | None = None
        """Stands in for the odometry; None if there is odometry."""
        self._config, self._mark = config, mark
        self._repeated = RepeatedScans()
        self._mapped = MappedScans(config.lidar.ignore, config.lidar.footprint)
        self._backend = InlineBackend(RobotBackend(robot, config)) if backend is None else backend
        self._waiting: deque[_Waiting] = deque()
        self._time = float("-inf")
        self._sequence = 0
        self._hello: Hello | None = None
        """The last hello of the present session."""
        self.newest: NewestScan | None = None
        """The newest scan; None before the first."""
        self._newest: tuple[LaserScan, ScanPose] | None = None
        """The newest scan of the present session that was processed."""
        self._previous: LaserScan | None = None
        """The newest scan, processed or not."""
        self._before_s = (float("-inf"), float("-inf"))
        """Stamps of the two newest scans."""
        self._scans: dict[tuple[float, float, float], LaserScan] = {}
        """The newest scan of each laser, by its mounting."""
        self._jumps = 0
        """Jumps of the odometry up to the newest scan that was processed."""
        self._explained: dict[tuple[float, float, float], LaserScan] = {}
        """The newest scan of each laser that the map explained, by its mounting."""
        self._deferred: list[LaserScan | CameraImage] = []
        """Records since the first doubtful scan."""
        self._beside: LidarFrontend | None = None
        """Matches deferred scans without odometry with each other, from the second one on."""
        self._T_odom_beside = se2.IDENTITY
        """Pose of the first one of them, shape (3,)."""
        self._cabin = Cabin()
        self._gap_s = 0.0
        """Time before the first of them in which nothing shows the motion."""
        self._fixes: deque[GnssFix] = deque(maxlen=MOST_FIXES)
        """Fixes of satellite navigation that wait for the next scan."""
        self._fixed = -1
        """The newest keyscan of the present session with a fix."""
        self._wheels = WheelCheck()
        self._begin()

    @property
    def scan_poses(self) -> ScanTrack:
        """Poses of the scans of the present session."""
        return self.tracks[-1]

    @property
    def travel_m(self) -> float:
        """Path length of the present session up to its newest keyscan, metres; turns count a little."""
        return self._lidar.travel_m

    @property
    def odometry_fault(self) -> str | None:
        """Why the odometry that there is is not used, as the end of a sentence; None if it is used."""
        return self._wheels.fault

    @property
    def backlog(self) -> int:
        """Number of inputs that the back end has not handled yet."""
        return len(self._waiting)

    @property
    def newest_output(self) -> "Future[list[Body]] | None":
        """Done when the back end has handled everything so far; None if it has."""
        return self._waiting[-1].output if self._waiting else None

    def process(self, record: SensorRecord) -> list[Packet]:
        """Process the next record of the recording; returns the packets that are ready."""
        match record:
            case LaserScan():
                if record.new_floor:
                    self.change_floor(record.new_floor)
                if is_clock_step(self._before_s, record.stamp):
                    self.begin_session()
                    self.prediction = MotionPrediction() if self.prediction else None
                self._before_s = self._before_s[1], record.stamp
                if self._repeated.admits(record):
                    self._process_scan(self._mark(self._mapped.of(self._with_motion(record))))
            case CameraImage() if self._config.uses_images:
                image = self.odometry.image(record) if self.prediction is None else replace(record, T_odom_base=None)
                if self._deferred:
                    self._deferred.append(image)
                else:
                    self._describe(image)
            case GnssFix():
                self._fixes.append(record)
        return self.ready()  # scans carry their odometry; images never leave the robot

    def ready(self, wait: bool = False) -> list[Packet]:
        """The next packets, without those that the back end still works on, or after it has handled everything."""
        packets = []
        while self._waiting and (wait or self._waiting[0].output.done()):
            done = self._waiting.popleft()
            for body in self._bodies(done):
                if isinstance(body, Hello):
                    self._hello = body
                packet = Packet(self.robot, done.epoch, self._sequence, done.time, body)
                packets.append(packet.on_floor(self.tracks[done.epoch].floor))
                self._sequence += 1
            if isinstance(done.input, SessionEnd):
                self._sequence, self._hello = 0, None
        return packets

    def set_detector(self, file: DetectorFile, path: Path) -> "Future[list[Body]]":
        """Use another network for camera images from now on; it describes buffered images again.

        Args:
            file: the detector as the cloud announced it.
            path: the downloaded file.

        Returns:
            Done when the back end uses it, or refuses it with the ``FeatureError`` of ``RobotBackend.process``.
        """
        return self._submit(NewDetector(file, path))

    @property
    def odometry_model(self) -> OdometryModel:
        """Error of the odometry, or of the prediction in its place."""
        return WHEELS if self.prediction is None else PREDICTED

    def place_keyframes(self) -> None:
        """Have the back end write where the keyframes are, if it keeps them."""
        self._submit(PlaceKeyframes())

    def change_floor(self, floor: str) -> None:
        """Go on in a new session on another floor, 1 to 16 letters, digits and ``. _ + -``; empty: without a name."""
        if floor != self.scan_poses.floor:
            if len(self.scan_poses):
                self.begin_session()
            self.scan_poses.floor, self.scan_poses.is_new_floor = floor, True

    def begin_session(self) -> None:
        """End the present session and begin another: the next scan is of another place, as after a ride in a lift."""
        self._end_deferral()
        if self.newest is None:
            self._lidar = LidarFrontend(self.robot, self._config.lidar, self.odometry_model)
        else:
            self._end_session()
        self._previous = None

    def finish(self) -> list[Packet]:
        """End the recording; returns all packets that are left."""
        self._end_deferral()
        self._submit(SessionEnd())
        return self.ready(wait=True)

    def _with_motion(self, scan: LaserScan) -> LaserScan:
        """The scan with its odometry free of jumps, or with a prediction if the scan has no odometry."""
        if self.prediction is None and self._wheels.say_nothing(scan):
            self.prediction = MotionPrediction()
            self._begin_without_odometry(self.prediction)
        duration_s = self._config.lidar.scan_duration_s
        if scan.sweep is None and duration_s > 0.0:
            scan = replace(scan, sweep=Sweep(0.0, duration_s))
            if self.prediction is None and self._previous is not None:
                scan = _moving_on(scan, self._previous)
        return self.odometry.scan(scan) if self.prediction is None else self.prediction.predict(scan)

    def _begin_without_odometry(self, prediction: MotionPrediction) -> None:
        """Begin a session whose motion is predicted, with the scans at which the odometry was frozen."""
        held: list[LaserScan | CameraImage] = []
        if self._wheels.may_be_frozen:
            self.scan_poses.cut(self._wheels.certain_s)
            held, self._deferred = self._deferred, []
        self.begin_session()
        for record in held:
            if isinstance(record, LaserScan):
                self._process_scan(prediction.predict(record))
            else:
                self._describe(replace(record, T_odom_base=None))

    def _observe(self, scan: LaserScan) -> None:
        """Predict the next scan from where this one was found."""
        newest = self.newest
        if self.prediction is None or newest is None:
            return
        T_smooth_base = self.scan_poses.in_odom(newest.pose) if newest.tracked.information.any() else None
        self.prediction.observe(scan.stamp, T_smooth_base, newest.tracked.sweep)

    def _process_scan(self, scan: LaserScan) -> None:
        """Process a scan and learn the robot's motion from it."""
        if self.prediction is not None and self.prediction.is_new and scan.sweep is not None:
            if not self._deferred:  # the second scan shows the motion during the first one
                self._deferred.append(scan)
                self._previous, self.newest = scan, _unmatched(scan)
                return
            first = self._place_first(scan)
            self._process_deferred()
            self.prediction.begin(first, se2.IDENTITY)
            scan = self.prediction.predict(scan)
        self._localize(scan)
        if not self._deferred:
            self._observe(scan)

    def _place_first(self, second: LaserScan) -> LaserScan:
        """The first deferred scan with the motion that the second one shows."""
        first = self._deferred[0]
        assert isinstance(first, LaserScan)  # images are deferred only behind a scan
        self._deferred[0] = first = replace(first, sweep=first_sweep(first, second, PREDICTED))
        return first

    def _localize(self, scan: LaserScan) -> None:
        before, self._previous = self._previous, scan
        if before is not None and has_moved_unseen(before, scan):
            self._end_deferral()
            self._end_session()
        elif before is not None and self.prediction is not None and self._is_unseen(before, scan):
            self._end_deferral()
            scan = self.prediction.predict(scan)  # the frame of the predictions may have moved
            self._gap_s = scan.stamp - before.stamp
        # 1. Localize the scan; unless it is doubtful, process it.
        predicted = scan
        if self._lidar.settled_m < SETTLED_M:
            self._cabin.leave()  # nothing is known from before its door closed
        else:
            self._cabin.add(scan)
        scan, tracking = self._matched(scan, self._lidar, self._in_odom(scan))
        may_be_frozen = self.prediction is None and self._wheels.may_be_frozen
        is_leaving = self._cabin.is_leaving
        if not (may_be_frozen or self._gap_s or is_doubtful(tracking, self._lidar, self._config.lost, is_leaving)):
            if self._deferred:
                self._process_deferred()
                tracking = self._lidar.localize(scan)
            self._map(scan, tracking)
            return
        # 2. Defer a doubtful scan until there are enough of them for a decision.
        if self.prediction is not None:
            scan = self._follow(self.prediction, predicted, tracking)
        self._deferred.append(scan)
        self.newest = _newest(self._lidar.scan_pose(scan.stamp, tracking.tracked), tracking, is_deferred=True)
        travel_m, most = GAP_TRAVEL_M if self._gap_s else DOUBTFUL_TRAVEL_M, MOST_SCANS
        if is_leaving:
            travel_m, most = LEAVING_M, LEAVING_SCANS
        if not may_be_frozen and can_decide(self._deferred_scans, travel_m, most):
            self._decide()

    @property
    def _deferred_scans(self) -> list[LaserScan]:
        return [record for record in self._deferred if isinstance(record, LaserScan)]

    def _is_unseen(self, before: LaserScan, scan: LaserScan) -> bool:
        """Whether nothing shows the motion between two scans without odometry: there is a gap."""
        is_gap = scan.stamp - before.stamp > LONGEST_S
        return is_gap and self._newest is not None and self._config.lost.doubted > 0.0

    def _decide(self) -> None:
        """Decide about the deferred scans.

        Another place: the robot is lost, and a new session begins with them. Same place: they are processed. If the
        robot drove on, its newest keyscans are wrong: another local map begins, tied to the past by odometry.
        """
        scans = self._deferred_scans
        if not self._gap_s and self._cabin.is_leaving:
            if rode(scans, self._lidar, self._cabin.closed_s):
                self._end_session()
                self.scan_poses.floor, self.scan_poses.is_new_floor = "", True
        elif not self._gap_s and is_lost(scans, self._lidar):
            is_whole = self.odometry.jumps == self._jumps
            if is_whole and drove_on(self._explained, scans, self._lidar):
                self._lidar.begin_local_map()
            else:
                self._end_session()
        elif self.prediction is not None:
            found = relocated(scans, self._lidar)
            if found is not None and is_in_reach(found, scans[0], self._lidar, self._gap_s):
                self._move_deferred(self.prediction, scans[0], found)
            elif (found is not None and not self._gap_s) or self._gap_s > SEEN_S or is_unplaced(scans[0], self._lidar):
                self._end_session()
        self._cabin.leave()
        self._process_deferred()

    def _end_deferral(self) -> None:
        """Process the deferred records before there are enough of them for a decision; decide after a gap."""
        if self._gap_s and len(self._deferred_scans) > 1:
            self._decide()
        else:
            self._process_deferred()

    def _move_deferred(self, prediction: MotionPrediction, first: LaserScan, T_local_first: FloatArray) -> None:
        """Predict the first deferred scan at a pose in the local frame, shape (3,), and the others after it."""
        T = se2.compose(self._lidar.T_odom_base(T_local_first), se2.inverse(first.T_odom_base))
        prediction.move(T)
        self._deferred = [
            replace(record, T_odom_base=frozen(se2.compose(T, record.T_odom_base)))
            if isinstance(record, LaserScan)
            else record
            for record in self._deferred
        ]

    def _matched(
        self, scan: LaserScan, frontend: LidarFrontend, in_smooth: Callable[[TrackedScan], FloatArray]
    ) -> tuple[LaserScan, TrackingResult]:
        """Localize a scan; without odometry, its sweep is placed and localized again by the motion that was found."""
        tracking = frontend.localize(scan)
        if self.prediction is None or not tracking.tracked.information.any():
            return scan, tracking
        moving = self.prediction.moving(scan, in_smooth(tracking.tracked))
        return (scan, tracking) if moving is scan else (moving, frontend.localize(moving))

    def _in_odom(self, scan: LaserScan) -> Callable[[TrackedScan], FloatArray]:
        """Where the scan is in the frame of its session, as it was localized."""
        return lambda tracked: self.scan_poses.in_odom(self._lidar.scan_pose(scan.stamp, tracked))

    def _follow(self, prediction: MotionPrediction, scan: LaserScan, tracking: TrackingResult) -> LaserScan:
        """A doubtful scan of a robot without odometry, with its motion.

        The first one is where the map has it. As they may show another place, the others are matched with each other.
        """
        if not self._deferred:
            self._beside, self._T_odom_beside = None, self._in_odom(scan)(tracking.tracked)
            return prediction.follow(scan, self._T_odom_beside, tracking.tracked.sweep)
        origin = self._T_odom_beside
        if self._beside is None:
            first = self._place_first(scan)
            self._beside = LidarFrontend(self.robot, self._config.lidar, PREDICTED)
            self._beside.process(first)
            prediction.begin(first, origin)
            scan = prediction.predict(scan)
        scan, beside = self._matched(scan, self._beside, lambda tracked: se2.compose(origin, tracked.T_local_base))
        tracked = beside.tracked
        scan = prediction.follow(scan, se2.compose(origin, tracked.T_local_base), tracked.sweep)
        self._beside.process(scan, beside._replace(T_odom_base=scan.T_odom_base))
        return scan

    def _end_session(self) -> None:
        """End a session and begin the next."""
        self._submit(SessionEnd())
        self._begin()

    def _begin(self) -> None:
        """Begin a session."""
        self._lidar = LidarFrontend(self.robot, self._config.lidar, self.odometry_model)
        self._newest, self._scans, self._explained, self._fixed = None, {}, {}, -1
        self._cabin.leave()
        self.tracks.append(ScanTrack(self.tracks[-1].floor) if self.tracks else ScanTrack(is_new_floor=True))

    def _process_deferred(self) -> None:
        """Process the deferred records normally."""
        records, self._deferred, self._gap_s = self._deferred, [], 0.0
        for record in records:
            if isinstance(record, LaserScan):
                self._map(record, self._lidar.localize(record))
            else:
                self._describe(record)

    def _map(self, scan: LaserScan, tracking: TrackingResult) -> None:
        """Continue from a localized scan."""
        self._time = max(self._time, scan.stamp)
        step = self._lidar.process(scan, tracking)
        keyscan = step.keyscan
        if keyscan is not None:
            if keyscan.odometry is not None:
                self.scan_poses.extend(keyscan.odometry.T_i_j)
            self._submit(NewKeyscan(keyscan, self._lidar.lasers))
        self.scan_poses.add(step.pose)
        self._send_fixes(step.pose)
        self.newest = _newest(step.pose, tracking, is_deferred=False)
        self._newest = scan, step.pose
        self._scans[scan.laser.T_base_laser] = scan
        if tracking.explained >= DOUBTFUL * tracking.known:  # false if it was not matched
            self._explained[scan.laser.T_base_laser] = scan
        self._jumps = self.odometry.jumps

    def _send_fixes(self, pose: ScanPose) -> None:
        """Send the fixes up to the newest scan, each with the keyscan of the scan next to it, one for each keyscan."""
        if not self._fixes:
            return
        poses = (pose,) if self._newest is None else (self._newest[1], pose)
        due = [fix for fix in self._fixes if fix.stamp <= pose.stamp]
        self._fixes = deque((fix for fix in self._fixes if fix.stamp > pose.stamp), maxlen=MOST_FIXES)
        for fix in due:
            nearest = min(poses, key=lambda pose: abs(pose.stamp - fix.stamp))
            if abs(nearest.stamp - fix.stamp) > LATE_S or nearest.keyscan <= self._fixed:
                continue
            self._fixed = nearest.keyscan
            x, y = se2.transform(nearest.T_keyscan_base, np.array([fix.antenna_xy]))[0].tolist()
            keyscan = KeyscanId(self.robot, nearest.keyscan)
            position = fix.latitude_deg, fix.longitude_deg, fix.altitude_m
            self._submit(KeyscanFix(keyscan, *position, fix.sigma_m, (x, y)))

    def _describe(self, image: CameraImage) -> None:
        if self._newest is not None:
            self._submit(NewImage(image, *self._newest, tuple(self._scans.values())))

    def _submit(self, input: BackendInput) -> "Future[list[Body]]":
        try:
            output = self._backend.submit(input)
        except BrokenExecutor as error:
            # An input that came while the executor broke may be lost (Python 3.11): nothing else completes its future.
            for waiting in self._waiting:
                waiting.output.cancel()
            output = Future()
            output.set_exception(error)
        self._waiting.append(_Waiting(input, output, len(self.tracks) - 1, self._time))
        return output

    def _bodies(self, done: _Waiting) -> list[Body]:
        """Return the records that the back end made of an input; once it has failed, those that the map needs in any
        case.
        """
        try:
            bodies = done.output.result()
        except FeatureError:  # ``set_detector`` reports it
            return []
        except Exception as error:  # tracking must go on, whatever ended the back end
            self.backend_failure = self.backend_failure or f"{type(error).__name__}: {error}"
        if self.backend_failure is None:
            return bodies
        if not isinstance(done.input, NewKeyscan):
            return []
        lasers, last = done.input.lasers, self._hello
        is_known = last is not None and last.lasers == lasers
        hello = Hello(self.robot, done.epoch, lasers, {}) if last is None else replace(last, lasers=lasers)
        return [*([] if is_known else [hello]), *essential(done.input, self._config.sends)]


def _moving_on(scan: LaserScan, before: LaserScan) -> LaserScan:
    """The scan with the velocity since the one before, by odometry, in its sweep."""
    elapsed_s = scan.stamp - before.stamp
    if scan.sweep is None or not 0.0 < elapsed_s <= LONGEST_S:
        return scan
    x, y, theta = (se2.log(se2.between(before.T_odom_base, scan.T_odom_base)) / elapsed_s).tolist()
    return replace(scan, sweep=scan.sweep._replace(velocity=(x, y, theta)))


def _unmatched(scan: LaserScan) -> NewestScan:
    """The first scan of a session before it is processed."""
    tracked = TrackedScan(np.zeros(3), np.zeros((3, 3)), None, scan.sweep)
    return NewestScan(ScanPose(scan.stamp, 0, se2.IDENTITY), tracked, math.nan, is_deferred=True)


def _newest(pose: ScanPose, tracking: TrackingResult, is_deferred: bool) -> NewestScan:
    quality = tracking.explained / tracking.known if tracking.known > 0.0 else math.nan
    return NewestScan(pose, tracking.tracked, quality, is_deferred)
