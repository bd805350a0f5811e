"""Messages of a live robot in, sensor records out, as a bag would give them.

The first messages wait until the mounting of every laser is known; then they are read, so none is lost. A scan waits
for the odometry at its stamp. If that does not come, it gets the nearest pose within 1 s, or it is left out. A robot
whose odometry is silent from the start is mapped without.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import inf

from fcslam.errors import NetworkError
from fcslam.records import GnssFix, SensorRecord
from fcslam.ros.topics import SensorTopics
from fcslam.sources.bags.camera import Calibration, ImageMessage, calibration_of, image_of
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
    UNKNOWN_RANGE_M,
    BeamsError,
    OdometryReading,
    ScanMessage,
    odometry_in,
    odometry_of,
    scan_of,
    transforms_of,
)
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.pairing import Message, PosedImage, PosedScan
from fcslam.sources.bags.reader import Numbered, ReadLaser, SensorReader
from fcslam.sources.bags.rig import (
    MountedSensor,
    MountingError,
    Rig,
    mounted_camera,
    mountings_of,
    rig_of,
    tilt_note,
    usual_scan,
)
from fcslam.sources.bags.sectors import are_sectors, joined_turns
from fcslam.sources.bags.topics import info_beside
from fcslam.sources.bags.transforms import USUAL_BASES, Link, Mounting, NoTransformError, TransformTree
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import MAX_STEP_BACK_S
from fcslam.sources.path_summary import WITHOUT_ODOMETRY
from fcslam.sources.point_clouds import directions_in

USUAL_ODOM = "odom"
"""Frame of an odometry that names none."""
SCANS_FOR_RIG = 5
"""Number of first scans of each laser that decide which beams it has."""
PATIENCE_S = 5.0
"""Time after which a live robot says that the odometry, a laser or a mounting is missing, and waits no longer for a
calibration."""
ODOMETRY_PATIENCE_S = 1.0
"""Time that a scan waits for its odometry."""
MERGING_PATIENCE_S = 0.3
"""Time that scans of one laser wait for those of another, so a laser that stops does not delay the pose."""
RAW_IMAGE_PERIOD_S = 0.4
"""Least time between two raw images that are read; places are a metre apart, and an image takes 10 ms to encode."""
STEPS_BACK_FOR_RESTART = 3
"""Number of scans in a row that are far back in time until the clock is taken to have stepped back."""
_SCANS_KEPT = 100
"""Most first scans of a laser that decide."""
_LONGEST_WAIT = 10_000
"""Most first messages that wait for the mounting."""
_IMAGES_KEPT = 200
"""Most images among them: they are large, and the first ones show little."""

Notify = Callable[[str], None]
"""Takes one line for the user; what repeats a line is not said again."""


class _Patience:
    """Says when something is awaited for too long."""

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
        """Faults so far."""
        self.odom_frame, self.base_frame = USUAL_ODOM, ""
        """Frames of the odometry, once it is there; a driver may leave them out."""
        self.is_without_odometry = options.odom_topic == NO_ODOMETRY
        """Whether the robot is mapped without odometry."""
        self.restarts = 0
        """Number of times that the clock stepped back."""
        self._newest_stamp: float | None = None
        """Stamp of the newest scan that was read."""
        self._topics, self._options, self._notify = topics, options, notify
        self._prefix = namespace.strip("/")
        self._codec = MessageCodec(ros1=False)
        self._tree = TransformTree()
        self._has_odometry = self._is_camera_ahead = False
        self._edge: Link | None = None
        """Frames of the odometry in tf, once the laser's are known."""
        self._calibrations: dict[str, Calibration] = {}
        """By the topic of camera_info."""
        self._directions: dict[str, int] = {}
        """Directions of the scans of clouds in a full turn, by topic; the first cloud decides."""
        self._first: list[deque[ScanMessage]] = [deque(maxlen=_SCANS_KEPT) for _ in topics.scans]
        self._frames: dict[str, str] = {}
        """Coordinate frame of the scans on each topic."""
        self._awaited: dict[str, str] = {}
        """Topics whose messages cannot be scans before tf and a calibration are known, and a line that says it."""
        self._lasers: list[ReadLaser] = []
        """How each laser is read, once that is known."""
        self._rig: Rig | None = None
        self._reader: SensorReader | None = None
        """Reads the messages once the rig is known."""
        self._early: deque[tuple[int, Message]] = deque(maxlen=_LONGEST_WAIT)
        self._counts: Counter[str] = Counter()
        self._began: float | None = None
        self._misplaced = 0
        self._next_image_s = -inf
        self._odometry_patience = _Patience(ODOMETRY_PATIENCE_S)
        self._laser_patience = _Patience(MERGING_PATIENCE_S)

    def add(self, topic: str, payload: bytes, now_s: float, received_ns: int) -> Iterator[SensorRecord]:
        """Read the next message; yields the records that are complete at ``now_s`` of a clock that only grows.

        ``received_ns`` is the time of a message without a stamp.

        Raises:
            NetworkError: the robot cannot be mapped: its lasers are not level, or tf cannot tell two apart.
        """
        self._counts[topic] += 1
        if topic == self._topics.fixes:
            yield from self._fix(topic, payload, received_ns)
            return
        if topic not in self._topics.scans and self._is_needless(self._topics.kinds[topic], now_s):
            return
        try:
            items = self._decoded(topic, payload, received_ns)
        except BeamsError as error:
            if not self.audit.faults()[Fault.BAD_BEAMS].count:
                self._notify(f"scans of {topic} are left out: {error}; correct the driver")
            self.audit.add(Fault.BAD_BEAMS, self._counts[topic])
            return
        except ValueError:
            broken = Fault.BROKEN_IMAGE if topic == self._topics.camera else Fault.BROKEN_MESSAGE
            if not self.audit.faults()[broken].count:
                self._notify(f"{topic}: {broken}")
            self.audit.add(broken, self._counts[topic])
            return
        for item in items:
            if self._reader is None:
                self._keep_early(self._counts[topic], item)
            else:
                yield from self._read(self._reader, self._counts[topic], item)
        yield from self.wait(now_s)

    def wait(self, now_s: float) -> Iterator[SensorRecord]:
        """Yield what need not wait any longer at the time ``now_s``, if there is no message."""
        self._began = now_s if self._began is None else self._began
        if self._reader is None:
            self._rig = self._rig_now(now_s)
            if self._rig is None:
                return
            self._reader = self._new_reader()
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

    def _new_reader(self) -> SensorReader:
        return SensorReader(self._lasers, not self.is_without_odometry, self.audit)

    def _is_needless(self, kind: str, now_s: float) -> bool:
        """Whether a message need not be decoded, which would cost more time than all scans."""
        if kind == IMAGE:
            if now_s < self._next_image_s:
                return True
            self._next_image_s = now_s + RAW_IMAGE_PERIOD_S
        # Once the mountings are known, tf has nothing but the odometry.
        return self._rig is not None and self._topics.odometry is not None and kind == TRANSFORMS

    def _fix(self, topic: str, payload: bytes, received_ns: int) -> Iterator[GnssFix]:
        """The fix in a message, once the mounting is known."""
        if self._rig is None:
            return
        try:
            fix = fix_of(self._codec.decode(payload, FIX), received_ns, self._tree, self.base_frame)
        except ValueError:
            fix = Fault.BROKEN_MESSAGE
        if isinstance(fix, Fault):
            self.audit.add(fix, self._counts[topic])
        elif fix is not None:
            yield fix

    def _keep_early(self, number: int, item: Message) -> None:
        """Keep a message until the mounting is known; of images, the newest."""
        self._early.append((number, item))
        if isinstance(item, ImageMessage):
            images = [index for index, (_, each) in enumerate(self._early) if isinstance(each, ImageMessage)]
            if len(images) > _IMAGES_KEPT:
                del self._early[images[0]]

    def _decoded(self, topic: str, payload: bytes, received_ns: int) -> list[Message]:
        """Raises ValueError if the message is invalid."""
        kind = self._topics.kinds[topic]
        content = self._codec.decode(payload, kind)
        if topic in self._topics.scans:
            return self._scan_items(topic, content, received_ns)
        if kind == ODOMETRY:
            reading = odometry_of(content, received_ns)
            self.odom_frame = reading.odom_frame or USUAL_ODOM
            self.base_frame = self._options.base_frame or reading.base_frame
            self._has_odometry = True
            return [reading]
        if kind in (COMPRESSED_IMAGE, IMAGE):
            return [image_of(content, kind, received_ns)]
        if kind == CAMERA_INFO:
            self._calibrations.setdefault(topic, calibration_of(content))
            return []
        return self._transforms(content, received_ns)

    def _scan_items(self, topic: str, content: object, received_ns: int) -> list[Message]:
        laser = self._topics.scans.index(topic)
        scan = self._scan(topic, content, received_ns)
        if scan is None:
            return []
        scan = scan._replace(laser=laser)
        if scan.frame != self._frames.setdefault(topic, scan.frame):
            self._notify(
                f"{topic} has scans of the frames '{self._frames[topic]}' and '{scan.frame}', the last are left "
                "out; publish the scans of each laser on a topic of its own"
            )
            self.audit.add(Fault.OTHER_BEAMS, self._counts[topic])
            return []
        if self._rig is None:
            self._first[laser].append(scan)
        return [scan]

    def _scan(self, topic: str, content: object, received_ns: int) -> ScanMessage | None:
        """The scan in a message; None while what it needs is awaited. Raises ValueError if the message is invalid."""
        kind, info = self._topics.kinds[topic], info_beside(topic)
        if kind in LASER_SCANS:
            return scan_of(content, received_ns)
        if kind == IMAGE and info not in self._calibrations:
            self._awaited[topic] = f"waits for the calibration of {topic}: {info} is silent; publish it"
            return None
        cloud = cloud_of(content, kind, received_ns, self._calibrations.get(info))
        if self._options.laser_poses:
            mounting = given_cloud_mounting(self._options.laser_poses[self._topics.scans.index(topic)], cloud.frame)
        else:
            try:
                mounting = cloud_mounting(self._tree.fixed(self._known_base_frame(), cloud.frame))
            except NoTransformError as error:
                self._awaited[topic] = _missing_mounting(error)
                return None
        if topic not in self._directions:
            self._directions[topic] = directions_in([cloud.cloud], mounting)
        return cloud.scan(mounting._replace(directions=self._directions[topic]), self._options.cloud_band)

    def _known_base_frame(self) -> str:
        """The frame of the odometry, or else a usual one that tf has."""
        return self.base_frame or next((frame for frame in USUAL_BASES if frame in self._tree), USUAL_BASES[-1])

    def _transforms(self, content: object, received_ns: int) -> list[Message]:
        transforms = list(transforms_of(content, received_ns))
        for transform in transforms if self._rig is None else ():
            prefix = transform.child.rpartition("/")[0]  # another one is that of another robot on the same tf
            if not prefix or not self._prefix or prefix == self._prefix:
                self._tree.add(transform.parent, transform.child, transform.T_parent_child)
        if self._topics.odometry is not None or self.is_without_odometry:
            return []
        return [odometry_in(each) for each in transforms if self._edge in (None, (each.parent, each.child))]

    def _rig_now(self, now_s: float) -> Rig | None:
        """The rig if enough is known; None to wait for more."""
        is_late = self._began is not None and now_s > self._began + PATIENCE_S
        self._find_odometry(is_late)
        if not self._is_heard(is_late):
            return None
        self.base_frame = base_frame = self._known_base_frame()
        in_sectors = [are_sectors(scans) for scans in self._first]
        turns = [joined_turns(scans) if is_in else scans for is_in, scans in zip(in_sectors, self._first, strict=True)]
        first = list(map(usual_scan, turns))
        try:
            mountings = self._mountings(first, base_frame)
        except NoTransformError as error:
            if not is_late:
                return None
            self._notify(_missing_mounting(error))
            return None
        camera, note = None, ""
        if self._topics.camera is not None:
            camera, note = mounted_camera(
                self._calibrations.get(self._topics.camera_info or ""), self._tree, base_frame
            )
            if camera is None and not is_late:
                return None
        if note:
            self._notify(f"the camera of {self._topics.camera} {note}")
        for topic, mounted in zip(self._topics.scans, mountings, strict=True):
            if tilt := tilt_note(mounted):
                self._notify(f"the laser of {topic} is {tilt}")
        self._lasers = [ReadLaser(scan.beams, is_in) for scan, is_in in zip(first, in_sectors, strict=True)]
        farthest_m = [max(scan.range_max_m for scan in scans) for scans in turns]
        for scans in self._first:
            scans.clear()
        return rig_of(first, farthest_m, mountings, camera)

    def _find_odometry(self, is_late: bool) -> None:
        """Find the odometry in tf, on the way up from the laser; only without a way, elsewhere."""
        if self._topics.odometry is not None or self._edge is not None or not self._first[0]:
            return
        names = self._first[0][-1].frame, self._options.odom_frame, self._options.base_frame
        if self._tree.robot(*names)[0] or is_late or self._options.laser_poses:
            self._edge = self._tree.odometry_link(*names)
        if self._edge is not None:
            self.odom_frame, self.base_frame = self._edge
            self._has_odometry = True

    def _is_heard(self, is_late: bool) -> bool:
        """Whether there are scans of every laser, and odometry."""
        for topic, scans in zip(self._topics.scans, self._first, strict=True):
            if not scans and is_late:
                silent = f"waits for scans: none that can be read arrived on {topic} within {PATIENCE_S:.0f} s"
                self._notify(self._awaited.get(topic, silent))
        enough = all(len(scans) >= (1 if is_late else SCANS_FOR_RIG) for scans in self._first)
        if is_late and not (self._has_odometry or self.is_without_odometry):
            if self._topics.odometry is not None:
                self._notify(
                    f"waits for odometry: {self._topics.odometry} is silent; the driver of the base publishes it; "
                    "start it, or choose another topic by --sensors odom-topic=TOPIC; odom-topic=none maps without "
                    "odometry"
                )
            elif enough:
                self.is_without_odometry = True
                self._notify(
                    f"{WITHOUT_ODOMETRY}. To use odometry, start the driver of the base before the robot, or name its "
                    "topic by --sensors odom-topic"
                )
        return enough and (self._has_odometry or self.is_without_odometry)

    def _mountings(self, first: list[ScanMessage], base_frame: str) -> list[Mounting]:
        sensors = [
            MountedSensor(topic, topic, self._topics.kinds[topic], scan.frame)
            for topic, scan in zip(self._topics.scans, first, strict=True)
        ]
        try:
            return mountings_of(sensors, self._tree, base_frame, self._options.laser_poses)
        except MountingError as error:
            raise NetworkError(str(error)) from error

    def _read(self, reader: SensorReader, number: int, item: Message) -> Iterator[SensorRecord]:
        if isinstance(item, OdometryReading) and self._edge not in (None, (item.odom_frame, item.base_frame)):
            return
        if isinstance(item, ScanMessage):
            if self._has_stepped_back(item.stamp):
                reader = self._reader = self._new_reader()
            self._widen_range(item)
        yield from self._recorded(reader.add(number, item))
        if reader.images_ahead_s and not self._is_camera_ahead:
            self._is_camera_ahead = True
            self._notify(
                f"the clock of {self._topics.camera} is about {reader.images_ahead_s:.1f} s ahead of that of "
                "the odometry, so its images get an older pose or none; set both clocks by one"
            )

    def _widen_range(self, scan: ScanMessage) -> None:
        """Give a laser whose range_max grows none of its own: that of each message counts."""
        rig = self._rig
        assert rig is not None  # nothing is read before
        laser = rig.lasers[scan.laser]
        if scan.range_max_m > laser.max_range_m:
            lasers = list(rig.lasers)
            lasers[scan.laser] = replace(laser, max_range_m=UNKNOWN_RANGE_M)
            self._rig = rig._replace(lasers=tuple(lasers))

    def _has_stepped_back(self, stamp: float) -> bool:
        """Whether the clock of the scans stepped back and stays there, as when a bag is played again."""
        newest = self._newest_stamp
        if newest is None or stamp >= newest - MAX_STEP_BACK_S:
            self._misplaced = 0
            self._newest_stamp = stamp if newest is None else max(newest, stamp)
            return False
        self._misplaced += 1
        if self._misplaced < STEPS_BACK_FOR_RESTART:
            return False
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
            rig = self._rig
            assert rig is not None  # nothing is read before
            if isinstance(entry, PosedScan):
                yield rig.scan(entry)
            elif isinstance(entry, PosedImage) and rig.camera is not None:
                try:
                    yield rig.image(entry)
                except ValueError:
                    self.audit.add(Fault.BROKEN_IMAGE, number)
        if self.audit.faults()[Fault.NO_ODOMETRY].count:
            self._notify("a scan has no odometry within 1 s and is left out; is the driver of the base alive?")


def _missing_mounting(error: NoTransformError) -> str:
    return (
        f"waits for tf: it has {error}, so the pose of a laser is unknown; start robot_state_publisher or "
        "static_transform_publisher, or give --sensors laser-pose=X,Y,THETA (metres, radians)"
    )
