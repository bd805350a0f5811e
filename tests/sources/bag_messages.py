"""Bags written by rosbags, so that the reader is not tested against the project's own writer."""

import math
import shutil
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from fcslam.sources.bags.codec import ODOMETRY as ODOM
from fcslam.sources.bags.codec import SCAN, MessageCodec, full_name
from fcslam.sources.bags.codec import TRANSFORMS as TF

TEXT = "std_msgs/String"
BEAMS = 8
ANGLE_MIN, INCREMENT = -math.pi / 2, math.pi / 8
LASER_POSE = (0.2, 0.05, 0.1)

CODECS = {is_ros1: MessageCodec(is_ros1) for is_ros1 in (False, True)}
STORES = {False: get_typestore(Stores.ROS2_HUMBLE), True: CODECS[True].store}
"""Definitions of messages, by whether they are those of ROS 1."""


class Said(NamedTuple):
    """A message to write."""

    topic: str
    kind: str
    bag_time: float
    fields: dict[str, Any]


def quaternion(yaw=0.0, roll=0.0, pitch=0.0):
    """(x, y, z, w) of a turn about x, then y, then z."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def scan(stamp, ranges=(1.0,) * BEAMS, topic="/scan", bag_time=None, **fields):
    fields = {
        "frame": "laser",
        "angle_min": ANGLE_MIN,
        "angle_increment": INCREMENT,
        "range_min": 0.1,
        "range_max": 20.0,
        "ranges": ranges,
        "stamp": stamp,
        **fields,
    }
    return Said(topic, SCAN, stamp if bag_time is None else bag_time, fields)


def odom(stamp, pose, topic="/odom", bag_time=None, child="base_link", rotation=None, parent="odom"):
    x, y, theta = pose
    rotation = rotation or quaternion(theta)
    fields = {"stamp": stamp, "at": (x, y, 0.0), "rotation": rotation, "child": child, "parent": parent}
    return Said(topic, ODOM, stamp if bag_time is None else bag_time, fields)


def tf(stamp, parent, child, at=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0), topic="/tf", bag_time=None):
    fields = {"stamp": stamp, "parent": parent, "child": child, "at": at, "rotation": rotation}
    return Said(topic, TF, stamp if bag_time is None else bag_time, fields)


def text(stamp, topic="/chatter"):
    return Said(topic, TEXT, stamp, {})


def mounted(stamp=100.0):
    x, y, theta = LASER_POSE
    return tf(stamp, "base_link", "laser", (x, y, 0.3), quaternion(theta), topic="/tf_static")


def pose_at(time):
    """A robot on its way along a curve."""
    return (0.5 * time, math.sin(0.25 * time), 0.15 * time)


def drive(scans=40, start=100.0):
    """A healthy bag: odometry at 10 Hz, scans at 5 Hz between its readings, seen 20 ms later."""
    said = [mounted(start), odom(start - 0.1, pose_at(-0.1))]
    for step in range(scans):
        at = 0.2 * step
        ranges = tuple(round(1.0 + 0.01 * step + 0.1 * beam, 3) for beam in range(BEAMS))
        said += [odom(start + at, pose_at(at)), odom(start + at + 0.1, pose_at(at + 0.1))]
        said.append(scan(start + at + 0.05, ranges, bag_time=start + at + 0.07))
    return [*said, odom(start + 0.2 * scans, pose_at(0.2 * scans))]


def without(said, topic):
    return [message for message in said if message.topic != topic]


def readings_in_tf(said):
    """The same odometry in tf."""
    for one in said:
        if one.topic == "/odom":
            yield tf(one.fields["stamp"], "odom", "base_link", one.fields["at"], one.fields["rotation"])


def save(path: Path, said: Iterable[Said], compression: str = "", chunk_bytes: int | None = None) -> Path:
    """Write messages in the order of their bag times; the path's suffix says which kind of bag."""
    messages = sorted(said, key=lambda message: message.bag_time)
    if path.suffix == ".bag":
        writer = rosbag1.Writer(path)
        if compression:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        if chunk_bytes is not None:
            writer.chunk_threshold = chunk_bytes
        with writer:
            _write(writer, messages, is_ros1=True)
        return path
    sqlite = path.suffix == ".db3"
    plugin = rosbag2.StoragePlugin.SQLITE3 if sqlite else rosbag2.StoragePlugin.MCAP
    folder = path.with_name("storage") / path.stem if path.suffix else path
    writer = rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(rosbag2.CompressionMode[compression.upper()], rosbag2.CompressionFormat.ZSTD)
    with writer:
        _write(writer, messages, chunk_bytes=chunk_bytes)
    if not path.suffix:
        return path
    (folder / path.name).rename(path)
    shutil.rmtree(folder.parent)
    return path


