"""A ROS 1 network, by rospy from the packages of Debian.

Messages stay bytes: rospy carries them with the type and the checksum that ROS 1 asks for.
"""

import os
import sys
import threading
from collections.abc import Sequence
from functools import cache
from typing import Any, Final

from fcslam.errors import NetworkError
from fcslam.ros.network import TRIGGER, Act, Deliver, Endpoint, Publish, Quality
from fcslam.sources.bags.codec import TRIGGER_RESPONSE, MessageCodec, full_name, typestore

INSTALL: Final = "sudo apt-get install python3-rospy"
DEBIAN: Final = "/usr/lib/python3/dist-packages"
"""Where Debian installs rospy; a virtual environment does not look there."""
_BUFFER_BYTES = 2**24
_TRIGGER_CHECKSUM: Final = "937c9679a518e3a18d831e57125ea522"
_LONGEST_ANSWER_S: Final = 60.0
_ALWAYS: Final = Quality(reliable=True, latched=True)
"""TCP loses nothing, and nobody says whether a publisher latches."""


class Ros1Network:
    """A node of ROS 1. A process has at most one."""

    ros1 = True

    def __init__(self) -> None:
        """Register with the master.

        Raises:
            NetworkError: rospy is not installed, or there is no roscore.
        """
        if DEBIAN not in sys.path:
            sys.path.append(DEBIAN)
        try:
            import rosgraph
            import rospy
        except ImportError as error:
            raise NetworkError(f"ROS 1 needs rospy ({error}); install it: {INSTALL}") from error
        if not rosgraph.is_master_online():
            uri = os.environ.get("ROS_MASTER_URI", "http://localhost:11311")
            raise NetworkError(f"no roscore answers at {uri}; start roscore, or set ROS_MASTER_URI")
        rospy.init_node("fcslam", anonymous=True, disable_signals=True, disable_rosout=True)
        self._rospy = rospy
        self._master = rosgraph.Master(rospy.get_name())
        self._lock = threading.Lock()
        self._handles: list[Any] = []
        self._services: list[Any] = []

    def endpoints(self) -> Sequence[Endpoint]:
        """As in RosNetwork; nothing while the master is away."""
        try:
            with self._lock:
                publishers, subscribers, _ = self._master.getSystemState()
                kinds = dict(self._master.getTopicTypes())
        except Exception:  # any error of a socket or of XML-RPC
            return []
        own = self._rospy.get_name()
        return [
            Endpoint(topic, kinds[topic], publishes, _ALWAYS, node == own)
            for publishes, topics in ((True, publishers), (False, subscribers))
            for topic, nodes in topics
            for node in nodes
            if topic in kinds and kinds[topic] != "*"
        ]

    def subscribe(self, topic: str, kind: str, quality: Quality, deliver: Deliver) -> None:  # noqa: ARG002
        """As in RosNetwork; the publisher says the kind."""
        self._handles.append(
            self._rospy.Subscriber(
                topic,
                self._rospy.AnyMsg,
                lambda message: deliver(message._buff),
                queue_size=quality.depth,
                buff_size=_BUFFER_BYTES,
                tcp_nodelay=True,
            )
        )

    def publisher(self, topic: str, kind: str, quality: Quality) -> Publish:
        """As in RosNetwork."""
        raw = raw_class(kind)
        handle = self._rospy.Publisher(topic, raw, queue_size=quality.depth, latch=quality.latched, tcp_nodelay=True)
        self._handles.append(handle)
        return lambda payload: handle.publish(raw(payload))

    def serve(self, service: str, act: Act) -> None:
        """As in RosNetwork."""
        codec, response = MessageCodec(ros1=True), raw_class(TRIGGER_RESPONSE)

        def answered(_: object) -> Any:
            answer = act().result(_LONGEST_ANSWER_S)
            return response(codec.encode(codec.make(TRIGGER_RESPONSE, **answer._asdict()), TRIGGER_RESPONSE))

        self._services.append(self._rospy.Service(service, trigger_class(), answered))

    def close(self) -> None:
        """As in RosNetwork."""
        for service in self._services:
            service.shutdown()
        for handle in self._handles:
            handle.unregister()
        self._rospy.signal_shutdown("done")


@cache
def raw_class(kind: str) -> Any:
    """A class of messages that are kept as bytes, for publishers of rospy."""
    import genpy

    text, checksum = typestore(ros1=True).generate_msgdef(full_name(kind))

    class Raw(genpy.Message):  # type: ignore[misc]
        _type, _md5sum, _full_text, _has_header = kind, checksum, text, False
        __slots__ = ("payload",)
        _slot_types = ("uint8[]",)

        def __init__(self, payload: bytes = b"") -> None:
            self.payload = payload

        def serialize(self, buffer: Any) -> None:
            buffer.write(self.payload)

        def deserialize(self, payload: bytes) -> "Raw":
            self.payload = payload
            return self

    return Raw


@cache
def trigger_class() -> Any:
    """The class of services of the type ``TRIGGER``, for rospy."""

    class Trigger:
        _type, _md5sum = TRIGGER, _TRIGGER_CHECKSUM
        _request_class, _response_class = raw_class("std_msgs/Empty"), raw_class(TRIGGER_RESPONSE)

    return Trigger
