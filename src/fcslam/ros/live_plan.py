"""Plans from the first messages of a live robot how it is read, as from those of a bag."""

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from fcslam.ros.topics import SensorTopics
from fcslam.sources.bags.census import BagMessage, Messages, TopicCensus
from fcslam.sources.bags.codec import CLOUDS, FIX, IMAGE
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.messages import ScanMessage, header_of
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.plan import USUAL_ODOM, BagPlan, plan_of
from fcslam.sources.bags.records import StoredMessage
from fcslam.sources.bags.rig import RecordedLaser, Rig
from fcslam.sources.bags.robots import BagRobot
from fcslam.sources.bags.topics import Topics, info_beside
from fcslam.sources.bags.transforms import NoTransformError
from fcslam.sources.clouds_in_space import CloudReader
from fcslam.sources.point_clouds import FARTHEST_M, FEWEST_FLOORS

SCANS_FOR_RIG: Final = 5
"""Number of first scans of each laser that decide which beams it has; clouds show the floor, too."""
PATIENCE_S: Final = 5.0
"""Time after which a live robot says that the odometry, a laser or a mounting is missing, and waits no longer for a
calibration."""
_LONGEST_WAIT: Final = 10_000
"""Most first messages that wait for the plan."""
_LARGE: Final = (*CLOUDS, IMAGE)
_MOST_LARGE: Final = 100
"""Most clouds or depth images of a topic among them."""

Notify = Callable[[str], None]
"""Takes one line for the user; what repeats a line is not said again."""


class FirstMessages(Messages):
    """The first messages of a live robot, by which it is planned; later ones are only decoded."""

    path = Path()

    def __init__(self, topics: SensorTopics, namespace: str) -> None:
        """``namespace`` is "" or begins with a slash."""
        self.namespace = namespace.strip("/")
        self.by_name = {name: Topic(name, kind, 1) for name, kind in topics.kinds.items()}
        self.is_planned = False
        self._census = {topic: TopicCensus(number) for number, topic in enumerate(self.by_name.values())}
        self._kept: deque[BagMessage] = deque(maxlen=_LONGEST_WAIT)
        self.counts: Counter[Topic] = Counter()
        """Number of scans kept of each topic."""
        self._frames: dict[Topic, str] = {}
        """Frame of the first scan of each topic."""

    @property
    def census(self) -> Mapping[Topic, TopicCensus]:
        """As in ``Messages``."""
        return self._census

    def decoded(self, name: str, payload: bytes, received_ns: int) -> BagMessage:
        """The next message of the topic with this name, as in a bag."""
        topic = self.by_name[name]
        its = self._census[topic]
        if self.is_planned:
            its.forget()
        its.add(received_ns)
        stored = StoredMessage(name, topic.type, received_ns, payload, (-1, 0, 0))
        return BagMessage(topic, its.count, received_ns, received_ns, its.decoded(stored, ros1=False))

    def clocked(self, message: BagMessage) -> BagMessage:
        """The message by the clock of its topic, as it is known now."""
        return message.by_clock(self._census[message.topic].lag_ns)

    def frames(self, scan: BagMessage) -> tuple[str, str]:
        """The frame of the first scan of a topic, and of this one."""
        content = scan.content
        frame = content.frame if isinstance(content, ScanMessage) else header_of(content.header, 0)[1]
        return self._frames.setdefault(scan.topic, frame), frame

    def keep(self, message: BagMessage) -> None:
        """Keep one of the first messages for the plan."""
        self._kept.append(message)
        self.counts[message.topic] += 1
        if message.topic.type in _LARGE and self.counts[message.topic] > _MOST_LARGE:
            del self._kept[next(at for at, each in enumerate(self._kept) if each.topic == message.topic)]

    def read(self, topics: Collection[Topic]) -> Iterator[BagMessage]:
        """As in ``Messages``."""
        return (self.clocked(each) for each in self._kept if each.topic in topics)

    def released(self) -> Iterator[BagMessage]:
        """All that were kept, which are not kept any more."""
        self.is_planned = True
        while self._kept:
            yield self.clocked(self._kept.popleft())

    @property
    def state(self) -> tuple[object, ...]:
        """What decides whether there is a plan; another one may come with another state."""
        return tuple(
            (min(self.counts[topic], FEWEST_FLOORS), its.count > its.unstamped, sum(map(len, its.links.values())))
            for topic, its in self._census.items()
        )


class LivePlan(NamedTuple):
    """How a live robot is read."""

    sensors: BagPlan
    rig: Rig
    clouds: CloudReader | None
    """Reader of the clouds of a 3D LiDAR; None without one."""


