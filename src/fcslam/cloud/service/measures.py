"""Numbers for Prometheus."""

from collections.abc import Iterable

from prometheus_client import CollectorRegistry, Counter, Gauge, generate_latest

from fcslam.cloud.missions import OpenMission
from fcslam.cloud.store import StoredPacket
from fcslam.wire.batches import read_batch
from fcslam.wire.packets import read_label


class Measures:
    """Counts what comes in; asks the mission for the rest when it is asked itself."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        labels = ("robot", "kind", "channel")
        self._packets = Counter("fcslam_packets", "Packets taken in", labels, registry=self._registry)
        self._bytes = Counter("fcslam_bytes", "Bytes of packets taken in", labels, registry=self._registry)
        self._answered = Counter(
            "fcslam_answer_bytes", "Bytes of packets sent to a robot", ("robot", "kind"), registry=self._registry
        )
        self._refused = Counter("fcslam_refusals", "Requests refused, by status", ("status",), registry=self._registry)
        self._turns = Gauge("fcslam_packets_stored", "Packets of the open mission", registry=self._registry)
        self._queue = Gauge("fcslam_packets_queued", "Packets without effect so far", registry=self._registry)
        self._waiting = Gauge("fcslam_packets_waiting", "Packets after one that is missing", registry=self._registry)
        self._starts = Gauge("fcslam_worker_starts", "Starts of the open mission's worker", registry=self._registry)
        self._alive = Gauge("fcslam_worker_up", "Whether the worker runs", registry=self._registry)

    def count(self, packets: Iterable[StoredPacket], answer: bytes, robot: str) -> None:
        """A batch was taken in and answered."""
        for packet in packets:
            labels = (packet.robot, packet.kind or "", packet.channel or "")
            self._packets.labels(*labels).inc()
            self._bytes.labels(*labels).inc(len(packet.data))
        for data in read_batch(answer):
            self._answered.labels(robot, read_label(data).kind).inc(len(data))

    def refuse(self, status: int) -> None:
        """A request was refused."""
        self._refused.labels(str(status)).inc()

    def text(self, mission: OpenMission) -> bytes:
        """All measures in Prometheus's text format."""
        turns = mission.store.turn_count()
        self._turns.set(turns)
        self._queue.set(turns - mission.store.applied())
        self._waiting.set(mission.store.waiting_count())
        self._starts.set(mission.worker.starts)
        self._alive.set(mission.worker.pid is not None)
        return generate_latest(self._registry)
