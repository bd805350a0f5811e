"""Metrics for Prometheus."""

import threading
import time
from collections import defaultdict, deque
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

_AT_ONCE = 10_000
"""Packets counted in one query of the store."""
_MOST_NOTED = 100_000
"""Most arrivals whose times are kept; later ones are not noted while these wait."""


class ServiceMetrics:
    """Counts replies and refusals; reads everything else from the mission on request."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._registry = CollectorRegistry()
        self._answered = Counter(
            "fcslam_answer_bytes",
            "Bytes of packets and maps sent to a robot",
            ("robot", "kind"),
            registry=self._registry,
        )
        self._refused = Counter("fcslam_refusals", "Requests refused, by status", ("status",), registry=self._registry)
        self._uplink = _Uplink()
        self._arrivals = _Arrivals()

    def answer(self, robot: str, batch: bytes) -> None:
        """Count the bytes of a reply."""
        for data in read_batch(batch):
            self._answered.labels(robot, read_label(data).kind).inc(len(data))

    def answer_map(self, robot: str, size: int) -> None:
        """Count the bytes of tiles of the joint map."""
        self._answered.labels(robot, "joint_map").inc(size)

    def arrived(self, mission: OpenMission) -> None:
        """Note when packets of a mission arrived."""
        self._arrivals.add(mission.folder.name, mission.intake.ready_count(), self._clock())

    def refuse(self, status: int) -> None:
        """Count a refused request."""
        self._refused.labels(str(status)).inc()

    def text(self, mission: OpenMission) -> bytes:
        """All metrics in the Prometheus text format."""
        families = *self._registry.collect(), *self._gauges(mission), *self._uplink.families(mission), *_stages(mission)
        return generate_latest(cast(Collector, SimpleNamespace(collect=lambda: families)))

    def _gauges(self, mission: OpenMission) -> Iterator[Metric]:
        ready, applied, worker = mission.intake.ready_count(), mission.store.applied(), mission.worker
        self.arrived(mission)  # packets from before this start, if nobody noted them
        age_s = self._arrivals.age_s(applied, self._clock())
        for name, text, value in (
            ("packets_stored", "Packets of the open mission", ready),
            ("packets_queued", "Packets without effect so far", ready - applied),
            ("oldest_packet_age_seconds", "Time since the oldest packet arrived that has no effect so far", age_s),
            ("packets_waiting", "Packets after one that is missing", mission.intake.waiting_count()),
            ("worker_starts", "Starts of the open mission's worker", worker.starts),
            ("worker_up", "Whether the worker runs", float(worker.pid is not None)),
        ):
            yield GaugeMetricFamily(f"fcslam_{name}", text, value)


class _Arrivals:
    """When packets arrived that have no effect yet."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._mission = ""
        self._noted: deque[tuple[int, float]] = deque()
        """How many packets there were from when on; the oldest first."""

    def add(self, mission: str, packets: int, now_s: float) -> None:
        """Note how many packets a mission has now."""
        with self._lock:
            if mission != self._mission:
                self._mission = mission
                self._noted.clear()
            is_new = not self._noted or packets > self._noted[-1][0]
            if is_new and len(self._noted) < _MOST_NOTED:
                self._noted.append((packets, now_s))

    def age_s(self, applied: int, now_s: float) -> float:
        """Age of the oldest packet after the first ``applied`` ones; 0 if all are applied."""
        with self._lock:
            while self._noted and self._noted[0][0] <= applied:
                self._noted.popleft()
            return now_s - self._noted[0][1] if self._noted else 0.0


def _stages(mission: OpenMission) -> Iterator[Metric]:
    """Runs of the present worker's stages and the time they took; they begin again with a new worker."""
    runs = CounterMetricFamily("fcslam_stage_runs", "Runs of a stage of the worker", labels=("stage",))
    seconds = CounterMetricFamily("fcslam_stage_seconds", "Time of a stage of the worker", labels=("stage",))
    for stage, total in sorted(mission.worker.stages.items()):
        runs.add_metric((stage,), total.runs)
        seconds.add_metric((stage,), total.seconds)
    yield runs
    yield seconds


class _Uplink:
    """Uplink by the missions' stores; it continues after a restart of the service."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counted: dict[str, int] = {}
        """Last arrival that is counted, by mission."""
        self._traffic: defaultdict[tuple[str, str, str, str], Traffic] = defaultdict(Traffic)
        """By mission, robot, kind and channel; without a kind are packets that could not be read."""

    def families(self, mission: OpenMission) -> Iterator[Metric]:
        """The traffic of all missions, with the packets of this one that arrived since the last call."""
        labels = ("mission", "robot", "kind", "channel")
        packets = CounterMetricFamily("fcslam_packets", "Packets taken in", labels=labels)
        sizes = CounterMetricFamily("fcslam_bytes", "Bytes of packets taken in", labels=labels)
        name = mission.folder.name
        with self._lock:
            while groups := mission.store.traffic_since(self._counted.get(name, 0), _AT_ONCE):
                for arrival, robot, kind, channel, traffic in groups:
                    self._traffic[name, robot, kind or "", channel or ""] += traffic
                    self._counted[name] = max(self._counted.get(name, 0), arrival)
            for label, traffic in sorted(self._traffic.items()):
                packets.add_metric(label, traffic.count)
                sizes.add_metric(label, traffic.bytes)
        yield packets
        yield sizes
