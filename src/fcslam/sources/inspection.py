"""The contents of a recording of any format, and whether it can be mapped."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fcslam.errors import SourceError
from fcslam.geometry.beams import is_same_laser
from fcslam.records import CameraImage, CameraModel, CloudScan, LaserModel, LaserScan, Odometry
from fcslam.sources.bags.census import Messages
from fcslam.sources.bags.codec import SCANS
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.transforms import Link
from fcslam.sources.formats import bag_of, format_of, is_whole, open_source, robot_in
from fcslam.sources.source import Source


@dataclass(frozen=True, slots=True)
class TopicContents:
    """One topic of a bag."""

    name: str
    type: str
    messages: int
    rate_hz: float | None
    """Mean, by the times of recording; None with fewer than two messages or without time between them."""


@dataclass(frozen=True, slots=True)
class BagContents:
    """The topics and frames of a bag."""

    topics: tuple[TopicContents, ...]
    transforms: tuple[tuple[str, str], ...]
    """Parent and child of the transforms in tf, in the order in which they appear."""
    laser_frames: dict[str, tuple[str, ...]]


@dataclass(frozen=True, slots=True)
class LaserContents:
    """One laser of a recording."""

    model: LaserModel
    scans: int
    rate_hz: float | None
    """Usual, by the stamps; None without time between scans."""


@dataclass(frozen=True, slots=True)
class Inspection:
    """The contents of a recording."""

    path: Path
    format: str
    bag: BagContents | None
    """None for other formats."""
    robot: str = ""
    """Name of its robot; empty if it cannot be mapped or has several."""
    scans: int = 0
    duration_s: float = 0.0
    path_length_m: float = 0.0
    """By odometry."""
    lasers: tuple[LaserContents, ...] = ()
    odometry: int = 0
    """Readings of the odometry besides those that the scans carry."""
    odometry_from: str | None = None
    """Topic of a bag, or frames in tf; None: no odometry, or no bag."""
    camera: CameraModel | None = None
    images: int = 0
    faults: str = ""
    """Faults that are tolerated, one line; empty without faults."""
    notes: tuple[str, ...] = ()
    """Choices that were made, such as topics."""
    problem: str | None = None
    """Why it cannot be mapped, one line; None if it can."""
    robots: "tuple[Inspection, ...]" = ()
    """Each robot of a bag that has several, by the path that chooses it; the numbers above are then 0."""


def inspect(path: Path, options: BagOptions | None = None) -> Inspection:
    """Read a recording once or twice and say what is in it."""
    source = open_source(path, options)
    name = format_of(robot_in(path)[0])
    bag = bag_of(source)
    contents = None if bag is None else _bag_contents(bag.bag)
    try:
        robots = [] if bag is None else bag.robots()
        if len(robots) < 2:
            return _inspected(source, path, name, contents)
    except SourceError as error:
        return Inspection(path, name, contents, problem=str(error))
    found = []
    for robot in robots:
        place = Path(f"{path}:{robot.robot.name}")
        try:
            found.append(_inspected(robot, place, name, None))
        except SourceError as error:
            found.append(Inspection(place, name, None, problem=str(error)))
    return Inspection(path, name, contents, robots=tuple(found))


def _inspected(source: Source, path: Path, name: str, bag: BagContents | None) -> Inspection:
    survey = source.survey()
    stamps: dict[LaserModel, list[float]] = {} if is_whole(source) else {laser: [] for laser in survey.lasers}
    counts: Counter[type] = Counter()
    for record in source.records():
        counts[type(record)] += 1
        if isinstance(record, LaserScan):
            stamps[next(laser for laser in stamps if is_same_laser(record.laser, laser))].append(record.stamp)
    of_bag = bag_of(source)
    origin = None if of_bag is None else of_bag.plan.odometry
    return Inspection(
        path,
        name,
        bag,
        source.name,
        counts[LaserScan] + counts[CloudScan],
        survey.duration_s,
        survey.path_length_m,
        tuple(LaserContents(laser, len(own), _rate_hz(own)) for laser, own in stamps.items()),
        counts[Odometry],
        origin.name if origin else None,
        survey.camera,
        counts[CameraImage],
        str(source.faults) if source.faults else "",
        survey.notes,
    )


def _bag_contents(bag: Messages) -> BagContents:
    topics, edges, frames = [], dict[Link, None](), {}
    for topic, its in bag.census.items():
        first_ns, last_ns = its.span_ns
        rate_hz = (its.count - 1) * 1e9 / (last_ns - first_ns) if last_ns > first_ns else None
        topics.append(TopicContents(topic.name, topic.type, its.count, rate_hz))
        edges |= dict.fromkeys(its.links)
        if topic.type in SCANS:
            frames[topic.name] = tuple(its.frames)
    return BagContents(tuple(topics), tuple(edges), frames)


def _rate_hz(stamps: list[float]) -> float | None:
    steps_s = np.diff(np.sort(stamps))
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    return 1.0 / usual_s if usual_s > 0.0 else None
