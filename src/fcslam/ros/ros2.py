"""A ROS 2 network over DDS, by Eclipse Cyclone DDS from PyPI.

The types of messages are not declared: DDS carries them as bytes. Publishers and subscriptions of Fast DDS, the usual
middleware of ROS 2, match by name only if Cyclone ignores descriptions of types.
"""

import logging
import os
import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from fcslam.errors import InputError
from fcslam.ros.network import MOST_ENDPOINTS, Deliver, Endpoint, Publish, Quality

_log = logging.getLogger(__name__)

INSTALL: Final = "pip install 'fcslam[ros2]'"
_PARTICIPANTS: Final = 32
"""Most participants on one computer that are asked whether they are there, where there is no multicast."""
_LOOPBACK: Final = "127.0.0.1"
_MESSAGES_TAKEN = 64
_WAIT_NS = 200_000_000
_BLOCKING_NS = 100_000_000
_TOPIC = re.compile(r"rt(/.+)")
_TYPE = re.compile(r"(\w+)::msg::dds_::(\w+)_")
_PEER = re.compile(r"[\w.:-]+", re.ASCII)


class Ros2Network:
    """A participant of one DDS domain. A process has at most one for each domain."""

    def __init__(self, domain: int, environment: Mapping[str, str] = os.environ) -> None:
        """Join ``domain``."""
        try:
            from cyclonedds import builtin, core
            from cyclonedds import domain as domains
        except ImportError as error:
            raise InputError(f"ROS 2 needs cyclonedds ({error}); install it: {INSTALL}") from error
        try:
            self._domain = domains.Domain(domain, configuration(environment))
            self._participant = domains.DomainParticipant(domain)
        except core.DDSException as error:
            raise InputError(
                f"DDS domain {domain} cannot be joined ({error}); check the network and CYCLONEDDS_URI"
            ) from error
        self._alive = core.InstanceState.Alive
        self._any = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        self._waitset = core.WaitSet(self._participant)
        self._builtin = [
            (publishes, builtin.BuiltinDataReader(self._participant, topic))
            for publishes, topic in (
                (True, builtin.BuiltinTopicDcpsPublication),
                (False, builtin.BuiltinTopicDcpsSubscription),
            )
        ]
        self._lock = threading.Lock()
        self._known: dict[str, Endpoint] = {}
        self._readers: tuple[tuple[Any, Deliver], ...] = ()
        self._topics: dict[tuple[str, str], Any] = {}
        self._publishers: dict[int, str] = {}
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="dds", daemon=True)
        self._thread.start()

    def endpoints(self) -> Sequence[Endpoint]:
        """As in RosNetwork."""
        with self._lock:  # reads what changed only: in a large network, reading all takes tens of milliseconds
            for publishes, reader in self._builtin:
                for sample in reader.take(MOST_ENDPOINTS):
                    self._see(publishes, sample)
            return list(self._known.values())

    def _see(self, publishes: bool, sample: Any) -> None:
        topic, kind = _TOPIC.fullmatch(sample.topic_name or ""), kind_of(sample.type_name or "")
        is_alive = sample.sample_info.instance_state == self._alive
        if not is_alive or topic is None or kind is None:
            self._known.pop(str(sample.key), None)
        elif len(self._known) < MOST_ENDPOINTS:
            mine = sample.participant_key == self._participant.guid
            self._known[str(sample.key)] = Endpoint(topic[1], kind, publishes, _quality_of(sample.qos), mine)

    def subscribe(self, topic: str, kind: str, quality: Quality, deliver: Deliver) -> None:
        """As in RosNetwork."""
        from cyclonedds.core import Policy, ReadCondition
        from cyclonedds.sub import DataReader

        asked = _qos(quality, Policy.IgnoreLocal.Participant)
        reader = DataReader(self._participant, self._topic(topic, kind), asked)
        self._readers = (*self._readers, (reader, deliver))
        self._waitset.attach(ReadCondition(reader, self._any))

    def publisher(self, topic: str, kind: str, quality: Quality) -> Publish:
        """As in RosNetwork."""
        from cyclonedds.core import DDSException
        from cyclonedds.pub import DataWriter

        writer = DataWriter(self._participant, self._topic(topic, kind), _qos(quality))
        message = raw_type(dds_type(kind))

        def publish(payload: bytes) -> None:
            try:
                writer.write(message.of(payload))
            except DDSException:  # a slow subscriber; the next message follows
                return

        return publish

    def close(self) -> None:
        """As in RosNetwork."""
        self._closed.set()
        self._thread.join()

    def _topic(self, name: str, kind: str) -> Any:
        from cyclonedds.topic import Topic

        if (name, kind) not in self._topics:
            self._topics[name, kind] = Topic(self._participant, f"rt{name}", raw_type(dds_type(kind)))
        return self._topics[name, kind]

    def _publisher_of(self, reader: Any, sample: Any) -> str:
        """The id of a publisher in the whole network; that of this process if it has gone."""
        handle = sample.sample_info.publication_handle
        if handle not in self._publishers:
            found = reader.get_matched_publication_data(handle)
            if found is None:
                return str(handle)
            self._publishers[handle] = str(found.key)
        return self._publishers[handle]

    def _receive(self) -> None:
        while not self._closed.is_set():
            self._waitset.wait(_WAIT_NS)
            for reader, deliver in self._readers:
                for sample in reader.take(_MESSAGES_TAKEN):
                    payload = getattr(sample, "payload", None)  # None: the publisher has gone
                    if payload is not None:
                        try:
                            deliver(payload, self._publisher_of(reader, sample))
                        except Exception:  # this thread receives everything, so it must not end
                            _log.exception("a message cannot be taken; the next ones are")


