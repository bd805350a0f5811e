"""Decides from the first messages of a live robot how it is read: its lasers, its odometry and its camera."""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from fcslam.ros.topics import SensorTopics
from fcslam.sources.bags.camera import Calibration
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.messages import OdometryReading, ScanMessage, StampedTransform
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.rig import (
    RecordedLaser,
    Rig,
    mounted_camera,
    mountings_of,
    recorded_laser,
    rig_of,
    tilt_note,
)
from fcslam.sources.bags.transforms import Link, NoTransformError, TransformTree
from fcslam.sources.path_summary import without_odometry

USUAL_ODOM: Final = "odom"
"""Frame of an odometry that names none."""
SCANS_FOR_RIG: Final = 5
"""Number of first scans of each laser that decide which beams it has."""
PATIENCE_S: Final = 5.0
"""Time after which a live robot says that the odometry, a laser or a mounting is missing, and waits no longer for a
calibration."""
_SCANS_KEPT: Final = 100
"""Most first scans of a laser that decide."""

Notify = Callable[[str], None]
"""Takes one line for the user; what repeats a line is not said again."""


class LivePlan(NamedTuple):
    """How a live robot is read."""

    rig: Rig
    lasers: tuple[RecordedLaser, ...]
    edge: Link | None
    """Frames of the odometry in tf; None: it is on a topic, or there is none."""

    def is_odometry(self, item: object) -> bool:
        """Whether something that was read is a reading of the odometry."""
        return isinstance(item, OdometryReading) and self.edge in (None, (item.odom_frame, item.base_frame))


class LivePlanner:
    """Collects what a plan needs, and says what is missing."""

    def __init__(self, topics: SensorTopics, namespace: str, options: BagOptions, notify: Notify) -> None:
        """``namespace`` is "" or begins with a slash."""
        self.tree = TransformTree()
        self.calibrations: dict[str, Calibration] = {}
        """By the topic of camera_info."""
        self.awaited: dict[str, str] = {}
        """Topics whose messages cannot be scans before tf and a calibration are known, and a line that says it."""
        self.odom_frame, self.base_frame = USUAL_ODOM, ""
        """Frames of the odometry, once it is there; a driver may leave them out."""
        self.is_without_odometry = options.odom_topic == NO_ODOMETRY
        self._topics, self._options, self._notify = topics, options, notify
        self._prefix = namespace.strip("/")
        self._first: list[deque[ScanMessage]] = [deque(maxlen=_SCANS_KEPT) for _ in topics.scans]
        self._has_odometry = False
        self._edge: Link | None = None
        self._began: float | None = None

    @property
    def known_base_frame(self) -> str:
        """The frame of the odometry, or else a usual one that tf has."""
        return self.base_frame or self.tree.usual_base

    def add_scan(self, scan: ScanMessage, is_stamped: bool = True) -> None:
        """Take one of the first scans of a laser; those without a stamp are not enough, as others show the clock."""
        if is_stamped or len(self._first[scan.laser]) < SCANS_FOR_RIG - 1:
            self._first[scan.laser].append(scan)

    def add_reading(self, reading: OdometryReading) -> None:
        """Take a message of odometry."""
        self.odom_frame = reading.odom_frame or USUAL_ODOM
        self.base_frame = self._options.base_frame or reading.base_frame
        self._has_odometry = True

    def add_transforms(self, transforms: Iterable[StampedTransform]) -> None:
        """Take the transforms of a message of tf, but those of other robots on the same tf."""
        for transform in transforms:
            prefix = transform.child.rpartition("/")[0]
            if not prefix or not self._prefix or prefix == self._prefix:
                self.tree.add(transform.parent, transform.child, transform.T_parent_child)

    def plan(self, now_s: float) -> LivePlan | None:
        """The plan if enough is known; None to wait for more."""
        self._began = now_s if self._began is None else self._began
        is_late = now_s > self._began + PATIENCE_S
        self._find_odometry(is_late)
        if not self._is_heard(is_late):
            return None
        self.base_frame = base_frame = self.known_base_frame
        lasers = tuple(
            recorded_laser(Topic(topic, self._topics.kinds[topic], len(scans)), scans)
            for topic, scans in zip(self._topics.scans, self._first, strict=True)
        )
        try:
            mountings = mountings_of(lasers, self.tree, base_frame, self._options.laser_poses)
        except NoTransformError as error:
            if not is_late:
                return None
            self._notify(missing_mounting(error))
            return None
        camera, note = None, ""
        if self._topics.camera is not None:
            camera, note = mounted_camera(self.calibrations.get(self._topics.camera_info or ""), self.tree, base_frame)
            if camera is None and not is_late:
                return None
        if note:
            self._notify(f"the camera of {self._topics.camera} {note}")
        for topic, mounted in zip(self._topics.scans, mountings, strict=True):
            if tilt := tilt_note(mounted):
                self._notify(f"the laser of {topic} is {tilt}")
        farthest_m = [max(scan.range_max_m for scan in scans) for scans in self._first]
        for scans in self._first:
            scans.clear()
        return LivePlan(rig_of(lasers, farthest_m, mountings, camera), lasers, self._edge)

    def _find_odometry(self, is_late: bool) -> None:
        if self._topics.odometry is not None or self._edge is not None or not self._first[0]:
            return
        names = self._first[0][-1].frame, self._options.odom_frame, self._options.base_frame
        if self.tree.robot(*names)[0] or is_late or self._options.laser_poses:
            self._edge = self.tree.odometry_link(*names)
        if self._edge is not None:
            self.odom_frame, self.base_frame = self._edge
            self._has_odometry = True

    def _is_heard(self, is_late: bool) -> bool:
        for topic, scans in zip(self._topics.scans, self._first, strict=True):
            if not scans and is_late:
                silent = f"waits for scans: none that can be read arrived on {topic} within {PATIENCE_S:.0f} s"
                self._notify(self.awaited.get(topic, silent))
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
                first = self._first[0]
                interval_s = (first[-1].stamp - first[0].stamp) / max(1, len(first) - 1)
                self._notify(
                    f"{without_odometry(interval_s)}. To use odometry, start the driver of the base before the robot, "
                    "or name its topic by --sensors odom-topic"
                )
        return enough and (self._has_odometry or self.is_without_odometry)


def missing_mounting(error: NoTransformError) -> str:
    """What a robot waits for if tf lacks the mounting of a laser."""
    return (
        f"waits for tf: it has {error}; start robot_state_publisher or "
        "static_transform_publisher, or give --sensors laser-pose=X,Y,THETA (metres, radians)"
    )
