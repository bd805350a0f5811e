"""Chooses the topics of a bag or of a live robot: those that the user names, or else by fixed rules, with a note."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.geometry.beams import SAME_VIEW_RAD
from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    LASER_SCANS,
    ODOMETRY,
    POINT_CLOUD,
    SCAN,
    SCANS,
    TRANSFORM_KINDS,
)
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.records import OTHER_ENCODING
from fcslam.sources.bags.robots import is_truth, slashed
from fcslam.sources.bags.transforms import last_part

_NEEDED: Mapping[str, tuple[tuple[str, ...], str]] = {
    "--sensors scan-topic": ((*SCANS, IMAGE), f"{SCAN}, {POINT_CLOUD} or a depth image"),
    "--sensors odom-topic": ((ODOMETRY, *TRANSFORM_KINDS), f"{ODOMETRY}, or tf"),
    "--sensors camera-topic": ((COMPRESSED_IMAGE, IMAGE), f"{COMPRESSED_IMAGE} or {IMAGE}"),
}
"""Types of the topics that each option may name."""


class KnownTopics(NamedTuple):
    """The topics from which those of one robot are chosen."""

    own: Sequence[Topic]
    transforms: tuple[Topic, ...]
    label: str
    """What messages begin with: the bag, or nothing."""
    others: Sequence[Topic] = ()
    """Topics that are read only if the user names them."""
    place: str = ""
    """Where the topics are, at the end of a sentence."""
    remedy: str = "record them"
    """How there are scans."""

    @property
    def heard(self) -> list[Topic]:
        """The robot's topics that have messages."""
        return [topic for topic in self.own if topic.message_count]


class Topics(NamedTuple):
    """The topics that are read."""

    scans: tuple[Topic, ...]
    """One for each laser."""
    odometry: tuple[Topic, ...]
    """One topic of odometry, or those of tf; empty without either."""
    transforms: tuple[Topic, ...]
    camera: Topic | None
    """Images; None without readable or calibrated images."""
    camera_info: Topic | None
    notes: tuple[str, ...]


def choose_topics(
    known: KnownTopics, options: BagOptions, field_of_view_rad: Callable[[Topic], float], jumps: Callable[[Topic], bool]
) -> Topics:
    """Choose the topics of a robot to read, by these rules in order:

    - laser: laser scans before point clouds and these before depth images, the widest field of view (to 0.1 rad), one
      echo a beam, the name ``scan``, most messages, first by name;
    - odometry: not one that ``jumps``, as in a map; the name ``odom``, most messages, first by name; ground truth only
      if the user names it;
    - camera: calibrated, most messages, compressed images, first by name.
    """
    heard, every = known.heard, (*known.own, *known.others)
    depth = [topic for topic in heard if topic.type == IMAGE and is_depth(topic.name)]
    scans = [topic for topic in heard if topic.type in SCANS or (topic in depth and calibration_beside(topic, every))]
    if not scans and not options.scan_topics:
        packed = [topic.name for topic in heard if topic.type == COMPRESSED_IMAGE and is_depth(topic.name)]
        remedy = known.remedy
        if unread := [topic for topic in heard if OTHER_ENCODING in topic.type]:
            remedy = f"{unread[0].name} is not in CDR; record it by `ros2 bag record`"
        if depth:
            remedy = f"the depth images of {depth[0].name} need their {info_beside(depth[0].name)}"
        if packed:
            remedy = f"the compressed depth images of {packed[0]} are not read; record {packed[0].rpartition('/')[0]}"
        what = f"no laser scans ({SCAN}), point clouds ({POINT_CLOUD}) or depth images"
        raise SourceError(f"{known.label}{what}{known.place}; {remedy}; {_listed(known)}")
    lasers = [_named(known, name, "--sensors scan-topic") for name in dict.fromkeys(options.scan_topics)]
    if not lasers:
        lasers = [_best_scan(scans, field_of_view_rad)]
    odometries = [topic for topic in heard if topic.type == ODOMETRY and not is_truth(topic.name)]
    odometries += known.transforms
    if options.odom_topic == NO_ODOMETRY:
        odometries = []
    elif options.odom_topic is not None:
        odometries = [_named(known, options.odom_topic, "--sensors odom-topic")]
    camera, camera_info, notes = _choose_camera(known, options.camera_topic)
    if not options.scan_topics:
        notes = [*_note(known, "laser scans", "--sensors scan-topic", lasers[0], scans), *notes]
    measured = [topic for topic in odometries if topic.type == ODOMETRY]
    odometries = measured or odometries
    if len(measured) > 1:
        odometries = [
            min(
                measured,
                key=lambda each: (jumps(each), last_part(each.name) != "odom", -each.message_count, each.name),
            )
        ]
        notes += _note(known, "odometry", "--sensors odom-topic", odometries[0], measured)
    return Topics(tuple(lasers), tuple(odometries), known.transforms, camera, camera_info, tuple(notes))


