"""Messages of a live robot in, sensor records out, as a bag would give them.

The first messages wait until they show how the robot is read, as those of a bag do; then they are read, so none is
lost. A scan waits for the odometry at its stamp. If that does not come, it gets the nearest pose within 1 s, or it is
left out. A robot whose odometry is silent from the start is mapped without.
"""

from collections.abc import Iterator
from math import inf

from fcslam.records import CloudScan, SensorRecord
from fcslam.ros.live_plan import LivePlan, LivePlanner, Notify
from fcslam.ros.topics import SensorTopics
from fcslam.sources.bags.census import BagMessage
from fcslam.sources.bags.codec import IMAGE
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.fixes import FixReader
from fcslam.sources.bags.messages import ScanMessage
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.pairing import MAX_GAP_S, Item, PosedImage, PosedScan
from fcslam.sources.bags.plan import FEWEST_LAGS, clock_ahead
from fcslam.sources.bags.reader import CloudStream, Numbered, SensorReader
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import MAX_STEP_BACK_S
from fcslam.sources.point_clouds import PointCloud

ODOMETRY_PATIENCE_S = MAX_GAP_S
"""Time that a scan waits for its odometry."""
MERGING_PATIENCE_S = 0.3
"""Time that scans of one laser wait for those of another, so a laser that stops does not delay the pose."""
RAW_IMAGE_PERIOD_S = 0.4
"""Least time between two raw images that are read; places are a metre apart, and an image takes 10 ms to encode."""
STEPS_BACK_FOR_RESTART = 3
"""Number of scans in a row that are far back in time until the clock is taken to have stepped back."""