class LivePlanner:
    """Plans as soon as enough is heard, and says what is missing."""

    def __init__(self, topics: SensorTopics, namespace: str, options: BagOptions, notify: Notify) -> None:
        """``namespace`` is "" or begins with a slash."""
        self.messages = FirstMessages(topics, namespace)
        self.odom_frame, self.base_frame = USUAL_ODOM, ""
        """Frames of the odometry, once there is a plan; a driver may leave them out."""
        self.is_without_odometry = options.odom_topic == NO_ODOMETRY
        self._options, self._notify = options, notify
        scans, transforms, odometry, camera, info = (
            tuple(self.messages.by_name[name] for name in names if name and name in topics.kinds)
            for names in (topics.scans, topics.transforms, (topics.odometry,), (topics.camera,), (topics.camera_info,))
        )
        self._odometry = next(iter(odometry), None)
        camera_topic = next(iter(camera), None)
        self._topics = Topics(scans, odometry or transforms, transforms, camera_topic, next(iter(info), None), ())
        own = tuple(topic for topic in self.messages.topics if topic.type != FIX)  # these are read on their own
        self._robot = BagRobot(self.messages, "", own, transforms, {}, {})
        self._began: float | None = None
        self._tried: tuple[object, ...] = ()

    def plan(self, now_s: float) -> LivePlan | None:
        """The plan if enough is known; None to wait for more."""
        self._began = now_s if self._began is None else self._began
        is_late = now_s > self._began + PATIENCE_S
        state = is_late, *self.messages.state
        if state == self._tried:
            return None
        self._tried = state
        if not self._is_heard(is_late):
            return None
        try:
            plan = plan_of(self._robot, self._options, self._topics)
            rig, notes = plan.rig([self._farthest_m(laser) for laser in plan.lasers])
            clouds = None
            if plan.scans.is_whole(self._topics.scans[0]):
                clouds, of_clouds = plan.scans.whole_reader(self._topics.scans[0])
                notes += of_clouds
        except NoTransformError as error:
            if is_late:
                self._notify(
                    f"waits for tf: it has {error}; start robot_state_publisher or static_transform_publisher, or give "
                    "--sensors laser-pose=X,Y,THETA (metres, radians)"
                )
            return None
        if self._topics.camera is not None and rig.camera is None and not is_late:
            return None
        for note in (*plan.notes, *plan.scans.notes, *notes):
            self._notify(note)
        if plan.odometry is None and not self.is_without_odometry:
            self._notify(
                "to use odometry, start the driver of the base before the robot, or name its topic by --sensors "
                "odom-topic"
            )
        self.odom_frame, self.base_frame = plan.frames
        self.is_without_odometry = plan.odometry is None
        return LivePlan(plan, rig, clouds)

    def _farthest_m(self, laser: RecordedLaser) -> float:
        scans = (message.decoded for message in self.messages.read([laser.topic]))
        return max((scan.range_max_m for scan in scans if isinstance(scan, ScanMessage)), default=FARTHEST_M)

    def _is_heard(self, is_late: bool) -> bool:
        census, counts, enough = self.messages.census, self.messages.counts, True
        for topic in self._topics.scans:
            its, info = census[topic], self.messages.by_name.get(info_beside(topic.name))
            is_stamped = its.count > its.unstamped
            needed = FEWEST_FLOORS if topic.type in CLOUDS else SCANS_FOR_RIG
            enough &= counts[topic] >= (1 if is_late else needed) and (is_late or is_stamped)
            if topic.type == IMAGE and info is not None and not counts[info]:
                enough = False
                if is_late:
                    self._notify(f"waits for the calibration of {topic.name}: {info.name} is silent; publish it")
            elif not counts[topic] and is_late:
                self._notify(
                    f"waits for scans: none that can be read arrived on {topic.name} within {PATIENCE_S:.0f} s"
                )
        if not enough or self.is_without_odometry:
            return enough
        if self._odometry is None:
            return is_late or self._moves_in_tf
        if not counts[self._odometry] and is_late:
            self._notify(
                f"waits for odometry: {self._odometry.name} is silent; the driver of the base publishes it; start it, "
                "or choose another topic by --sensors odom-topic=TOPIC; odom-topic=none maps without odometry"
            )
        return counts[self._odometry] > 0

    @property
    def _moves_in_tf(self) -> bool:
        first = next(self.messages.read([self._topics.scans[0]]))
        tree = self.messages.tree(self._topics.transforms)
        names = self.messages.frames(first)[0], self._options.odom_frame, self._options.base_frame
        return bool(tree.robot(*names)[0] or (self._options.laser_poses and tree.odometry_link(*names)))
