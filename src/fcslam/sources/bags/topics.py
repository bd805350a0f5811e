"""Chooses the topics of a bag: those that the user names, or else by fixed rules, with a note."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    LASER_SCANS,
    ODOMETRY,
    POINT_CLOUD,
    SCAN,
    SCANS,
)
from fcslam.sources.bags.container import Topic, is_transforms
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.robots import BagRobot, is_truth, slashed
from fcslam.sources.bags.transforms import last_part

_NAMED_AT_MOST = 15
_NEEDED = {
    "--sensors scan-topic": f"{SCAN}, {POINT_CLOUD} or a depth image",
    "--sensors odom-topic": f"{ODOMETRY}, or tf",
    "--sensors camera-topic": f"{COMPRESSED_IMAGE} or {IMAGE}",
}
_SAME_VIEW_RAD = 0.1
"""Fields of view that differ by less are equally wide."""


class Topics(NamedTuple):
    """The topics of a bag that are read."""

    scans: tuple[Topic, ...]
    """One for each laser."""
    odometry: tuple[Topic, ...]
    """One topic of odometry, or those of tf; empty without either."""
    transforms: tuple[Topic, ...]
    """Those of tf."""
    camera: Topic | None
    """Images; None without readable or calibrated images."""
    camera_info: Topic | None
    """Calibration of these images."""
    notes: tuple[str, ...]


class Candidates(NamedTuple):
    """The topics of one bag that can be read."""

    scans: Sequence[Topic]
    views_rad: Mapping[str, float]
    """Field of view of each topic of scans, by name."""
    measured: Sequence[Topic]
    """Odometry."""
    cameras: Sequence[Topic]
    """Images with calibration."""


def choose_topics(
    robot: BagRobot,
    options: BagOptions,
    field_of_view_rad: Callable[[Topic], float],
    has_images: Callable[[Topic], bool],
) -> Topics:
    """Choose the topics of a robot to read, by these rules in order:

    - laser: laser scans before point clouds and these before depth images, the widest field of view (to 0.1 rad), one
      echo a beam, the name ``scan``, most messages, first by name;
    - odometry: the name ``odom``, most messages, first by name; ground truth only if the user names it;
    - camera: calibrated, most messages, compressed images, first by name.

    Raises:
        SourceError: a required topic is missing, or a named topic is missing or of another type.
    """
    heard, scans = _heard(robot), _scans(robot)
    if not scans:
        packed = [topic.name for topic in heard if topic.type == COMPRESSED_IMAGE and is_depth(topic.name)]
        bare = [topic.name for topic in heard if topic.type == IMAGE and is_depth(topic.name)]
        remedy = "record them"
        if bare:
            remedy = f"the depth images of {bare[0]} need their {info_beside(bare[0])}"
        if packed:
            remedy = f"the compressed depth images of {packed[0]} are not read; record {packed[0].rpartition('/')[0]}"
        raise SourceError(
            f"{robot.bag.path}: no laser scans ({SCAN}), point clouds ({POINT_CLOUD}) or depth images; {remedy}; "
            f"{_known(robot.topics)}"
        )
    readable = [*scans, *_images(robot)]
    lasers = [
        topic for name in options.scan_topics for topic in _candidates(robot, readable, name, "--sensors scan-topic")
    ]
    if not lasers:
        preferred = _preferred(scans)
        lasers = [_best_scan(preferred, [_views_rad(preferred, field_of_view_rad)])]
    transforms, wanted = robot.transforms, options.odom_topic
    able = [*_measured(robot), *transforms]
    if wanted is not None:
        able = [topic for topic in heard if topic.type == ODOMETRY or is_transforms(topic)]
    odometries = [] if wanted == NO_ODOMETRY else _candidates(robot, able, wanted, "--sensors odom-topic")
    camera, camera_info, notes = _choose_camera(robot, options.camera_topic, has_images)
    if not options.scan_topics:
        notes = [*_note(robot, "laser scans", "--sensors scan-topic", lasers[0], scans), *notes]
    if measured := [topic for topic in odometries if topic.type == ODOMETRY]:
        odometries = [_best_odometry(measured)]
        notes += _note(robot, "odometry", "--sensors odom-topic", odometries[0], measured)
    return Topics(tuple(lasers), tuple(odometries), transforms, camera, camera_info, tuple(notes))


def find_candidates(
    robot: BagRobot, field_of_view_rad: Callable[[Topic], float], has_images: Callable[[Topic], bool]
) -> Candidates:
    """The topics of ``robot`` from which ``choose_topics`` would choose.

    Raises:
        SourceError: the bag cannot be read.
    """
    scans, images = _preferred(_scans(robot)), _images(robot)
    calibrated = [topic for topic in images if _calibration_of(topic, robot) and has_images(topic)]
    return Candidates(scans, _views_rad(scans, field_of_view_rad), _measured(robot), calibrated)


def agree_on_topics(bags: Sequence[Candidates], options: BagOptions) -> tuple[BagOptions, tuple[str, ...]]:
    """Choose the same topics for all bags of a fleet, where ``options`` name none.

    The rules are those of ``choose_topics``, applied to the topics that all bags have. If they share no topic of a
    kind, each bag keeps its own choice.

    Returns:
        The options with the topics, and notes about the choice.
    """
    notes = []
    scans = _common([bag.scans for bag in bags])
    measured = _common([bag.measured for bag in bags])
    cameras = _common([bag.cameras for bag in bags])
    if scans and not options.scan_topics:
        scan = _best_scan(scans, [bag.views_rad for bag in bags])
        options = replace(options, scan_topics=(scan.name,))
        notes += _fleet_note("laser scans", "--sensors scan-topic", scan, [bag.scans for bag in bags])
    if measured and options.odom_topic is None:
        odometry = _best_odometry(measured)
        options = replace(options, odom_topic=odometry.name)
        notes += _fleet_note("odometry", "--sensors odom-topic", odometry, [bag.measured for bag in bags])
    if cameras and options.camera_topic is None:
        camera = min(cameras, key=_camera_rank)
        options = replace(options, camera_topic=camera.name)
        notes += _fleet_note("images", "--sensors camera-topic", camera, [bag.cameras for bag in bags])
    return options, tuple(notes)


def _heard(robot: BagRobot) -> list[Topic]:
    return [topic for topic in robot.topics if topic.message_count]


def _scans(robot: BagRobot) -> list[Topic]:
    depths = [each for each in _heard(robot) if each.type == IMAGE and is_depth(each.name)]
    calibrated = [each for each in depths if calibration_beside(each, robot)]
    return [topic for topic in _heard(robot) if topic.type in SCANS or topic in calibrated]


def _preferred(scans: Sequence[Topic]) -> list[Topic]:
    """The laser scans, else the point clouds, else the depth images."""
    kinds = ([topic for topic in scans if topic.type in types] for types in (LASER_SCANS, SCANS, (IMAGE,)))
    return next(filter(None, kinds), [])


def _measured(robot: BagRobot) -> list[Topic]:
    return [topic for topic in _heard(robot) if topic.type == ODOMETRY and not is_truth(topic.name)]


def _common(candidates: Sequence[Sequence[Topic]]) -> list[Topic]:
    """Topics that all bags have, with the messages of all of them."""
    names = set.intersection(*({topic.name for topic in own} for own in candidates))
    counts = Counter[str]()
    for topic in chain.from_iterable(candidates):
        counts[topic.name] += topic.message_count
    return [topic._replace(message_count=counts[topic.name]) for topic in candidates[0] if topic.name in names]


def _views_rad(scans: Sequence[Topic], field_of_view_rad: Callable[[Topic], float]) -> dict[str, float]:
    """Field of view of each topic by name; not looked up without a choice."""
    return {topic.name: field_of_view_rad(topic) if len(scans) > 1 else 0.0 for topic in scans}


def _best_scan(scans: Sequence[Topic], views_rad: Sequence[Mapping[str, float]]) -> Topic:
    """``views_rad``: of each bag."""
    view_rad = {topic: min(views[topic.name] for views in views_rad) for topic in scans}
    wide = [topic for topic in scans if view_rad[topic] > max(view_rad.values()) - _SAME_VIEW_RAD]
    return min(
        wide, key=lambda topic: (topic.type != SCAN, last_part(topic.name) != "scan", -topic.message_count, topic.name)
    )


def _best_odometry(measured: Sequence[Topic]) -> Topic:
    return min(measured, key=lambda topic: (last_part(topic.name) != "odom", -topic.message_count, topic.name))


def _fleet_note(what: str, option: str, chosen: Topic, candidates: Sequence[Sequence[Topic]]) -> list[str]:
    others = ", ".join(sorted({topic.name for own in candidates for topic in own} - {chosen.name}))
    return [f"all bags: reads {what} from {chosen.name}, not from {others} ({option} chooses)"] * bool(others)


def _choose_camera(
    robot: BagRobot, wanted: str | None, has_images: Callable[[Topic], bool]
) -> tuple[Topic | None, Topic | None, list[str]]:
    """Topics of images and of their calibration, and notes about the choice."""
    images = _images(robot)
    cameras = [topic for topic in _candidates(robot, images, wanted, "--sensors camera-topic") if has_images(topic)]
    if not cameras:
        names = ", ".join(topic.name for topic in images)
        note = f"{robot.bag.path}: no images of {names} can be read, the camera is left out"
        return None, None, [note] * bool(images)
    info_of = {camera: _calibration_of(camera, robot) for camera in cameras}
    chosen = min(cameras, key=lambda topic: (info_of[topic] is None, *_camera_rank(topic)))
    if info_of[chosen] is None:
        note = f"{robot.bag.path}: no calibration ({CAMERA_INFO}) of {chosen.name}, the camera is left out"
        return None, None, [note]
    return chosen, info_of[chosen], _note(robot, "images", "--sensors camera-topic", chosen, cameras)


def _images(robot: BagRobot) -> list[Topic]:
    images = [topic for topic in _heard(robot) if topic.type in (COMPRESSED_IMAGE, IMAGE)]
    return [topic for topic in images if not is_depth(topic.name)]


def _camera_rank(topic: Topic) -> tuple[int, bool, str]:
    return -topic.message_count, topic.type != COMPRESSED_IMAGE, topic.name


def _calibration_of(camera: Topic, robot: BagRobot) -> Topic | None:
    """The calibration topic beside the images, or the only one if there is only one camera."""
    infos = [topic for topic in _heard(robot) if topic.type == CAMERA_INFO]
    only = infos[0] if len(infos) == len(_images(robot)) == 1 else None
    return calibration_beside(camera, robot) or only


def calibration_beside(camera: Topic, robot: BagRobot) -> Topic | None:
    """The calibration topic beside the images."""
    name = slashed(info_beside(camera.name))
    infos = (topic for topic in _heard(robot) if topic.type == CAMERA_INFO)
    return next((info for info in infos if slashed(info.name) == name), None)


def info_beside(images: str) -> str:
    """The topic of the calibration of the camera with these images."""
    return images.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"


def is_depth(name: str) -> bool:
    """Whether the images of a topic of this name are depth images."""
    return "depth" in name.lower()


def _candidates(robot: BagRobot, candidates: Sequence[Topic], wanted: str | None, option: str) -> list[Topic]:
    """All candidates, or the one that the user names."""
    if wanted is None:
        return list(candidates)
    chosen = [topic for topic in candidates if slashed(topic.name) == slashed(wanted)]
    if not chosen:
        there = [topic for topic in robot.topics if slashed(topic.name) == slashed(wanted)]
        what = f"has {there[0].message_count} messages of type {there[0].type}" if there else "is not there"
        raise SourceError(
            f"{robot.bag.path}: topic {wanted} {what}; {option} needs {_NEEDED[option]}; {_known(robot.topics)}"
        )
    return chosen[:1]


def _note(robot: BagRobot, what: str, option: str, chosen: Topic, candidates: Sequence[Topic]) -> list[str]:
    others = ", ".join(topic.name for topic in candidates if topic != chosen)
    note = f"{robot.bag.path}: reads {what} from {chosen.name}, not from {others} ({option} chooses)"
    return [note] * bool(others)


def _known(topics: Sequence[Topic]) -> str:
    if not topics:
        return "the bag has no topics"
    named = ", ".join(
        f"{one_line(topic.name)} ({one_line(topic.type)}, {topic.message_count})" for topic in topics[:_NAMED_AT_MOST]
    )
    more = f" and {len(topics) - _NAMED_AT_MOST} more" if len(topics) > _NAMED_AT_MOST else ""
    return f"the topics are {named}{more}"