def _best_scan(scans: Sequence[Topic], field_of_view_rad: Callable[[Topic], float]) -> Topic:
    kinds = ([topic for topic in scans if topic.type in types] for types in (LASER_SCANS, SCANS, (IMAGE,)))
    scans = next(filter(None, kinds))
    view_rad = {topic: field_of_view_rad(topic) for topic in scans}
    wide = [topic for topic in scans if view_rad[topic] > max(view_rad.values()) - 2.0 * SAME_VIEW_RAD]
    return min(
        wide, key=lambda topic: (topic.type != SCAN, last_part(topic.name) != "scan", -topic.message_count, topic.name)
    )


def _choose_camera(known: KnownTopics, wanted: str | None) -> tuple[Topic | None, Topic | None, list[str]]:
    cameras = _images(known) if wanted is None else [_named(known, wanted, "--sensors camera-topic")]
    if not cameras:
        return None, None, []
    info_of = {camera: _calibration_of(camera, known) for camera in cameras}
    chosen = min(
        cameras,
        key=lambda each: (info_of[each] is None, -each.message_count, each.type != COMPRESSED_IMAGE, each.name),
    )
    if info_of[chosen] is None:
        note = f"{known.label}no calibration ({CAMERA_INFO}) of {chosen.name}, the camera is left out"
        return None, None, [note]
    return chosen, info_of[chosen], _note(known, "images", "--sensors camera-topic", chosen, cameras)


def _images(known: KnownTopics) -> list[Topic]:
    images = [topic for topic in known.heard if topic.type in (COMPRESSED_IMAGE, IMAGE)]
    return [topic for topic in images if not is_depth(topic.name)]


def _calibration_of(camera: Topic, known: KnownTopics) -> Topic | None:
    infos = [topic for topic in known.heard if topic.type == CAMERA_INFO]
    only = infos[0] if len(infos) == len(_images(known)) == 1 else None
    return calibration_beside(camera, (*known.own, *known.others)) or only


def calibration_beside(camera: Topic, topics: Sequence[Topic]) -> Topic | None:
    """The calibration topic beside the images."""
    name = slashed(info_beside(camera.name))
    infos = (topic for topic in topics if topic.type == CAMERA_INFO and topic.message_count)
    return next((info for info in infos if slashed(info.name) == name), None)


def info_beside(images: str) -> str:
    """The topic of the calibration of the camera with these images."""
    return images.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"


def is_depth(name: str) -> bool:
    """Whether the images of a topic of this name are depth images."""
    return "depth" in name.lower()


def _named(known: KnownTopics, wanted: str, option: str) -> Topic:
    kinds, needed = _NEEDED[option]
    there = [topic for topic in (*known.own, *known.others) if slashed(topic.name) == slashed(wanted)]
    fitting = [topic for topic in there if topic.type in kinds and topic.message_count]
    if fitting:
        return fitting[0]
    what = "is not there"
    if there:
        what = f"has the type {there[0].type}" if there[0].message_count else "has no messages"
    raise SourceError(f"{known.label}topic {wanted} {what}; {option} needs {needed}; {_listed(known)}")


def _note(known: KnownTopics, what: str, option: str, chosen: Topic, candidates: Sequence[Topic]) -> list[str]:
    others = ", ".join(topic.name for topic in candidates if topic != chosen)
    return [f"{known.label}reads {what} from {chosen.name}, not from {others} ({option} chooses)"] * bool(others)


def _listed(known: KnownTopics) -> str:
    named = ", ".join(f"{topic.name} ({topic.type})" for topic in sorted({*known.own, *known.others}))
    return f"the topics are {one_line(named)}" if named else "there are no topics"
