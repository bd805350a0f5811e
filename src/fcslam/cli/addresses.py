"""Addresses of live robots, as in ``ros2:/robot1``: the network and the robot's namespace."""

import os
import re
from collections.abc import Mapping
from typing import NamedTuple

from fcslam.errors import InputError
from fcslam.ros.network import RosNetwork

_ADDRESS = re.compile(r"(ros2|zenoh):(.*)", re.ASCII)
_NAMESPACE = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)*", re.ASCII)
_LARGEST_DOMAIN = 232


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


def open_network(address: RosAddress, environment: Mapping[str, str] = os.environ) -> RosNetwork:
    """Join the network of ``address``; the domain of ROS 2 is ROS_DOMAIN_ID, or 0."""
    text = environment.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _LARGEST_DOMAIN:
        raise InputError(f"{text!r} is not a ROS 2 domain; give a number from 0 to {_LARGEST_DOMAIN}")
    if address.network == "zenoh":
        from fcslam.ros.ros2_zenoh import ZenohNetwork

        return ZenohNetwork(int(text), environment)
    from fcslam.ros.ros2 import Ros2Network

    return Ros2Network(int(text), environment)
