"""Bags made by hand with rosbags, so that the reader is not tested against the project's own writer."""

import math
import shutil
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SCAN, ODOM, TF, TEXT = (
    f"{package}/msg/{name}"
    for package, name in (
        ("sensor_msgs", "LaserScan"),
        ("nav_msgs", "Odometry"),
        ("tf2_msgs", "TFMessage"),
        ("std_msgs", "String"),
    )
)
BEAMS = 8
ANGLE_MIN, INCREMENT = -math.pi / 2, math.pi / 8
LASER_POSE = (0.2, 0.05, 0.1)

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
ROS2 = get_typestore(Stores.ROS2_HUMBLE)


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
            _write(writer, messages, ROS1)
        return path
    sqlite = path.suffix == ".db3"
    plugin = rosbag2.StoragePlugin.SQLITE3 if sqlite else rosbag2.StoragePlugin.MCAP
    folder = path.with_name("storage") / path.stem if path.suffix else path
    writer = rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(rosbag2.CompressionMode[compression.upper()], rosbag2.CompressionFormat.ZSTD)
    with writer:
        _write(writer, messages, ROS2, chunk_bytes)
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


def _write(writer, messages, store, chunk_bytes=None):
    connections = {}
    for topic, kind, bag_time, fields in messages:
        if (topic, kind) not in connections:
            connections[topic, kind] = writer.add_connection(topic, kind, typestore=store)
        payload = payload_of(Said(topic, kind, bag_time, fields), store is ROS1)
        writer.write(connections[topic, kind], round(bag_time * 1e9), payload)
        if chunk_bytes is not None and writer.storage.chunk.bio.tell() > chunk_bytes:
            writer.storage.close_chunk()


def payload_of(message, is_ros1):
    """The bytes of a message."""
    store, serialize = (ROS1, ROS1.serialize_ros1) if is_ros1 else (ROS2, ROS2.serialize_cdr)
    payload = message.fields.get("payload")
    return serialize(_message(store, message.kind, message.fields), message.kind) if payload is None else payload


def _message(store, kind, fields):
    def make(name, *values, **named):
        return store.types[name.replace("/", "/msg/")](*values, **named)

    def header(frame):
        ns = round(fields["stamp"] * 1e9)
        stamp = make("builtin_interfaces/Time", ns // 10**9, ns % 10**9)
        return make("std_msgs/Header", **({"seq": 0} if store is ROS1 else {}), stamp=stamp, frame_id=frame)

    if kind == TEXT:
        return make("std_msgs/String", "hello")
    if kind == SCAN:
        ranges = np.array(fields["ranges"], dtype=np.float32)
        names = ("angle_min", "angle_increment", "range_min", "range_max")
        return make(
            "sensor_msgs/LaserScan",
            header=header(fields["frame"]),
            **{name: fields[name] for name in names},
            angle_max=fields.get("angle_max", fields["angle_min"] + (len(ranges) - 1) * fields["angle_increment"]),
            time_increment=fields.get("time_increment", 0.0),
            scan_time=0.0,
            ranges=ranges,
            intensities=np.zeros(0, np.float32),
        )
    rotation = make("geometry_msgs/Quaternion", *fields["rotation"])
    if kind == TF:
        transform = make("geometry_msgs/Transform", make("geometry_msgs/Vector3", *fields["at"]), rotation)
        stamped = make("geometry_msgs/TransformStamped", header(fields["parent"]), fields["child"], transform)
        return make("tf2_msgs/TFMessage", [stamped])
    pose = make("geometry_msgs/Pose", make("geometry_msgs/Point", *fields["at"]), rotation)
    still = make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
    return make(
        "nav_msgs/Odometry",
        header=header(fields["parent"]),
        child_frame_id=fields["child"],
        pose=make("geometry_msgs/PoseWithCovariance", pose, np.zeros(36)),
        twist=make("geometry_msgs/TwistWithCovariance", make("geometry_msgs/Twist", still, still), np.zeros(36)),
    )
