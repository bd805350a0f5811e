"""Batches of packets from robots: checked, stored, acknowledged. No network here, and no waiting for the fleet."""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from fcslam.cloud.sessions import check_robot
from fcslam.errors import FcslamError, PacketError
from fcslam.records import Channel, DetectorFile, Place
from fcslam.service.mission_store import MissionStore, StoredPacket
from fcslam.wire.batches import read_batch, write_batch
from fcslam.wire.messages import UPLINK, Acknowledgement, Body, DetectorUpdate, Hello, Packet, PacketKind
from fcslam.wire.packets import decode, encode, read_label, read_number

LEASE_S = 30.0
"""So long after an agent's last request its robot is its own."""
LONGEST_QUEUE = 50_000
"""Packets that have a turn and have not taken effect: more are not taken in before some have."""
MOST_EARLY = 20_000
"""Packets of one robot that wait for one before them, in all its sessions."""
FURTHEST_AHEAD = 20_000
"""Numbers after the first missing packet of a session: what is further ahead has to wait for it."""
RETRY_AFTER_S = 2


class BusyError(FcslamError):
    """Nothing is wrong, but it has to wait."""


class LeaseError(FcslamError):
    """Another agent speaks for this robot."""


class RefusedPacketError(FcslamError):
    """One packet of a batch is refused for good; those before it are stored."""

    def __init__(self, message: str, index: int) -> None:
        super().__init__(message)
        self.index = index


@dataclass(frozen=True, slots=True)
class Answer:
    """What goes back to a robot."""

    batch: bytes
    """Acknowledgements and, if they are news, a correction and detectors."""
    refused: int
    """How many of the robot's packets count for nothing, those that the worker refused later included."""


class Intake:
    """Takes batches for one mission. Any thread may call."""

    def __init__(
        self,
        store: MissionStore,
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
        announced: Callable[[], Mapping[Channel, DetectorFile]] = dict,
    ) -> None:
        """``announced``: detectors that robots are to take."""
        self._store, self._clock, self._wall_clock, self._announced = store, clock, wall_clock, announced
        self._lock = threading.Lock()
        self._leases: dict[str, tuple[str, float]] = {}
        """Agent of each robot, and when it was heard last."""

    def take(self, robot: str, agent: str, batch: bytes, known_correction: int) -> Answer:
        """Store a robot's packets; what comes back acknowledges all that is stored without a gap.

        Raises:
            PacketError: the batch cannot be taken apart; nothing is stored.
            RefusedPacketError: a packet of it is refused.
            PacketConflictError: a packet has the number of another one.
            LeaseError: another agent speaks for the robot.
            BusyError: it has to be sent again later.
            StoreError: the disk is full; nothing is stored.
        """
        self._lease(robot, agent)
        check_robot(robot)
        packets, refusal = _checked(robot, read_batch(batch))
        self._make_room(robot, packets)
        self._store.put(packets, self._wall_clock())
        if refusal:
            raise refusal
        epochs = sorted({packet.epoch for packet in packets}) or [s.epoch for s in self._store.sessions(robot)[-1:]]
        answer = self._answer(robot, epochs, known_correction)
        return Answer(answer, self._store.refusal_count(robot))

    def last_heard_s(self, robot: str) -> float | None:
        """Seconds since the robot's last batch; None: never since the service started."""
        lease = self._leases.get(robot)
        return None if lease is None else self._clock() - lease[1]

    def _lease(self, robot: str, agent: str) -> None:
        now = self._clock()
        with self._lock:
            holder, heard = self._leases.get(robot, (agent, now))
            if holder != agent and now < heard + LEASE_S:
                raise LeaseError(
                    f"{robot}: another agent speaks for this robot; stop one of the two or name it differently, "
                    f"or wait {heard + LEASE_S - now:.0f} s if it is gone"
                )
            self._leases[robot] = agent, now

    def _make_room(self, robot: str, packets: Sequence[StoredPacket]) -> None:
        queue = self._store.turn_count() - self._store.applied()
        if queue > LONGEST_QUEUE:
            raise BusyError(f"{queue} packets have not taken effect yet; send these again later")
        expected = {session.epoch: session.next for session in self._store.sessions(robot)}
        for packet in packets:
            first = expected.get(packet.epoch, 0)
            if packet.sequence > first + FURTHEST_AHEAD:
                raise BusyError(f"{robot}: packet {packet.sequence} is far ahead; send packet {first} first")
        early = _early(packets, expected)
        if early and self._store.waiting_count(robot) + len(early) > MOST_EARLY:
            epoch = early[0].epoch
            raise BusyError(
                f"{robot}: over {MOST_EARLY} packets wait for one before them; "
                f"send packet {expected.get(epoch, 0)} of epoch {epoch} first"
            )

    def _answer(self, robot: str, epochs: Sequence[int], known_correction: int) -> bytes:
        told: list[tuple[int, float, Body]] = []
        for epoch in epochs:
            expected = self._store.next_sequence(robot, epoch)
            if expected > 0:
                told.append((epoch, 0.0, Acknowledgement(robot, epoch, expected - 1)))
        news = self._store.correction(robot, epochs[-1]) if epochs else None
        if news and news.correction.version > known_correction:
            told.append((news.epoch, news.time, news.correction))
        if epochs:
            told += [
                (epochs[-1], 0.0, DetectorUpdate(robot, file)) for file in self._newer_detectors(robot, epochs[-1])
            ]
        return write_batch(
            encode(Packet(robot, epoch, number, time_s, body)) for number, (epoch, time_s, body) in enumerate(told)
        )

    def _newer_detectors(self, robot: str, epoch: int) -> list[DetectorFile]:
        """Of the channels that the robot has, what it does not use yet."""
        announced = self._announced()
        data = self._store.newest_hello(robot, epoch) if announced else None
        hello = decode(data).body if data else None
        versions = hello.detector_versions if isinstance(hello, Hello) else {}
        return [file for channel, file in announced.items() if versions.get(channel, file.version) != file.version]


def _checked(robot: str, batch: Sequence[bytes]) -> tuple[list[StoredPacket], RefusedPacketError | None]:
    """The packets to be stored: all, or those up to and with the first that is refused."""
    packets: list[StoredPacket] = []
    for index, data in enumerate(batch):
        try:
            packets.append(_read(robot, data))
        except PacketError as error:
            number = read_number(data)
            if number is not None and number[0] == robot:
                packets.append(StoredPacket(*number, 0.0, None, None, data, str(error)))
            return packets, RefusedPacketError(str(error), index)
    return packets, None


def _early(packets: Sequence[StoredPacket], expected: Mapping[int, int]) -> list[StoredPacket]:
    """Those that do not follow on what is stored without a gap; ``expected`` next numbers by epoch."""
    ahead = dict(expected)
    early: list[StoredPacket] = []
    for packet in sorted(packets, key=lambda packet: packet.sequence):
        following = ahead.get(packet.epoch, 0)
        if packet.sequence > following:
            early.append(packet)
        else:
            ahead[packet.epoch] = max(following, packet.sequence + 1)
    return early


def _read(robot: str, data: bytes) -> StoredPacket:
    packet, kind = decode(data), read_label(data).kind
    if packet.robot != robot:
        raise PacketError(f"a packet of robot {packet.robot}, sent by {robot}")
    if kind not in UPLINK:
        raise PacketError(f"{robot}: a {kind} goes to a robot, not to the cloud")
    channel = packet.body.channel if isinstance(packet.body, Place) else None
    return StoredPacket(robot, packet.epoch, packet.sequence, packet.time, PacketKind(kind), channel, data)
