"""Names of message types on the wire of ROS 2, over DDS and over Zenoh."""

import re

_TYPE = re.compile(r"(\w+)::msg::dds_::(\w+)_")


def dds_type(kind: str, group: str = "msg") -> str:
    """The name of a type, as in ``sensor_msgs::msg::dds_::LaserScan_`` of ``sensor_msgs/LaserScan``."""
    package, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


def kind_of(dds_type: str) -> str | None:
    """The type of messages with this name; None: it is no such name."""
    match = _TYPE.fullmatch(dds_type)
    return f"{match[1]}/{match[2]}" if match else None
