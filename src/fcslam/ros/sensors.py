"""Messages of a live robot in, sensor records out, as a bag would give them.

The first messages wait until the mounting of every laser is known; then they are read, so none is lost. A scan waits
for the odometry at its stamp. If that does not come, it gets the nearest pose within 1 s, or it is left out. A robot
whose odometry is silent from the start is mapped without.
"""

from collections import Counter, deque
from collections.abc import Iterator
from math import inf

from fcslam.records import GnssFix, SensorRecord
from fcslam.ros.live_plan import LivePlan, LivePlanner, Notify, missing_mounting
from fcslam.ros.topics import SensorTopics
from fcslam.sources.bags.camera import ImageMessage, calibration_of, image_of
from fcslam.sources.bags.clouds import cloud_mounting, cloud_of, given_cloud_mounting
from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FIX,
    IMAGE,
    LASER_SCANS,
    ODOMETRY,
    TRANSFORMS,
    MessageCodec,
)
from fcslam.sources.bags.fixes import fix_of
from fcslam.sources.bags.messages import (
    OdometryReading,
    ScanMessage,
    odometry_in,
    odometry_of,
    scan_of,
    transforms_of,
)
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.pairing import MAX_GAP_S, Message, PosedImage, PosedScan
from fcslam.sources.bags.reader import Numbered, SensorReader
from fcslam.sources.bags.topics import info_beside
from fcslam.sources.bags.transforms import NoTransformError
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import MAX_STEP_BACK_S
from fcslam.sources.point_clouds import directions_in, scan_of_cloud

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
        self._directions: dict[str, int] = {}
        """Directions of the scans of clouds in a full turn, by topic; the first cloud decides."""
        self._frames: dict[str, str] = {}
        self._mixed: set[str] = set()
        """Topics with scans of other frames, of which there was a line."""
        self._plan: LivePlan | None = None
        """How the robot is read, once that is known."""
        self._reader: SensorReader | None = None
        self._early: deque[tuple[int, Message]] = deque(maxlen=_LONGEST_WAIT)
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
                self._early.append((self._counts[topic], item))
        yield from self.wait(now_s)

    def wait(self, now_s: float) -> Iterator[SensorRecord]:
        """Yield what need not wait any longer at the time ``now_s``, if there is no message."""
        if self._reader is None:
            self._plan = self.planner.plan(now_s)
            if self._plan is None:
                return
            self._reader = self._new_reader(self._plan)
            while self._early:
                yield from self._read(self._reader, *self._early.popleft())
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

    def _new_reader(self, plan: LivePlan) -> SensorReader:
        return SensorReader(plan.lasers, not self.planner.is_without_odometry, self.audit)

    def _is_needless(self, kind: str, now_s: float) -> bool:
        """Whether a message need not be decoded, which would cost more time than all scans."""
        if kind == IMAGE:
            if now_s < self._next_image_s:
                return True
            self._next_image_s = now_s + RAW_IMAGE_PERIOD_S
        # Once the mountings are known, tf has nothing but the odometry.
        return self._plan is not None and self._topics.odometry is not None and kind == TRANSFORMS

    def _fix(self, topic: str, payload: bytes, received_ns: int) -> Iterator[GnssFix]:
        if self._plan is None:
            return
        try:
            fix = fix_of(self._codec.decode(payload, FIX), received_ns, self.planner.tree, self.planner.base_frame)
        except ValueError:
            fix = Fault.BROKEN_MESSAGE
        if isinstance(fix, Fault):
            self.audit.add(fix, self._counts[topic])
        else:
            yield fix

    def _decoded(self, topic: str, payload: bytes, received_ns: int) -> list[Message]:
        kind = self._topics.kinds[topic]
        content = self._codec.decode(payload, kind)
        if topic in self._topics.scans:
            return self._scan_items(topic, content, received_ns)
        if kind == ODOMETRY:
            reading = odometry_of(content, received_ns)
            self.planner.add_reading(reading)
            return [reading]
        if kind in (COMPRESSED_IMAGE, IMAGE):
            return [image_of(content, kind, received_ns)]
        if kind == CAMERA_INFO:
            self.planner.calibrations.setdefault(topic, calibration_of(content))
            return []
        return self._transforms(content, received_ns)

    def _scan_items(self, topic: str, content: object, received_ns: int) -> list[Message]:
        laser = self._topics.scans.index(topic)
        scan = self._scan(topic, content, received_ns)
        if scan is None:
            return []
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
        if self._plan is None:
            self.planner.add_scan(scan)
        return [scan]

    def _scan(self, topic: str, content: object, received_ns: int) -> ScanMessage | None:
        """The scan in a message; None while what it needs is awaited. Raises ValueError if the message is invalid."""
        kind, info = self._topics.kinds[topic], info_beside(topic)
        if kind in LASER_SCANS:
            return scan_of(content, received_ns)
        if kind == IMAGE and info not in self.planner.calibrations:
            self.planner.awaited[topic] = f"waits for the calibration of {topic}: {info} is silent; publish it"
            return None
        cloud = cloud_of(content, kind, received_ns, self.planner.calibrations.get(info))
        if self._options.laser_poses:
            pose = self._options.laser_poses[self._topics.scans.index(topic)]
            mounting = given_cloud_mounting(pose, kind, cloud.frame)
        else:
            try:
                T_base_sensor = self.planner.tree.fixed(self.planner.known_base_frame, cloud.frame)
                mounting = cloud_mounting(T_base_sensor, kind, cloud.frame)
            except NoTransformError as error:
                self.planner.awaited[topic] = missing_mounting(error)
                return None
        if topic not in self._directions:
            self._directions[topic] = directions_in([cloud], mounting)
        return scan_of_cloud(cloud, mounting._replace(directions=self._directions[topic]), self._options.cloud_band)

    def _transforms(self, content: object, received_ns: int) -> list[Message]:
        transforms = list(transforms_of(content, received_ns))
        if self._plan is None:
            self.planner.add_transforms(transforms)
        if self._topics.odometry is not None or self.planner.is_without_odometry:
            return []
        return [odometry_in(each) for each in transforms]

    def _read(self, reader: SensorReader, number: int, item: Message) -> Iterator[SensorRecord]:
        plan = self._plan
        assert plan is not None  # nothing is read before
        if isinstance(item, OdometryReading) and plan.edge not in (None, (item.odom_frame, item.base_frame)):
            return
        if isinstance(item, ScanMessage):
            if self._has_stepped_back(item.stamp):
                reader = self._reader = self._new_reader(plan)
            self._plan = plan._replace(rig=plan.rig.widened(item))
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

    def _recorded(self, entries: Iterator[Numbered]) -> Iterator[SensorRecord]:
        for number, entry in entries:
            self._odometry_patience.forget()
            plan = self._plan
            assert plan is not None  # nothing is read before
            if isinstance(entry, PosedScan):
                yield plan.rig.scan(entry)
            elif isinstance(entry, PosedImage) and plan.rig.camera is not None:
                try:
                    yield plan.rig.image(entry)
                except ValueError:
                    self.audit.add(Fault.BROKEN_IMAGE, number)
        if self.audit.faults()[Fault.NO_ODOMETRY].count:
            self._notify("a scan has no odometry within 1 s and is left out; is the driver of the base alive?")
