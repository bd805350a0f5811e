"""Metrics for Prometheus."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import cast

from prometheus_client import CollectorRegistry, Counter, Metric, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from fcslam.service.missions import OpenMission
from fcslam.wire.batches import read_batch
from fcslam.wire.ledger import Traffic
from fcslam.wire.packets import read_label


class ServiceMetrics:
    """Counts replies and refusals; reads everything else from the mission on request."""

    def __init__(self, wall_clock: Callable[[], float] = time.time) -> None:
        self._wall_clock = wall_clock
        self._registry = CollectorRegistry()
        self._answered = Counter(
            "fcslam_answer_bytes",
            "Bytes of packets and maps sent to a robot",
            ("robot", "kind"),
            registry=self._registry,
        )
        self._refused = Counter("fcslam_refusals", "Requests refused, by status", ("status",), registry=self._registry)
        self._lock = threading.Lock()
        self._counted: dict[str, int] = {}
        """Last arrival that is counted, by mission."""
        self._traffic: defaultdict[tuple[str, str, str, str], Traffic] = defaultdict(Traffic)
        """By mission, robot, kind and channel; without a kind are packets that could not be read."""

    def answer(self, robot: str, batch: bytes) -> None:
        """Count the bytes of a reply."""
        for data in read_batch(batch):
            self._answered.labels(robot, read_label(data).kind).inc(len(data))

    def answer_map(self, robot: str, size: int) -> None:
        """Count the bytes of tiles of the joint map."""
        self._answered.labels(robot, "joint_map").inc(size)

    def refuse(self, status: int) -> None:
        """Count a refused request."""
        self._refused.labels(str(status)).inc()

    def text(self, mission: OpenMission) -> bytes:
        """All metrics in the Prometheus text format."""
        families = *self._registry.collect(), *self._gauges(mission), *self._uplink(mission)
        return generate_latest(cast(Collector, SimpleNamespace(collect=lambda: families)))

    def _gauges(self, mission: OpenMission) -> Iterator[Metric]:
        ready, applied, worker = mission.intake.ready_count(), mission.store.applied(), mission.worker
        age_s = self._wall_clock() - mission.store.received_s(ready - applied) if ready > applied else 0.0
        for name, text, value in (
            ("packets_stored", "Packets of the open mission", ready),
            ("packets_queued", "Packets without effect so far", ready - applied),
            ("oldest_packet_age_seconds", "Time since the oldest packet arrived that has no effect so far", age_s),
            ("packets_waiting", "Packets after one that is missing", mission.intake.waiting_count()),
            ("worker_starts", "Starts of the open mission's worker", worker.starts),
            ("worker_up", "Whether the worker runs", float(worker.pid is not None)),
        ):
            yield GaugeMetricFamily(f"fcslam_{name}", text, value)

    def _uplink(self, mission: OpenMission) -> Iterator[Metric]:
        """The traffic of all missions by their stores, so it continues after a restart of the service."""
        labels = ("mission", "robot", "kind", "channel")
        packets = CounterMetricFamily("fcslam_packets", "Packets taken in", labels=labels)
        sizes = CounterMetricFamily("fcslam_bytes", "Bytes of packets taken in", labels=labels)
        name = mission.folder.name
        with self._lock:
            while groups := mission.store.traffic_since(self._counted.get(name, 0), 10_000):
                for arrival, robot, kind, channel, traffic in groups:
                    self._traffic[name, robot, kind or "", channel or ""] += traffic
                    self._counted[name] = max(self._counted.get(name, 0), arrival)
            for label, traffic in sorted(self._traffic.items()):
                packets.add_metric(label, traffic.count)
                sizes.add_metric(label, traffic.bytes)
        yield packets
        yield sizes