class LiveSensors:
    """Reads the messages of one robot, one at a time."""

    def __init__(self, topics: SensorTopics, namespace: str, options: BagOptions, notify: Notify) -> None:
        """``namespace`` is "" or begins with a slash."""
        self.audit = Audit("message")
        self.planner = LivePlanner(topics, namespace, options, notify)
        """What is known of the robot."""
        self.restarts = 0
        self._newest_stamp: float | None = None
        self._topics, self._notify = topics, notify
        self._needed = set(topics.kinds)
        """Topics of which messages are decoded."""
        self._plan: LivePlan | None = None
        """How the robot is read, once that is known."""
        self._reader: SensorReader | CloudStream | None = None
        self._first_fixes: list[BagMessage] = []
        self._fixes: FixReader | None = None
        self._mixed: set[Topic] = set()
        """Topics with scans of other frames, of which there was a line."""
        self._misplaced = 0
        self._next_image_s = -inf
        self._waiting_since_s: dict[str, float] = {}
        """Since when scans wait for other lasers, or for odometry."""

    def add(self, topic: str, payload: bytes, now_s: float, received_ns: int) -> Iterator[SensorRecord]:
        """Read the next message; yields the records that are complete at ``now_s`` of a clock that only grows.

        ``received_ns`` is the time of a message without a stamp.
        """
        is_scan, messages = topic in self._topics.scans, self.planner.messages
        if topic not in self._needed or (not is_scan and self._is_needless(self._topics.kinds[topic], now_s)):
            return
        message = messages.decoded(topic, payload, received_ns)
        if isinstance(message.decoded, ValueError):
            self._count_broken(message, message.decoded)
            return
        if (is_scan or topic == self._topics.odometry) and messages.census[message.topic].unstamped:
            self._notify(f"{topic} has messages without a stamp; the times at which they arrive count")
        if is_scan and self._is_of_other_frame(message):
            return
        if self._plan is not None:
            yield from self._read(messages.clocked(message))
        elif is_scan or topic != self._topics.camera:  # images are large, and the first ones show little
            messages.keep(message)
        yield from self.wait(now_s)

    def wait(self, now_s: float) -> Iterator[SensorRecord]:
        """Yield what need not wait any longer at the time ``now_s``, if there is no message."""
        if self._reader is None:
            self._plan = plan = self.planner.plan(now_s)
            if plan is None:
                return
            self._reader = self._new_reader(plan)
            read = plan.sensors.read_topics(with_images=True, with_imu=True)
            self._needed = {self._topics.fixes or "", *(each.name for each in read)}
            for message in self.planner.messages.released():
                yield from self._read(message)
        reader = self._reader
        silent = reader.silent_lasers
        if self._waits_too_long("lasers", bool(silent), now_s, MERGING_PATIENCE_S):
            for laser in silent:
                self._notify(f"{self._topics.scans[laser]} is silent; the robot goes on with its other lasers")
            yield from self._recorded(reader.skip_lasers())
        if self._waits_too_long("odometry", reader.waits_for_odometry, now_s, ODOMETRY_PATIENCE_S):
            yield from self._recorded(reader.skip_odometry())

    def finish(self) -> Iterator[SensorRecord]:
        """Yield all that waits, as no more messages come."""
        if self._reader is not None:
            yield from self._recorded(self._reader.finish())

    def _waits_too_long(self, what: str, is_waiting: bool, now_s: float, longest_s: float) -> bool:
        """Whether the wait for something goes on for too long; then it begins again."""
        since_s = self._waiting_since_s.setdefault(what, now_s) if is_waiting else now_s
        is_over = now_s > since_s + longest_s
        if is_over or not is_waiting:
            self._waiting_since_s.pop(what, None)
        return is_over

    def _new_reader(self, plan: LivePlan) -> SensorReader | CloudStream:
        if plan.clouds is not None:
            return CloudStream(plan.clouds, self.audit)
        return SensorReader(plan.sensors.lasers, plan.sensors.odometry is not None, self.audit)

    def _is_needless(self, kind: str, now_s: float) -> bool:
        """Whether a raw image comes soon after the one before, as decoding costs more time than all scans."""
        if kind != IMAGE or now_s < self._next_image_s:
            return kind == IMAGE
        self._next_image_s = now_s + RAW_IMAGE_PERIOD_S
        return False

    def _is_of_other_frame(self, message: BagMessage) -> bool:
        """Whether a scan is in another frame than the first one of its topic; it is counted, and told once."""
        first, frame = self.planner.messages.frames(message)
        if frame == first:
            return False
        if message.topic not in self._mixed:
            self._mixed.add(message.topic)
            self._notify(
                f"{message.topic.name} has scans of the frames '{first}' and '{frame}', the last are left out; publish "
                "the scans of each laser on a topic of its own"
            )
        self.audit.add(Fault.OTHER_BEAMS, message.number)
        return True

    def _count_broken(self, message: BagMessage, error: ValueError) -> None:
        broken = Fault.BROKEN_IMAGE if message.topic.name == self._topics.camera else Fault.BROKEN_MESSAGE
        if not self.audit.faults()[broken].count:
            self._notify(f"{message.topic.name}: {broken} ({error}); correct the driver")
        self.audit.add(broken, message.number)

    def _read(self, message: BagMessage) -> Iterator[SensorRecord]:
        plan = self._plan
        assert plan is not None  # nothing is read before
        if message.topic.name == self._topics.fixes:
            self._first_fixes.append(message)
            if self._fixes is None and len(self._first_fixes) >= FEWEST_LAGS:  # these show their clock
                name, first = message.topic.name, self.planner.messages
                lags_s = first.census[message.topic].lags_s
                ahead_s, note = clock_ahead(first, plan.sensors.lasers[0], name, lags_s)
                if note:
                    self._notify(note)
                self._fixes = plan.sensors.fix_reader(self.audit, ahead_s)
            while self._fixes is not None and self._first_fixes:
                yield from self._fixes.read(self._first_fixes.pop(0))
            return
        try:
            items = plan.sensors.items(message)
        except ValueError as error:
            self._count_broken(message, error)
            return
        for item in items:
            yield from self._recorded(self._entries(plan, message.number, item))

    def _entries(self, plan: LivePlan, number: int, item: Item) -> Iterator[Numbered] | Iterator[tuple[int, CloudScan]]:
        if isinstance(item, ScanMessage | PointCloud) and self._has_stepped_back(item.stamp):
            self._reader = self._new_reader(plan)
        if isinstance(item, ScanMessage):
            self._plan = plan._replace(rig=plan.rig.widened(item))
        assert self._reader is not None  # it comes with the plan
        return self._reader.add(number, item)

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
            self._waiting_since_s.pop("odometry", None)
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
