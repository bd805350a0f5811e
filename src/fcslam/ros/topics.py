"""Which topics of a ROS network a robot reads, by the rules for bags."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from fcslam.errors import InputError, SourceError
from fcslam.ros.network import Endpoint, published
from fcslam.sources.bags.codec import CLOUDS, FIX, IMAGE, IMU, ODOMETRY, TRANSFORMS
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.topics import KnownTopics, calibration_beside, choose_topics

TF, TF_STATIC = "tf", "tf_static"


@dataclass(frozen=True, slots=True)
class SensorTopics:
    """The topics of one robot's sensors, by their full names."""

    kinds: Mapping[str, str]
    scans: tuple[str, ...]
    """One for each laser, 3D LiDAR or depth camera."""
    odometry: str | None
    """None: odometry comes from tf."""
    transforms: tuple[str, ...]
    camera: str | None = None
    camera_info: str | None = None
    fixes: str | None = None
    """Topic of satellite navigation."""
    notes: tuple[str, ...] = ()
    imu: str | None = None
    in_space: bool = False
    """Whether the scans are clouds of a 3D LiDAR that are read whole."""


def resolved(namespace: str, name: str) -> str:
    """The full name of a topic: one with a leading slash is full, another is in the namespace ("" or "/robot1")."""
    return name if name.startswith("/") else f"{namespace}/{name}"


def choose_sensor_topics(endpoints: Sequence[Endpoint], namespace: str, options: BagOptions) -> SensorTopics:
    """Choose the topics to read in ``namespace``, by the rules for bags; nobody knows the fields of view.

    Fixes of satellite navigation are those of the topic that is first by name, and so are the readings of an IMU, which
    are read if no topic has odometry, or in 3D, and clouds in 3D. The topics of tf are the namespace's own if there is
    one, else that of all robots.
    """
    known = published(endpoints)
    every = [Topic(name, kind, 1) for name, kind in known.items()]
    inside = [topic for topic in every if topic.name.startswith(f"{namespace}/")]
    own_or_common = {f"{namespace}/{name}": f"/{name}" for name in (TF, TF_STATIC)}  # they may appear later
    transforms = [Topic(own if own in known else common, TRANSFORMS, 1) for own, common in own_or_common.items()]
    scans = tuple(resolved(namespace, name) for name in options.scan_topics)
    clouds = sorted(topic.name for topic in (every if scans else inside) if options.in_3d and topic.type in CLOUDS)
    clouds = [name for name in clouds if name in (scans or clouds)][:1]
    wanted = replace(
        options,
        scan_topics=tuple(clouds) or scans,
        odom_topic=options.odom_topic
        if options.odom_topic in (None, NO_ODOMETRY)
        else resolved(namespace, options.odom_topic),
        camera_topic=options.camera_topic and resolved(namespace, options.camera_topic),
    )
    place = f" in {namespace or '/'}"
    try:
        chosen = choose_topics(
            KnownTopics(inside, tuple(transforms), "", every, place, "start the driver"),
            wanted,
            field_of_view_rad=lambda _: 0.0,
            jumps=lambda topic: "global" in topic.name or "map" in topic.name,
        )
    except SourceError as error:
        raise InputError(str(error)) from error
    odometry = next((topic for topic in chosen.odometry if topic.type == ODOMETRY), None)
    transforms = list(dict.fromkeys((*(topic for topic in chosen.odometry if topic != odometry), *transforms)))
    depth_infos = [calibration_beside(topic, every) for topic in chosen.scans if topic.type == IMAGE]
    fixes = min((topic for topic in inside if topic.type == FIX), default=None)
    imu = None if odometry and not clouds else min((topic for topic in inside if topic.type == IMU), default=None)
    read = (*chosen.scans, *depth_infos, *transforms, odometry, chosen.camera, chosen.camera_info, fixes, imu)
    return SensorTopics(
        {topic.name: topic.type for topic in read if topic is not None},
        _names(chosen.scans),
        odometry and odometry.name,
        _names(transforms),
        chosen.camera and chosen.camera.name,
        chosen.camera_info and chosen.camera_info.name,
        fixes and fixes.name,
        chosen.notes,
        imu and imu.name,
        bool(clouds),
    )


def _names(topics: Iterable[Topic]) -> tuple[str, ...]:
    return tuple(topic.name for topic in topics)
