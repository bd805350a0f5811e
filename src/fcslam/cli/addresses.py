"""Addresses of live robots, as in ``ros2:/robot1``: the network and the robot's namespace."""

import re
from typing import NamedTuple

from fcslam.errors import InputError

_ADDRESS = re.compile(r"(ros2|zenoh):(.*)", re.ASCII)
_NAMESPACE = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)*", re.ASCII)


class RosAddress(NamedTuple):
    """A robot on a ROS network."""

    network: str
    """``ros2`` (over DDS) or ``zenoh`` (ROS 2 over Zenoh)."""
    namespace: str
    """Empty, or with a leading slash and without one at the end."""

    @property
    def robot(self) -> str:
        """The name of the robot: the last part of its namespace."""
        return self.namespace.rpartition("/")[2] or "robot"


def is_address(text: str) -> bool:
    """Whether ``text`` is meant as the address of a live robot."""
    return _ADDRESS.fullmatch(text) is not None


def parse_address(text: str) -> RosAddress:
    """The address in ``text``."""
    match = _ADDRESS.fullmatch(text)
    assert match is not None  # as is_address says
    namespace = match[2].rstrip("/")
    if not _NAMESPACE.fullmatch(namespace):
        raise InputError(f"{text}: {match[2]!r} is not a namespace; give one as in {match[1]}:/robot1, or {match[1]}:/")
    return RosAddress(match[1], namespace)
