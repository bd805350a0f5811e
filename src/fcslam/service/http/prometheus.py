"""Metrics for Prometheus."""

import threading
from collections import defaultdict
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Gauge, generate_latest
from prometheus_client.core import CounterMetricFamily
from prometheus_client.registry import Collector

from fcslam.service.missions import OpenMission
from fcslam.wire.batches import read_batch
from fcslam.wire.ledger import Traffic
from fcslam.wire.packets import read_label

_AT_ONCE = 10_000
"""Packets counted in one query of the store."""


class ServiceMetrics:
    """Counts replies and refusals; reads everything else from the mission on request."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._answered = Counter(
            "fcslam_answer_bytes", "Bytes of packets sent to a robot", ("robot", "kind"), registry=self._registry
        )
        self._refused = Counter("fcslam_refusals", "Requests refused, by status", ("status",), registry=self._registry)
        self._packets = Gauge("fcslam_packets_stored", "Packets of the open mission", registry=self._registry)
        self._queue = Gauge("fcslam_packets_queued", "Packets without effect so far", registry=self._registry)
        self._waiting = Gauge("fcslam_packets_waiting", "Packets after one that is missing", registry=self._registry)
        self._starts = Gauge("fcslam_worker_starts", "Starts of the open mission's worker", registry=self._registry)
        self._alive = Gauge("fcslam_worker_up", "Whether the worker runs", registry=self._registry)
        self._uplink = _Uplink()
        self._registry.register(self._uplink)

    def answer(self, robot: str, batch: bytes) -> None:
        """Count the bytes of a reply."""
        for data in read_batch(batch):
            self._answered.labels(robot, read_label(data).kind).inc(len(data))

    def refuse(self, status: int) -> None:
        """Count a refused request."""
        self._refused.labels(str(status)).inc()

    def text(self, mission: OpenMission) -> bytes:
        """All metrics in the Prometheus text format."""
        ready = mission.intake.ready_count()
        self._packets.set(ready)
        self._queue.set(ready - mission.store.applied())
        self._waiting.set(mission.intake.waiting_count())
        self._starts.set(mission.worker.starts)
        self._alive.set(mission.worker.pid is not None)
        self._uplink.follow(mission)
        return generate_latest(self._registry)


class _Uplink(Collector):
    """Uplink by the missions' stores; it continues after a restart of the service."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counted: dict[str, int] = {}
        """Last arrival that is counted, by mission."""
        self._traffic: defaultdict[tuple[str, str, str, str], Traffic] = defaultdict(Traffic)
        """By mission, robot, kind and channel; without a kind are packets that could not be read."""

    def follow(self, mission: OpenMission) -> None:
        """Count the packets that arrived since the last call."""
        name = mission.folder.name
        with self._lock:
            while groups := mission.store.traffic_since(self._counted.get(name, 0), _AT_ONCE):
                for arrival, robot, kind, channel, traffic in groups:
                    self._traffic[name, robot, kind or "", channel or ""] += traffic
                    self._counted[name] = max(self._counted.get(name, 0), arrival)

    def collect(self) -> Iterator[CounterMetricFamily]:
        """For the registry."""
        labels = ("mission", "robot", "kind", "channel")
        packets = CounterMetricFamily("fcslam_packets", "Packets taken in", labels=labels)
        sizes = CounterMetricFamily("fcslam_bytes", "Bytes of packets taken in", labels=labels)
        with self._lock:
            for label, traffic in sorted(self._traffic.items()):
                packets.add_metric(label, traffic.count)
                sizes.add_metric(label, traffic.bytes)
        yield packets
        yield sizes
