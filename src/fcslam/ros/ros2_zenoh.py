"""A ROS 2 network over Zenoh, by eclipse-zenoh from PyPI, in the words of rmw_zenoh of Jazzy and later.

A topic is the key ``<domain>/<topic>/<type>/<hash of the type>``. An endpoint shows itself by a liveliness token, which
holds its topic and its quality of service. Each message has an attachment: its number, its time and its sender.
"""

import hashlib
import itertools
import os
import struct
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

from fcslam.errors import InputError
from fcslam.ros.network import MOST_ENDPOINTS, Deliver, Endpoint, Publish, Quality
from fcslam.ros.ros2 import dds_type, kind_of
from fcslam.sources.bags.codec import MessageCodec, full_name

INSTALL: Final = "pip install 'fcslam[zenoh]'"
ROUTER: Final = "tcp/localhost:7447"
"""Where rmw_zenoh expects a router."""
_SETTINGS: Final = {
    "mode": '"peer"',
    "connect/endpoints": f'["{ROUTER}"]',
    "listen/endpoints": '["tcp/localhost:0"]',
    "scouting/multicast/enabled": "false",
    "timestamping/enabled": "true",
}
"""These are also the values of rmw_zenoh's own session configuration."""
_ADMIN, _NODE = "@ros2_lv", 0
_RELIABLE, _BEST_EFFORT, _LATCHED = "1", "2", "1"
_HEARTBEAT_S = 0.5
"""Period at which a publisher of latched messages says which was its last one."""


class ZenohNetwork:
    """A session of Zenoh that takes part in one domain of ROS 2."""

    def __init__(self, domain: int, environment: Mapping[str, str] = os.environ) -> None:
        """Join ``domain`` at a router; the environment configures the session as it does that of rmw_zenoh."""
        try:
            import zenoh
        except ImportError as error:
            raise InputError(f"Zenoh needs eclipse-zenoh ({error}); install it: {INSTALL}") from error
        zenoh.init_log_from_env_or("off")
        config = session_config(environment)
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            raise InputError(f"no session of Zenoh can be opened ({_first_line(error)}); {_ADVICE}") from error
        if not list(session.info.routers_zid()) and not list(session.info.peers_zid()):
            session.close()
            raise InputError(f"no Zenoh router answers at {config.get_json('connect/endpoints')}; {_ADVICE}")
        self._zenoh, self._session, self._domain = zenoh, session, domain
        self._own = str(session.zid())
        self._codec = MessageCodec(ros1=False)
        self._numbers = itertools.count(_NODE + 1)
        self._lock = threading.Lock()
        self._known: dict[str, Endpoint] = {}
        self._declared: list[Any] = []
        """Tokens, publishers and subscribers to undeclare at the end."""
        self._declare(session.liveliness().declare_token(self._token(_NODE, "NN")))
        everything = f"{_ADMIN}/{domain}/**"
        self._declare(session.liveliness().declare_subscriber(everything, self._see, history=True))

    def endpoints(self) -> Sequence[Endpoint]:
        """As in RosNetwork."""
        with self._lock:
            return list(self._known.values())

    def subscribe(self, topic: str, kind: str, quality: Quality, deliver: Deliver) -> None:
        """As in RosNetwork; a type may have another hash than here, as in another release of ROS."""
        from zenoh import ext

        def take(sample: Any) -> None:
            if sample.kind == self._zenoh.SampleKind.PUT:
                sender = sample.attachment.to_bytes()[-16:].hex() if sample.attachment else ""
                deliver(sample.payload.to_bytes(), sender)

        key = f"{self._domain}/{topic.strip('/')}/{dds_type(kind)}/*"
        remote = self._zenoh.Locality.REMOTE
        if quality.latched:
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=quality.depth)
            self._declare(
                ext.declare_advanced_subscriber(
                    self._session,
                    key,
                    take,
                    allowed_origin=remote,
                    history=history,
                    recovery=ext.RecoveryConfig(heartbeat=True),
                    subscriber_detection=True,
                )
            )
        else:
            self._declare(self._session.declare_subscriber(key, take, allowed_origin=remote))
        self._show("MS", topic, kind, quality)

    def publisher(self, topic: str, kind: str, quality: Quality) -> Publish:
        """As in RosNetwork."""
        from zenoh import ext

        key = f"{self._domain}/{topic.strip('/')}/{dds_type(kind)}/{self._hash(kind)}"
        options: dict[str, Any] = {
            "congestion_control": self._zenoh.CongestionControl.DROP,
            "reliability": self._zenoh.Reliability.RELIABLE if quality.reliable else None,
        }
        if quality.latched:
            options |= {
                "cache": ext.CacheConfig(quality.depth),
                "publisher_detection": True,
                "sample_miss_detection": ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
            }
            publisher = ext.declare_advanced_publisher(self._session, key, **options)
        else:
            publisher = self._session.declare_publisher(key, **options)
        self._declare(publisher)
        sender = self._show("MP", topic, kind, quality)
        numbers = itertools.count(1)

        def publish(payload: bytes) -> None:
            try:
                publisher.put(payload, attachment=attachment(next(numbers), time.time_ns(), sender))
            except self._zenoh.ZError:  # the session is closed
                return

        return publish

    def close(self) -> None:
        """As in RosNetwork."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._session.close()

    def _declare(self, declared: Any) -> None:
        self._declared.append(declared)

    def _show(self, endpoint: str, topic: str, kind: str, quality: Quality) -> bytes:
        words = (topic.replace("/", "%"), dds_type(kind), self._hash(kind), quality_text(quality))
        token = "/".join((self._token(next(self._numbers), endpoint), *words))
        self._declare(self._session.liveliness().declare_token(token))
        return hashlib.blake2b(token.encode(), digest_size=16).digest()

    def _token(self, number: int, kind: str) -> str:
        """The beginning of each token of this process: ids, and the node's enclave, namespace and name."""
        return f"{_ADMIN}/{self._domain}/{self._own}/{_NODE}/{number}/{kind}/%/%/fcslam"

    def _hash(self, kind: str) -> str:
        return self._codec.store.hash_rihs01(full_name(kind))

    def _see(self, sample: Any) -> None:
        token = str(sample.key_expr)
        found = endpoint_of(token, self._own)
        with self._lock:
            if sample.kind == self._zenoh.SampleKind.DELETE:
                self._known.pop(token, None)
            elif found is not None and len(self._known) < MOST_ENDPOINTS:
                self._known[token] = found


