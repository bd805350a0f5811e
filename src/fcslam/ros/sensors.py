"""Messages of a live robot in, sensor records out, as a bag would give them.

The first messages wait until the mounting of every laser is known; then they are read, so none is lost. A scan waits
for the odometry at its stamp. If that does not come, it gets the nearest pose within 1 s, or it is left out. A robot
whose odometry is silent from the start is mapped without.
"""

from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Sequence
from math import inf
from typing import Any, NamedTuple

from fcslam.records import CloudScan, GnssFix, SensorRecord
from fcslam.ros.live_plan import LivePlan, LivePlanner, Notify, missing_mounting
from fcslam.ros.topics import SensorTopics
from fcslam.sources.bags.camera import ImageMessage, calibration_of, image_of
from fcslam.sources.bags.clocks import FEWEST_LAGS, StampClock, ahead_note, clock_ahead_s, restamped
from fcslam.sources.bags.clouds import (
    cloud_mounting,
    cloud_of,
    given_cloud_mounting,
    lacks_optical_frame,
    longest_cloud_s,
    notes_on_times,
    optical_note,
)
from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FIX,
    IMAGE,
    IMU,
    LASER_SCANS,
    NANOSECONDS,
    ODOMETRY,
    TRANSFORMS,
    MessageCodec,
)
from fcslam.sources.bags.fixes import FixReader
from fcslam.sources.bags.imu import ImuAxes, ImuReading, imu_of
from fcslam.sources.bags.messages import (
    OdometryReading,
    ScanMessage,
    header_of,
    odometry_in,
    odometry_of,
    scan_of,
    stamp_ns_of,
    transforms_of,
)
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.pairing import MAX_GAP_S, Message, PosedImage, PosedScan
from fcslam.sources.bags.reader import CloudStream, Numbered, SensorReader
from fcslam.sources.bags.topics import info_beside
from fcslam.sources.bags.transforms import NoTransformError
from fcslam.sources.clouds_in_space import CloudReader, reader_of
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import FIRST_MESSAGES, MAX_STEP_BACK_S
from fcslam.sources.point_clouds import CloudMounting, PointCloud, directions_in, scan_of_cloud, unit_problem

ODOMETRY_PATIENCE_S = MAX_GAP_S
"""Time that a scan waits for its odometry."""
MERGING_PATIENCE_S = 0.3
"""Time that scans of one laser wait for those of another, so a laser that stops does not delay the pose."""
RAW_IMAGE_PERIOD_S = 0.4
"""Least time between two raw images that are read; places are a metre apart, and an image takes 10 ms to encode."""
STEPS_BACK_FOR_RESTART = 3
"""Number of scans in a row that are far back in time until the clock is taken to have stepped back."""
_LONGEST_WAIT = 10_000
"""Most first messages that wait for the mounting."""


_MOST_CLOUDS = 100
"""Most first clouds that wait; they are large."""
Item = Message | ImuReading | PointCloud


class _Early(NamedTuple):
    """One of the first messages, or what it holds."""

    topic: str
    number: int
    received_ns: int
    item: Any


class _Patience:
    def __init__(self, longest_s: float) -> None:
        self._longest_s = longest_s
        self._since_s: float | None = None

    def forget(self) -> None:
        """What was awaited came."""
        self._since_s = None

    def is_over(self, is_waiting: bool, now_s: float) -> bool:
        """Whether the wait goes on for too long; then it begins again."""
        if not is_waiting or self._since_s is None:
            self._since_s = now_s if is_waiting else None
            return False
        if now_s <= self._since_s + self._longest_s:
            return False
        self._since_s = None
        return True