@cache
def raw_type(dds_kind: str) -> Any:
    """A type of DDS messages that are kept as bytes."""
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import uint8

    @dataclass
    class _DdsMessage(IdlStruct, typename=dds_kind.replace("::", ".")):  # type: ignore[misc, call-arg]
        placeholder: uint8  # DDS has no empty types

        @classmethod
        def of(cls, payload: bytes) -> "_DdsMessage":
            message = cls(0)
            message.payload = payload
            return message

        def serialize(self, *_: Any, **__: Any) -> bytes:
            return bytes(self.payload)

        @classmethod
        def deserialize(cls, data: bytes, *_: Any, **__: Any) -> "_DdsMessage":
            return cls.of(data)

    return _DdsMessage


def configuration(environment: Mapping[str, str]) -> str:
    """Translate the variables that configure ROS 2 to a configuration of Cyclone DDS.

    ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS and ROS_LOCALHOST_ONLY mean what they mean in ROS 2. CYCLONEDDS_URI
    comes last and overrides them.
    """
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET").upper()
    local = reach in ("LOCALHOST", "OFF") or environment.get("ROS_LOCALHOST_ONLY") == "1"
    peers = [peer for peer in environment.get("ROS_STATIC_PEERS", "").split(";") if peer]
    for peer in peers:
        if not _PEER.fullmatch(peer):
            raise InputError(
                f"ROS_STATIC_PEERS has {peer!r}, which is not an address; separate addresses by semicolons"
            )
    # A node that is limited to this computer sends from the loopback interface, and Cyclone hears its own interfaces
    # only.
    interfaces = [f'address="{_LOOPBACK}"'] * (local and reach != "OFF")
    if interfaces and peers:
        interfaces.append('autodetermine="true"')
    listened = "".join(f"<NetworkInterface {interface}/>" for interface in interfaces)
    peers += [_LOOPBACK] * (reach != "OFF")
    addresses = "".join(f'<Peer Address="{peer}"/>' for peer in peers)
    own = (
        '<CycloneDDS><Domain Id="any">'
        f"<General><AllowMulticast>{'false' if local else 'default'}</AllowMulticast>"
        f"{f'<Interfaces>{listened}</Interfaces>' * bool(listened)}</General>"
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{_PARTICIPANTS}</MaxAutoParticipantIndex><Peers>{addresses}</Peers>"
        "<InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay></Discovery>"  # a robot may start, or return, any time
        "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
        "</Domain></CycloneDDS>"
    )
    return ",".join(filter(None, (own, environment.get("CYCLONEDDS_URI"))))


def _qos(quality: Quality, *others: Any) -> Any:
    from cyclonedds.core import Policy, Qos

    return Qos(
        Policy.Reliability.Reliable(_BLOCKING_NS) if quality.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if quality.latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(quality.depth),
        *others,
        *([Policy.DurabilityService(0, Policy.History.KeepLast(quality.depth), -1, -1, -1)] * quality.latched),
    )


def _quality_of(qos: Any) -> Quality:
    """The quality of service of somebody else; what a policy does not say is the weakest."""
    from cyclonedds.core import Policy

    reliable = qos[Policy.Reliability] not in (None, Policy.Reliability.BestEffort)
    latched = qos[Policy.Durability] not in (None, Policy.Durability.Volatile)
    return Quality(reliable, latched)


def dds_type(kind: str) -> str:
    """The name of a type, as in ``sensor_msgs::msg::dds_::LaserScan_`` of ``sensor_msgs/LaserScan``."""
    package, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def kind_of(dds_type: str) -> str | None:
    """The type of messages with this name; None: there is no such type."""
    match = _TYPE.fullmatch(dds_type)
    return f"{match[1]}/{match[2]}" if match else None
