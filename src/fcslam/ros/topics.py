"""Which topics of a ROS network a robot reads: those that the user names, or else those of the right types in its
namespace."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fcslam.errors import NetworkError
from fcslam.ros.network import Endpoint, named_topics, published
from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FIX,
    IMAGE,
    ODOMETRY,
    POINT_CLOUD,
    SCAN,
    SCANS,
    TRANSFORMS,
)
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.robots import is_truth
from fcslam.sources.bags.topics import info_beside, is_depth
from fcslam.sources.bags.transforms import last_part

TF, TF_STATIC = "tf", "tf_static"


@dataclass(frozen=True, slots=True)
class SensorTopics:
    """The topics of one robot's sensors, by their full names."""

    kinds: Mapping[str, str]
    """Type of every topic below."""
    scans: tuple[str, ...]
    """One for each laser, 3D LiDAR or depth camera."""
    odometry: str | None
    """None: odometry comes from tf."""
    transforms: tuple[str, ...]
    """All topics of tf."""
    camera: str | None = None
    camera_info: str | None = None
    fixes: str | None = None
    """Of satellite navigation."""
    notes: tuple[str, ...] = ()


def resolved(namespace: str, name: str) -> str:
    """The full name of a topic: one with a leading slash is full, another is in the namespace ("" or "/robot1")."""
    return name if name.startswith("/") else f"{namespace}/{name}"


def choose_sensor_topics(endpoints: Sequence[Endpoint], namespace: str, options: BagOptions) -> SensorTopics:
    """Choose the topics to read in ``namespace``, by these rules:

    - laser: laser scans before point clouds and these before depth images, one echo a beam, the name ``scan``, first by
      name;
    - odometry: the name ``odom``, first by name, else tf; ground truth only if the user names it;
    - camera: calibrated, compressed images, first by name;
    - fixes of satellite navigation: first by name;
    - tf: the namespace's own if there is one, else that of all robots.

    Raises:
        NetworkError: a required topic is missing, or a named topic is missing or of another type; the message lists the
            topics that are there.
    """
    known = published(endpoints)
    inside = [topic for topic in known if topic.startswith(f"{namespace}/")]
    notes: list[str] = []

    def named(name: str, option: str, *kinds: str) -> str:
        """The full name of a topic that must have one of these types."""
        topic = resolved(namespace, name)
        if known.get(topic) not in kinds:
            what = f"has the type {known[topic]}" if topic in known else "is not there"
            needed = f"{option} needs {' or '.join(kinds[:2])}"
            raise NetworkError(f"topic {topic} {what}; {needed}; {named_topics(endpoints)}")
        return topic

    scans = [named(name, "--sensors scan-topic", *SCANS, IMAGE) for name in options.scan_topics]
    if not scans:
        depths = [
            topic for topic in inside if known[topic] == IMAGE and is_depth(topic) and info_beside(topic) in known
        ]
        candidates = [*(topic for topic in inside if known[topic] in SCANS), *depths]
        if not candidates:
            raise NetworkError(
                f"no laser scans ({SCAN}), point clouds ({POINT_CLOUD}) or depth images in {namespace or '/'}; start "
                f"the driver; {named_topics(endpoints)}"
            )
        rank = [*SCANS, IMAGE].index
        scans = [min(candidates, key=lambda topic: (rank(known[topic]), last_part(topic) != "scan", topic))]
        notes += _note("laser scans", "--sensors scan-topic", scans[0], candidates)
    odometry = None if options.odom_topic in (None, NO_ODOMETRY) else resolved(namespace, options.odom_topic)
    if options.odom_topic == NO_ODOMETRY:
        notes.append("reads no odometry, as --sensors odom-topic=none says")
    elif odometry is None:
        candidates = [topic for topic in inside if known[topic] == ODOMETRY and not is_truth(topic)]
        odometry = min(candidates, key=lambda topic: (last_part(topic) != "odom", topic), default=None)
        notes += _note("odometry", "--sensors odom-topic", odometry, candidates)
    else:
        named(odometry, "--sensors odom-topic", ODOMETRY, TRANSFORMS)
    own_or_common = {f"{namespace}/{name}": f"/{name}" for name in (TF, TF_STATIC)}  # they may appear later
    transforms = tuple(own if own in known else common for own, common in own_or_common.items())
    if odometry is not None and known[odometry] != ODOMETRY:
        transforms, odometry = tuple(dict.fromkeys((odometry, *transforms))), None
    images = [topic for topic in inside if known[topic] in (COMPRESSED_IMAGE, IMAGE)]
    if options.camera_topic is not None:
        images = [named(options.camera_topic, "--sensors camera-topic", COMPRESSED_IMAGE, IMAGE)]
    infos = {topic: info_beside(topic) for topic in images if not is_depth(topic)}
    calibrated = [topic for topic, info in infos.items() if known.get(info) == CAMERA_INFO]
    camera = min(calibrated, key=lambda topic: (known[topic] != COMPRESSED_IMAGE, topic), default=None)
    if options.camera_topic is not None and camera is None:
        raise NetworkError(f"topic {images[0]} has no calibration: {info_beside(images[0])} is not there; publish it")
    info = None if camera is None else infos[camera]
    depth_infos = [info_beside(topic) for topic in scans if known[topic] == IMAGE]
    fixes = min((topic for topic in inside if known[topic] == FIX), default=None)
    read = (*scans, *depth_infos, *transforms, *filter(None, (odometry, camera, info, fixes)))
    kinds = {topic: known.get(topic, TRANSFORMS) for topic in read}
    return SensorTopics(kinds, tuple(scans), odometry, transforms, camera, info, fixes, tuple(notes))


def _note(what: str, option: str, chosen: str | None, candidates: Sequence[str]) -> list[str]:
    others = ", ".join(topic for topic in candidates if topic != chosen)
    return [f"reads {what} from {chosen}, not from {others} ({option} chooses)"] if others else []