class LiveSensors:
    """Reads the messages of one robot, one at a time."""

    def __init__(self, topics: SensorTopics, namespace: str, options: BagOptions, notify: Notify) -> None:
        """``namespace`` is "" or begins with a slash."""
        self.audit = Audit("message")
        self.planner = LivePlanner(topics, namespace, options, notify)
        """What is known of the robot."""
        self.restarts = 0
        self._newest_stamp: float | None = None
        self._topics, self._options, self._notify = topics, options, notify
        self._codec = MessageCodec(ros1=False)
        self._clocks: defaultdict[str, StampClock] = defaultdict(StampClock)
        """By topic."""
        self._scan_lags_s: list[float] = []
        """Times from measuring to receiving of the first scans of the first laser."""
        self._odometry_ahead_s = self._imu_ahead_s = 0.0
        """How far these clocks are ahead of that of the scans."""
        self._cloud_stamps: dict[str, float] = {}
        """Stamp of the newest cloud, by topic, and the least time between two of them."""
        self._intervals_s: dict[str, float] = {}
        self._directions: dict[str, int] = {}
        """Directions of the scans of clouds in a full turn, by topic; the first cloud decides."""
        self._frames: dict[str, str] = {}
        self._mixed: set[str] = set()
        """Topics with scans of other frames, of which there was a line."""
        self._plan: LivePlan | None = None
        """How the robot is read, once that is known."""
        self._reader: SensorReader | CloudStream | None = None
        self._cloud_mounting: CloudMounting | None = None
        self._cloud_reader: CloudReader | None = None
        """Of a robot with a 3D LiDAR, once the plan is known."""
        self._early: deque[_Early] = deque(maxlen=_LONGEST_WAIT)
        self._axes: ImuAxes | None = None
        self._fixes: FixReader | None = None
        self._early_fixes: deque[_Early] = deque(maxlen=_LONGEST_WAIT)
        self._counts: Counter[str] = Counter()
        self._misplaced = 0
        self._next_image_s = -inf
        self._odometry_patience = _Patience(ODOMETRY_PATIENCE_S)
        self._laser_patience = _Patience(MERGING_PATIENCE_S)

    def add(self, topic: str, payload: bytes, now_s: float, received_ns: int) -> Iterator[SensorRecord]:
        """Read the next message; yields the records that are complete at ``now_s`` of a clock that only grows.

        ``received_ns`` is the time of a message without a stamp.
        """
        self._counts[topic] += 1
        if topic == self._topics.fixes:
            yield from self._fix(topic, payload, received_ns)
            return
        if topic not in self._topics.scans and self._is_needless(self._topics.kinds[topic], now_s):
            return
        try:
            items = self._decoded(topic, payload, received_ns)
        except ValueError as error:
            broken = Fault.BROKEN_IMAGE if topic == self._topics.camera else Fault.BROKEN_MESSAGE
            if not self.audit.faults()[broken].count:
                self._notify(f"{topic}: {broken} ({error}); correct the driver")
            self.audit.add(broken, self._counts[topic])
            return
        for item in items:
            if self._reader is not None:
                yield from self._read(self._reader, self._counts[topic], item)
            elif not isinstance(item, ImageMessage):  # images are large, and the first ones show little
                self._keep(_Early(topic, self._counts[topic], received_ns, item))
        yield from self.wait(now_s)

    def wait(self, now_s: float) -> Iterator[SensorRecord]:
        """Yield what need not wait any longer at the time ``now_s``, if there is no message."""
        if self._reader is None:
            self._plan = self.planner.plan(now_s)
            if self._plan is None:
                return
            self._reader = self._new_reader(self._plan)
            self._decide_clocks(self._plan)
            while self._early:
                topic, number, received_ns, item = self._early.popleft()
                item = restamped(item, received_ns, self._clocks[topic].lag_ns)
                yield from self._read(self._reader, number, item)
        reader = self._reader
        silent = reader.silent_lasers
        if self._laser_patience.is_over(bool(silent), now_s):
            for laser in silent:
                self._notify(f"{self._topics.scans[laser]} is silent; the robot goes on with its other lasers")
            yield from self._recorded(reader.skip_lasers())
        if self._odometry_patience.is_over(reader.waits_for_odometry, now_s):
            yield from self._recorded(reader.skip_odometry())

    def finish(self) -> Iterator[SensorRecord]:
        """Yield all that waits, as no more messages come."""
        if self._reader is not None:
            yield from self._recorded(self._reader.finish())

    def _keep(self, early: _Early) -> None:
        self._early.append(early)
        clouds = [each for each in self._early if isinstance(each.item, PointCloud)]
        if len(clouds) > _MOST_CLOUDS:
            self._early.remove(clouds[0])

    def _new_reader(self, plan: LivePlan) -> SensorReader | CloudStream:
        if self._topics.in_space:
            if self._cloud_reader is None:
                first = [early.item for early in self._early if isinstance(early.item, PointCloud)]
                assert self._cloud_mounting is not None  # each cloud has one before there is a plan
                band, topic = self._options.cloud_band, self._topics.scans[0]
                self._cloud_reader, notes = reader_of(first[:FIRST_MESSAGES], self._cloud_mounting, band, topic)
                for note in notes:
                    self._notify(note)
            return CloudStream(self._cloud_reader, self.audit)
        return SensorReader(plan.lasers, not self.planner.is_without_odometry, self.audit)

    def _is_needless(self, kind: str, now_s: float) -> bool:
        """Whether a message need not be decoded, which would cost more time than all scans."""
        if kind == IMAGE:
            if now_s < self._next_image_s:
                return True
            self._next_image_s = now_s + RAW_IMAGE_PERIOD_S
        # Once the mountings are known, tf has nothing but the odometry. With odometry, only a 3D LiDAR needs the gyro.
        is_needed = kind != TRANSFORMS or self._topics.odometry is None
        is_turned = self.planner.is_without_odometry or self._topics.in_space
        return self._plan is not None and not (is_needed and (kind != IMU or is_turned))

    def _decide_clocks(self, plan: LivePlan) -> None:
        """Compare the clocks of the odometry and the IMU with that of the scans, by the first messages."""
        duration_s = plan.lasers[0].first.duration_s
        self._scan_lags_s = [lag_s - duration_s for lag_s in self._clocks[self._topics.scans[0]].lags_s]
        found = (
            (each, restamped(each.item, each.received_ns, self._clocks[each.topic].lag_ns)) for each in self._early
        )
        odometry_s = [each.received_ns / NANOSECONDS - item.stamp for each, item in found if plan.is_odometry(item)]
        self._odometry_ahead_s = self._ahead_s(self._topics.odometry or "the odometry in tf", odometry_s)
        self._imu_ahead_s = self._ahead_s(self._topics.imu or "", self._clocks[self._topics.imu or ""].lags_s)

    def _ahead_s(self, name: str, lags_s: Sequence[float]) -> float:
        ahead_s = clock_ahead_s(self._scan_lags_s, lags_s)
        if ahead_s:
            self._notify(ahead_note(name, ahead_s))
        return ahead_s

    def _fix(self, topic: str, payload: bytes, received_ns: int) -> Iterator[GnssFix]:
        """The fixes; they wait for the mountings, and until a few of them show their clock."""
        number, clock = self._counts[topic], self._clocks[topic]
        try:
            content = self._codec.decode(payload, FIX)
        except ValueError:
            self.audit.add(Fault.BROKEN_MESSAGE, number)
            return
        clock.note(content.header, received_ns)
        self._early_fixes.append(_Early(topic, number, received_ns, content))
        if self._plan is None or (self._fixes is None and len(self._early_fixes) < FEWEST_LAGS):
            return
        if self._fixes is None:
            ahead_s = self._ahead_s(topic, clock.lags_s)
            self._fixes = FixReader(self.planner.tree, self.planner.base_frame, ahead_s, self.audit)
        while self._early_fixes:
            _, number, came_ns, content = self._early_fixes.popleft()
            yield from self._fixes.read(number, content, came_ns - clock.lag_ns)

    def _decoded(self, topic: str, payload: bytes, received_ns: int) -> list[Item]:
        kind = self._topics.kinds[topic]
        content = self._codec.decode(payload, kind)
        clock = self._clocks[topic]
        for each in content.transforms if kind == TRANSFORMS else (content,):
            clock.note(each.header, received_ns)
        if clock.unstamped and kind != TRANSFORMS:
            self._notify(f"{topic} has messages without a stamp; the times at which they arrive count")
        received_ns -= clock.lag_ns
        if topic in self._topics.scans:
            return self._scan_items(topic, content, received_ns)
        if kind == ODOMETRY:
            reading = odometry_of(content, received_ns)
            self.planner.add_reading(reading)
            return [reading]
        if kind == IMU:
            return [imu_of(content, received_ns)]
        if kind in (COMPRESSED_IMAGE, IMAGE):
            return [image_of(content, kind, received_ns)]
        if kind == CAMERA_INFO:
            self.planner.calibrations.setdefault(topic, calibration_of(content))
            return []
        return self._transforms(content, received_ns)

    def _scan_items(self, topic: str, content: Any, received_ns: int) -> list[Item]:
        laser = self._topics.scans.index(topic)
        scan = self._scan(topic, content, received_ns)
        if scan is None:
            return []
        if isinstance(scan, ScanMessage):
            scan = scan._replace(laser=laser)
        if scan.frame != self._frames.setdefault(topic, scan.frame):
            if topic not in self._mixed:
                self._mixed.add(topic)
                self._notify(
                    f"{topic} has scans of the frames '{self._frames[topic]}' and '{scan.frame}', the last are left "
                    "out; publish the scans of each laser on a topic of its own"
                )
            self.audit.add(Fault.OTHER_BEAMS, self._counts[topic])
            return []
        if self._plan is None and isinstance(scan, ScanMessage):
            self.planner.add_scan(scan, is_stamped=stamp_ns_of(content.header) > 0)
        return [scan]

    def _scan(self, topic: str, content: Any, received_ns: int) -> ScanMessage | PointCloud | None:
        """The scan in a message, or the cloud if that is read whole; None while what it needs is awaited.

        Raises ValueError if the message is invalid.
        """
        kind, info = self._topics.kinds[topic], info_beside(topic)
        if kind in LASER_SCANS:
            return scan_of(content, received_ns)
        if kind == IMAGE and info not in self.planner.calibrations:
            self.planner.awaited[topic] = f"waits for the calibration of {topic}: {info} is silent; publish it"
            return None
        longest_s = self._longest_cloud_s(topic, *header_of(content.header, received_ns))
        if longest_s is None:
            return None
        cloud = cloud_of(content, kind, received_ns, self.planner.calibrations.get(info), longest_s)
        if self._topics.in_space and self._plan is not None:
            return cloud
        return self._first_cloud(topic, cloud, is_stamped=stamp_ns_of(content.header) > 0)

    def _first_cloud(self, topic: str, cloud: PointCloud, is_stamped: bool) -> ScanMessage | PointCloud | None:
        """The scan of a cloud; of one that is read whole, it shows the planner where the LiDAR is."""
        kind, mounting = self._topics.kinds[topic], self._mounting(topic, cloud.frame)
        if mounting is None:
            return None
        if topic not in self._directions:
            for note in filter(None, (*notes_on_times(topic, kind, [cloud]), unit_problem([cloud]))):
                self._notify(note)
            self._directions[topic] = directions_in([cloud], mounting)
        scan = scan_of_cloud(cloud, mounting._replace(directions=self._directions[topic]), self._options.cloud_band)
        if not self._topics.in_space:
            return scan
        self._cloud_mounting = mounting
        self.planner.add_scan(scan, is_stamped)
        return cloud

    def _mounting(self, topic: str, frame: str) -> CloudMounting | None:
        """Where the sensor of a topic of clouds sits; None while tf does not say."""
        kind = self._topics.kinds[topic]
        if self._options.laser_poses:
            return given_cloud_mounting(self._options.laser_poses[self._topics.scans.index(topic)], kind, frame)
        try:
            T_base_sensor = self.planner.tree.fixed(self.planner.known_base_frame, frame)
        except NoTransformError as error:
            self.planner.awaited[topic] = missing_mounting(error)
            return None
        if lacks_optical_frame(T_base_sensor, kind, frame):
            self._notify(optical_note(topic, frame))
        return cloud_mounting(T_base_sensor, kind, frame)

    def _longest_cloud_s(self, topic: str, stamp: float, frame: str) -> float | None:
        """The longest time that a cloud takes, by the least time between two of them; None for the first."""
        if frame == self._frames.get(topic, frame):
            elapsed_s = stamp - self._cloud_stamps.get(topic, stamp)
            self._cloud_stamps[topic] = stamp
            if elapsed_s > 0.0:
                self._intervals_s[topic] = min(elapsed_s, self._intervals_s.get(topic, inf))
        return longest_cloud_s(self._intervals_s[topic]) if topic in self._intervals_s else None

    def _transforms(self, content: Any, received_ns: int) -> list[Item]:
        transforms = list(transforms_of(content, received_ns))
        if self._plan is None:
            self.planner.add_transforms(transforms)
        if self._topics.odometry is not None or self.planner.is_without_odometry:
            return []
        return [odometry_in(each) for each in transforms]

    def _read(self, reader: SensorReader | CloudStream, number: int, item: Item) -> Iterator[SensorRecord]:
        plan = self._plan
        assert plan is not None  # nothing is read before
        if isinstance(item, ImuReading):
            self._axes = self._axes or ImuAxes(self.planner.tree, self.planner.base_frame)
            yield from self._recorded(reader.add_imu(self._axes.row(item, self._imu_ahead_s)))
            return
        if isinstance(item, OdometryReading):
            if self.planner.is_without_odometry or not plan.is_odometry(item):
                return
            item = item._replace(stamp=item.stamp - self._odometry_ahead_s)
        if isinstance(item, ScanMessage | PointCloud) and self._has_stepped_back(item.stamp):
            reader = self._reader = self._new_reader(plan)
        if isinstance(item, ScanMessage):
            self._plan = plan._replace(rig=plan.rig.widened(item))
        if isinstance(reader, CloudStream):
            if isinstance(item, PointCloud | OdometryReading):
                yield from self._recorded(reader.add(number, item))
        elif not isinstance(item, PointCloud):
            yield from self._recorded(reader.add(number, item))

    def _has_stepped_back(self, stamp: float) -> bool:
        newest = self._newest_stamp
        if newest is None or stamp >= newest - MAX_STEP_BACK_S:
            self._misplaced = 0
            self._newest_stamp = stamp if newest is None else max(newest, stamp)
            return False
        self._misplaced += 1
        if self._misplaced < STEPS_BACK_FOR_RESTART:
            return False
        if not self.restarts:
            self._notify(
                f"the clock of the scans stepped back by {newest - stamp:.1f} s, as when a bag is played again; "
                "the robot goes on from there"
            )
        self.restarts += 1
        self._misplaced, self._newest_stamp = 0, stamp
        return True

    def _recorded(self, entries: Iterator[Numbered] | Iterator[tuple[int, CloudScan]]) -> Iterator[SensorRecord]:
        for number, entry in entries:
            self._odometry_patience.forget()
            plan = self._plan
            assert plan is not None  # nothing is read before
            if isinstance(entry, CloudScan):
                yield entry
            elif isinstance(entry, PosedScan):
                yield plan.rig.scan(entry)
            elif isinstance(entry, PosedImage) and plan.rig.camera is not None:
                try:
                    yield plan.rig.image(entry)
                except ValueError:
                    self.audit.add(Fault.BROKEN_IMAGE, number)
        if self.audit.faults()[Fault.NO_ODOMETRY].count:
            self._notify("a scan has no odometry within 1 s and is left out; is the driver of the base alive?")