_ADVICE: Final = (
    "start one (`ros2 run rmw_zenoh_cpp rmw_zenohd`), or name it: "
    """ZENOH_CONFIG_OVERRIDE='connect/endpoints=["tcp/ADDRESS:7447"]'"""
)


def session_config(environment: Mapping[str, str]) -> Any:
    """The configuration of a session: that of ZENOH_SESSION_CONFIG_URI or else rmw_zenoh's, changed by
    ZENOH_CONFIG_OVERRIDE (``KEY=VALUE;KEY=VALUE``).
    """
    import zenoh

    path = environment.get("ZENOH_SESSION_CONFIG_URI")
    try:
        config = zenoh.Config.from_file(path) if path else zenoh.Config()
    except zenoh.ZError as error:
        raise InputError(f"ZENOH_SESSION_CONFIG_URI: {path} cannot be used ({_first_line(error)})") from error
    changes = [] if path else list(_SETTINGS.items())
    for change in filter(None, environment.get("ZENOH_CONFIG_OVERRIDE", "").split(";")):
        key, equals, value = change.partition("=")
        if not equals:
            raise InputError(f"ZENOH_CONFIG_OVERRIDE has {change!r}; write KEY=VALUE, separated by semicolons")
        changes.append((key.strip(), value))
    for key, value in changes:
        try:
            config.insert_json5(key, value)
        except zenoh.ZError as error:
            raise InputError(f"ZENOH_CONFIG_OVERRIDE: {key}={value} cannot be used ({_first_line(error)})") from error
    return config


def attachment(number: int, time_ns: int, sender: bytes) -> bytes:
    """The attachment of rmw_zenoh to a message: its number, its time, and the sender's 16 bytes with their length."""
    return struct.pack("<qqB16s", number, time_ns, len(sender), sender)


def quality_text(quality: Quality) -> str:
    """A quality of service as in a token; what is left out is the default: reliable, volatile, keep last."""
    reliability, durability = "" if quality.reliable else _BEST_EFFORT, _LATCHED if quality.latched else ""
    return f"{reliability}:{durability}:,{quality.depth}:,:,:,,"


def endpoint_of(token: str, own: str) -> Endpoint | None:
    """The publisher or subscription of a token; None: it is of something else. ``own`` is the id of this session."""
    match token.split("/"):
        case [_, _, session, _, _, ("MP" | "MS") as end, _, _, _, topic, of_type, _, qos, *_]:
            kind = kind_of(of_type.replace("%", "/"))
            if kind is None:
                return None
            reliability, durability, *_ = f"{qos}:".split(":")
            quality = Quality(reliability in ("", _RELIABLE), durability == _LATCHED)
            return Endpoint(topic.replace("%", "/"), kind, end == "MP", quality, session == own)
    return None


def _first_line(error: Exception) -> str:
    return str(error).partition(" at /")[0].strip()