def mcap_places(content):
    """Opcode of each record of an MCAP file, and where its content begins and ends."""
    at = 8
    while at < len(content) - 8:
        opcode, size = struct.unpack_from("<BQ", content, at)
        yield opcode, at + 9, (at := at + 9 + size)


def mcap_file(path, records):
    """A file of these records, opcode and content each."""
    body = b"".join(struct.pack("<BQ", opcode, len(content)) + content for opcode, content in records)
    path.write_bytes(b"\x89MCAP0\r\n" + body + b"\x89MCAP0\r\n")
    return path


def counted(size, text):
    return struct.pack(size, len(text)) + text


HEADER = (0x01, counted("<I", b"ros2") + counted("<I", b"test"))
END = [(0x0F, bytes(4)), (0x02, bytes(20))]


def _write(writer, messages, is_ros1=False, chunk_bytes=None):
    connections = {}
    for message in messages:
        named = message.topic, message.kind
        if named not in connections:
            connections[named] = writer.add_connection(named[0], full_name(named[1]), typestore=STORES[is_ros1])
        writer.write(connections[named], round(message.bag_time * 1e9), payload_of(message, is_ros1))
        if chunk_bytes is not None and writer.storage.chunk.bio.tell() > chunk_bytes:
            writer.storage.close_chunk()


def payload_of(message, is_ros1=False):
    """The bytes of a message."""
    payload = message.fields.get("payload")
    return CODECS[is_ros1].encode(message_of(message, is_ros1), message.kind) if payload is None else payload


def message_of(message, is_ros1=False):
    """A message as an object of rosbags."""
    kind, fields, codec = message.kind, message.fields, CODECS[is_ros1]
    make, vector = codec.make, codec.vector
    if kind == TEXT:
        return make(TEXT, data="hello")
    at = header(fields["stamp"], fields["frame" if kind == SCAN else "parent"], is_ros1)
    if kind == SCAN:
        ranges = np.array(fields["ranges"], dtype=np.float32)
        angle_max = fields["angle_min"] + (len(ranges) - 1) * fields["angle_increment"]
        names = {"angle_min", "angle_max", "angle_increment", "time_increment", "range_min", "range_max"}
        stated = {name: value for name, value in fields.items() if name in names}
        return make(SCAN, header=at, ranges=ranges, **{"angle_max": angle_max, **stated})
    rotation = make("geometry_msgs/Quaternion", **dict(zip("xyzw", fields["rotation"], strict=True)))
    if kind == TF:
        transform = make("geometry_msgs/Transform", translation=vector("Vector3", *fields["at"]), rotation=rotation)
        named = {"header": at, "child_frame_id": fields["child"]}
        return make(TF, transforms=[make("geometry_msgs/TransformStamped", **named, transform=transform)])
    pose = make("geometry_msgs/Pose", position=vector("Point", *fields["at"]), orientation=rotation)
    posed = make("geometry_msgs/PoseWithCovariance", pose=pose)
    return make(ODOM, header=at, child_frame_id=fields["child"], pose=posed)


def header(stamp, frame, is_ros1=False):
    return CODECS[is_ros1].header(round(stamp * 1e9), frame)
