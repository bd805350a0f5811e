"""Messages of ROS 1 and ROS 2 as bytes and as objects of rosbags; they need no ROS."""

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from fcslam.records import Transform

if TYPE_CHECKING:
    from rosbags.interfaces import Nodetype
    from rosbags.typesys.store import Typestore

SCAN, ODOMETRY, TRANSFORMS = "sensor_msgs/LaserScan", "nav_msgs/Odometry", "tf2_msgs/TFMessage"
MULTI_ECHO_SCAN = "sensor_msgs/MultiEchoLaserScan"
LASER_SCANS = SCAN, MULTI_ECHO_SCAN
POINT_CLOUD = "sensor_msgs/PointCloud2"
LIVOX_CLOUDS = "livox_ros_driver/CustomMsg", "livox_ros_driver2/CustomMsg"
CLOUDS = POINT_CLOUD, *LIVOX_CLOUDS
SCANS = *LASER_SCANS, *CLOUDS
COMPRESSED_IMAGE, IMAGE = "sensor_msgs/CompressedImage", "sensor_msgs/Image"
CAMERA_INFO = "sensor_msgs/CameraInfo"
FIX = "sensor_msgs/NavSatFix"
IMU = "sensor_msgs/Imu"
"""Message types that are read, as ROS 1 writes them."""
OLD_TRANSFORMS = "tf/tfMessage"
"""The name of TRANSFORMS in early ROS 1."""
TRANSFORM_KINDS = TRANSFORMS, OLD_TRANSFORMS

NANOSECONDS = 10**9
_LIVOX_FIELDS = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
{package}/CustomPoint[] points
================================================================================
MSG: {package}/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line"""


class MessageCodec:
    """Decodes, makes and encodes the messages of one version of ROS.

    Kinds of messages are named as in ROS 1, without ``msg/``.
    """

    def __init__(self, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = typestore(ros1)

    def decode(self, payload: bytes, kind: str) -> Any:
        """Decode a message to an object of rosbags."""
        name = full_name(kind)
        try:
            if self.ros1:
                return self.store.deserialize_ros1(payload, name)
            return self.store.deserialize_cdr(payload, name)
        except Exception as error:  # generated code raises any exception on invalid bytes
            raise ValueError("the bytes are not a message of this type") from error

    def encode(self, message: Any, kind: str) -> bytes:
        """The message as bytes."""
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        return bytes(serialize(message, full_name(kind)))

    def make(self, kind: str, **fields: Any) -> Any:
        """A message of this kind; what ``fields`` do not give is zero or empty."""
        name = full_name(kind)
        _, defined = self.store.fielddefs[name]
        zeros = {field: self._zero(*of) for field, of in defined if field not in fields}
        return self.store.types[name](**zeros, **fields)

    def type_of(self, kind: str) -> Any:
        """The class of messages of this kind, with the constants of its definition."""
        return self.store.types[full_name(kind)]

    def _zero(self, node: "Nodetype", of: Any) -> Any:
        from rosbags.interfaces import Nodetype

        if node == Nodetype.NAME:
            return self.make(of.replace("/msg/", "/"))
        inner, count = of
        if node == Nodetype.BASE:
            return "" if inner == "string" else np.zeros((), inner).item()
        is_number = inner[0] == Nodetype.BASE and inner[1][0] != "string"
        return np.zeros(count, inner[1][0]) if is_number else [self._zero(*inner) for _ in range(count)]

    def time(self, stamp_ns: int) -> Any:
        """A time stamp."""
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
        return self.make("builtin_interfaces/Time", sec=seconds, nanosec=nanoseconds)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """A header."""
        return self.make("std_msgs/Header", stamp=self.time(stamp_ns), frame_id=frame)

    def vector(self, kind: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
        """A message of geometry_msgs with three coordinates."""
        return self.make(f"geometry_msgs/{kind}", x=x, y=y, z=z)

    def rotation(self, transform: Transform) -> Any:
        """The rotation of a transform."""
        x, y, z, w = transform.rotation
        return self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, transform: Transform) -> Any:
        """A transform as a pose."""
        position = self.vector("Point", *transform.translation_m)
        return self.make("geometry_msgs/Pose", position=position, orientation=self.rotation(transform))

    def transforms(self, header: Any, child: str, T_parent_child: Transform) -> Any:
        """A message of tf with one transform; ``header`` names the parent frame."""
        translation = self.vector("Vector3", *T_parent_child.translation_m)
        transform = self.make(
            "geometry_msgs/Transform", translation=translation, rotation=self.rotation(T_parent_child)
        )
        stamped = self.make("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=transform)
        return self.make(TRANSFORMS, transforms=[stamped])


def full_name(kind: str) -> str:
    """The name of a kind of messages in ROS 2, and in rosbags; that of OLD_TRANSFORMS is that of TRANSFORMS."""
    return (TRANSFORMS if kind == OLD_TRANSFORMS else kind).replace("/", "/msg/")


@cache
def typestore(ros1: bool) -> "Typestore":
    """Message types that are read and written, of ROS 1 or ROS 2."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", full_name(TRANSFORMS)))
    for kind in LIVOX_CLOUDS:
        store.register(get_types_from_msg(_LIVOX_FIELDS.format(package=kind.partition("/")[0]), full_name(kind)))
    return store
