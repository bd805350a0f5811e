"""The robots of a bag: the topics and frames that belong together.

Topics belong together by their namespaces: those of a scan are of the robot whose odometry or tf is nearest above it.
Frames belong together if tf connects them, or by their prefixes. A robot is that which moves: frames without odometry
are of a robot only if there is no other.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os.path import commonprefix
from typing import NamedTuple

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.sources.bags.census import Messages
from fcslam.sources.bags.codec import COMPRESSED_IMAGE, IMAGE, ODOMETRY, SCANS
from fcslam.sources.bags.container import Topic, is_transforms
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.transforms import TransformTree, last_part
from fcslam.sources.gate import TOLERATED_SHARE

_TF_STATIC = "tf_static"
_TRUTHS = ("ground_truth", "groundtruth")
"""Parts of the name of an odometry topic that holds the ground truth."""


class BagRobot(NamedTuple):
    """The topics of a bag that belong to one robot, and its frames on topics that have several."""

    bag: Messages
    name: str
    """A namespace or the prefix of frames, with a slash in front."""
    topics: tuple[Topic, ...]
    transforms: tuple[Topic, ...]
    scan_frames: Mapping[str, tuple[str, ...]]
    """By the name of a topic; each frame is that of a laser."""
    base_frames: Mapping[str, str]
    """By the name of a topic of odometry."""
    notes: tuple[str, ...] = ()

    def of_type(self, *types: str) -> list[Topic]:
        """The topics of these types that have messages, the one with most messages first."""
        topics = [topic for topic in self.topics if topic.type in types and topic.message_count]
        return sorted(topics, key=lambda topic: (-topic.message_count, topic.name))


@dataclass(slots=True)
class _Member:
    space: str
    transforms: tuple[Topic, ...]
    tree: TransformTree
    scan_frames: dict[Topic, list[str]] = field(default_factory=dict)
    base_frames: dict[Topic, str] = field(default_factory=dict)

    @property
    def frame(self) -> str:
        """Frame of its first scan."""
        return next(iter(self.scan_frames.values()))[0]

    @property
    def moves(self) -> bool:
        """Whether there is odometry."""
        return bool(self.base_frames or self.tree.robot(self.frame)[0])

    def holds(self, frame: str) -> bool:
        """Whether a frame is one of this robot."""
        return self.tree.robot(frame) == self.tree.robot(self.frame) or _prefix(frame) == _prefix(self.frame) != ""


def robots_of(bag: Messages, options: BagOptions) -> tuple[BagRobot, ...]:
    """The robots of a bag, or those that have the topics that ``options`` name; one or more, by name."""
    heard = tuple(topic for topic in bag.topics if topic.message_count)
    members, spaces = _members(heard, bag)
    labels = {(_prefix(member.frame), member.space) for member in members}
    robots = [member for member in members if member.moves] or (members if len(labels) == len(members) else [])
    spaced = [member for member in members if member.space and any(robot.space for robot in robots)]
    if len(robots) < 2 and not any(set(each.transforms).isdisjoint(robots[0].transforms) for each in spaced):
        return (_only_robot(bag, robots or members, options),)
    notes = _lost_scans(bag, robots, members)
    found = [
        BagRobot(
            bag,
            name,
            tuple(topic for topic in heard if _is_topic_of(topic, robot, robots, spaces)),
            robot.transforms,
            {
                topic.name: tuple(frames)
                for topic, frames in robot.scan_frames.items()
                if len(bag.census[topic].frames) > 1
            },
            {topic.name: frame for topic, frame in robot.base_frames.items() if frame},
            notes,
        )
        for name, robot in zip(_names(robots), robots, strict=True)
    ]
    wanted = set(map(slashed, options.scan_topics or filter(None, (options.odom_topic, options.camera_topic))))
    having = [robot for robot in found if wanted & {slashed(topic.name) for topic in robot.topics}]
    if options.scan_topics and not having:  # what is wrong with the topics is said where they are read
        return (_only_robot(bag, members, options),)
    return tuple(sorted(having or found, key=lambda robot: robot.name))


def robot_of(bag: Messages, options: BagOptions) -> BagRobot:
    """The only robot of a bag, or the one that ``options`` name."""
    if options.robot is None:
        robots = robots_of(bag, options)
        if len(robots) == 1:
            return robots[0]
        problem = f"has the robots {_named(robots)}"
    else:
        robots = robots_of(bag, BagOptions())
        for robot in robots:
            if slashed(robot.name) == slashed(options.robot):
                return robot
        problem = f"has no robot {one_line(slashed(options.robot))}, it has {_named(robots)}"
    raise SourceError(f"{bag.label}{problem}; choose one, as in {bag.path.name}:{robots[0].name}")


def _named(robots: Sequence[BagRobot]) -> str:
    return ", ".join(one_line(robot.name) for robot in robots)


def is_truth(name: str) -> bool:
    """Whether a topic of this name holds the ground truth."""
    return any(truth in name.lower() for truth in _TRUTHS)


def slashed(name: str) -> str:
    """The full name of a topic or a robot."""
    return "/" + name.strip("/")


def usual(counts: Mapping[str, int]) -> tuple[str, ...]:
    """The names that more than a few messages have."""
    return tuple(name for name, count in counts.items() if count > TOLERATED_SHARE * sum(counts.values()))


def _members(heard: Sequence[Topic], bag: Messages) -> tuple[list[_Member], set[str]]:
    """The scans that belong together, with their odometry, and the namespaces of robots."""
    census = bag.census
    scans = [topic for topic in heard if topic.type in SCANS]
    odometry = [topic for topic in heard if topic.type == ODOMETRY and not is_truth(topic.name)]
    marked = {space for mark in (*odometry, *filter(is_transforms, heard)) for space in _namespaces(mark)}
    space_of = {topic: _innermost(topic, marked) for topic in scans}
    spaces = set(space_of.values())
    members: dict[object, _Member] = {}
    trees: dict[tuple[Topic, ...], TransformTree] = {}
    for topic in scans:
        space = space_of[topic]
        in_space = [each for each in heard if _innermost(each, spaces) == space]
        transforms = _transforms_around(topic, heard, in_space)
        tree = trees.get(transforms) or trees.setdefault(transforms, bag.tree(transforms))
        for frame in usual(census[topic].frames):
            of_frame = {space_of[each] for each in scans if frame in census[each].frames}
            is_known = frame in tree and len(of_frame) == 1
            robot = tree.robot(frame) if frame in tree else _prefix(frame)
            member = members.setdefault(
                (transforms, robot, "" if is_known else space), _Member(space, transforms, tree)
            )
            member.scan_frames.setdefault(topic, []).append(frame)
    found = list(members.values())
    for topic in odometry:
        inside = [member for member in found if member.space == _innermost(topic, spaces)] or found
        for base in census[topic].frames:
            for member in inside if len(inside) == 1 else [each for each in inside if each.holds(base)][:1]:
                member.base_frames.setdefault(topic, base)
    return found, spaces


def _only_robot(bag: Messages, members: Sequence[_Member], options: BagOptions) -> BagRobot:
    """The robot that has all topics of a bag, but odometry of other frames or namespaces if it has its own."""
    heard = [topic for topic in bag.topics if topic.message_count]
    sensors = [topic for topic in heard if topic.type in (*SCANS, COMPRESSED_IMAGE, IMAGE)]
    transforms = {each for topic in sensors for each in _transforms_around(topic, heard, heard)}
    scan_frames = {topic.name: usual(its.frames) for topic, its in bag.census.items() if topic.type in SCANS}
    scan_frames = {name: frames for name, frames in scan_frames.items() if len(frames) > 1}
    if not members:
        return BagRobot(bag, "/", bag.topics, tuple(sorted(transforms)), scan_frames, {})
    member, base_frames = members[0], {}
    around = _namespaces(next(iter(member.scan_frames)))
    fitting: list[Topic] = []
    apart: list[Topic] = []
    for topic, its in bag.census.items():
        frames = its.frames if topic.type == ODOMETRY else {}
        if not frames:
            continue
        own = [frame for frame in usual(frames) if frame and member.holds(frame)]
        if len(own) == 1:
            base_frames[topic.name] = own[0]
        if not is_truth(topic.name):
            is_near = _innermost(topic, {member.space}) == member.space or _namespaces(topic)[0] in around
            (fitting if is_near and (own or "" in frames) else apart).append(topic)
    if options.odom_topic or options.laser_poses or not (fitting or member.tree.robot(member.frame)[0]):
        apart = []
    notes = tuple(
        f"{bag.label}{topic.name} is not used, as its namespace or frames are not those of the laser, "
        f"'{one_line(member.frame)}' (--sensors odom-topic chooses)"
        for topic in apart
    )
    topics = tuple(topic for topic in bag.topics if topic not in apart)
    name = _names([member])[0]
    return BagRobot(bag, name, topics, tuple(sorted(transforms)), scan_frames, base_frames, notes)


def _lost_scans(bag: Messages, robots: Sequence[_Member], members: Sequence[_Member]) -> tuple[str, ...]:
    notes = []
    for member in members:
        for topic, frames in () if member in robots else member.scan_frames.items():
            for robot in robots:
                if topic in robot.scan_frames:
                    raise SourceError(
                        f"{bag.label}{topic.name} has scans of the frames {listed(robot.scan_frames[topic])} and "
                        f"{listed(frames)}, and tf does not say which robot the last are of; record /tf and /tf_static "
                        "of all robots"
                    )
            notes.append(
                f"{bag.label}scans of {listed(frames)} on {topic.name} belong to no robot with odometry; not used"
            )
    return tuple(notes)


def listed(frames: Iterable[str]) -> str:
    """The names of frames in a sentence."""
    return " and ".join(f"'{one_line(frame)}'" for frame in frames)


def _is_topic_of(topic: Topic, robot: _Member, robots: Sequence[_Member], spaces: set[str]) -> bool:
    if topic.type in SCANS:
        return topic in robot.scan_frames
    if is_transforms(topic):
        return topic in robot.transforms
    if topic.type == ODOMETRY and not is_truth(topic.name):
        return topic in robot.base_frames
    return _innermost(topic, spaces) == robot.space and [each.space for each in robots].count(robot.space) == 1


def _names(robots: Sequence[_Member]) -> list[str]:
    """Names that tell robots apart: namespaces, prefixes of frames, namespaces of scans, or frames."""
    suffix = commonprefix([robot.frame[::-1] for robot in robots])[::-1]  # noqa: RUF071  of letters
    choices = (
        [robot.space for robot in robots],
        [_prefix(robot.frame) for robot in robots],
        [_namespaces(next(iter(robot.scan_frames)))[0] for robot in robots],
        [robot.frame.removesuffix(suffix).strip("_-") for robot in robots],
        [f"{robot.frame}_{number}" for number, robot in enumerate(robots, 1)],
    )
    return list(map(slashed, next(names for names in choices if len(set(names)) == len(robots))))


def _transforms_around(topic: Topic, heard: Iterable[Topic], others: Iterable[Topic]) -> tuple[Topic, ...]:
    """The topics of tf and of tf_static, each in the innermost namespace around ``topic``, else among ``others``."""
    found: list[Topic] = []
    for is_static in (False, True):

        def is_of_kind(each: Topic, is_static: bool = is_static) -> bool:
            return is_transforms(each) and (last_part(each.name) == _TF_STATIC) == is_static

        kind = list(filter(is_of_kind, heard))
        inner = ([each for each in kind if _namespaces(each)[0] == space] for space in _namespaces(topic))
        found += next(filter(None, inner), filter(is_of_kind, others))
    return tuple(sorted(found))


def _prefix(frame: str) -> str:
    return frame.partition("/")[0] if "/" in frame else ""


def _namespaces(topic: Topic) -> list[str]:
    parts = slashed(topic.name).split("/")[:-1]
    return ["/".join(parts[:end]) for end in range(len(parts), 0, -1)]


def _innermost(topic: Topic, spaces: set[str]) -> str:
    return next((space for space in _namespaces(topic) if space in spaces), "")
