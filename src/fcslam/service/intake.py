"""Checks, stores and acknowledges batches of packets; knows no network and does not wait for the fleet."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

from fcslam.cloud.edits import in_force, is_removed
from fcslam.cloud.packet_log import PacketLog, PacketNumber
from fcslam.cloud.replies import replies
from fcslam.cloud.sessions import check_robot, robot_and_epoch, robot_of, session_name
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import FcslamError, InputError, PacketError, UnavailableError
from fcslam.mission.mission_file import as_stored
from fcslam.mission.mission_store import MissionStore, StoredPacket
from fcslam.records import Channel, DetectorFile
from fcslam.wire.batches import read_batch, write_batch
from fcslam.wire.limits import MAXIMUM_BATCH_PACKETS, MAXIMUM_PACKET_BYTES
from fcslam.wire.messages import UPLINK
from fcslam.wire.packets import SizedPacket, decode, encode, is_in_space, read_number, unpacked_size

AGENT_LEASE_S = 30.0
"""How long after its last request an agent keeps its robot to itself."""
ENDED = "ended"
"""Stands for the agent of a robot that ended; agents are hexadecimal."""
MOST_WAITING = 20_000
"""Packets of one robot, in all its sessions, that may wait: for their effect, or for a packet before them."""
MOST_REFUSED_BYTES = 64 * 2**20
"""Refused packets of one robot that a mission may hold; each counts as ``PACKET_BYTES`` more."""
PACKET_BYTES = 8 * 2**10
"""A larger packet counts as several in the rate, by its bytes when it is unpacked."""

_log = logging.getLogger(__name__)


class PlaneError(FcslamError):
    """A robot sends poses in space to a mission in the plane."""


class SessionState(NamedTuple):
    """How far a session has arrived."""

    robot: str
    epoch: int
    next: int
    """Number of the first packet that is missing."""


class TokenBuckets:
    """How much each of several clients may do on average, and how much at once. Any thread may call."""

    def __init__(self, clock: Callable[[], float], rate: float, burst: float) -> None:
        """``rate``: tokens per second that fill each bucket; ``burst``: those in a full one, as at first."""
        self._clock, self._rate, self._burst = clock, rate, burst
        self._level: dict[str, tuple[float, float]] = {}
        """Level of each bucket and its time."""
        self._lock = threading.Lock()

    def wait_s(self, name: str, cost: float) -> float:
        """Take ``cost`` tokens; if there are too few, how long to wait, and none is taken."""
        with self._lock:
            now = self._clock()
            level, then = self._level.get(name, (self._burst, now))
            level = min(self._burst, level + (now - then) * self._rate) - cost
            if level < 0.0:
                return -level / self._rate
            self._level[name] = level, now
            return 0.0


class Agents:
    """Which agent speaks for each robot. Any thread may call."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._held: dict[str, tuple[str, float]] = {}
        """Agent of each robot, and when its last request came."""

    def hold(self, robot: str, agent: str) -> None:
        """Let an agent speak for a robot."""
        now = self._clock()
        with self._lock:
            holder, heard = self._held.get(robot, (agent, now))
            if holder not in (agent, ENDED) and now < heard + AGENT_LEASE_S:
                raise held_by_another(robot, heard + AGENT_LEASE_S - now)
            self._held[robot] = agent, now

    def note(self, robot: str, agent: str) -> None:
        """Note that the agent of a robot sent something."""
        with self._lock:
            self._held[robot] = agent, self._clock()

    def end(self, robot: str) -> None:
        """Note that a robot ended, and has sent everything: any agent may speak for it now."""
        with self._lock:
            self._held[robot] = ENDED, self._clock()

    def has_ended(self, robot: str) -> bool:
        """Whether the robot said so, and nothing since."""
        return self._held.get(robot, ("", 0.0))[0] == ENDED

    def silent_s(self, robot: str) -> float | None:
        """Seconds since the robot's last batch; None: never."""
        held = self._held.get(robot)
        return None if held is None else self._clock() - held[1]


def held_by_another(robot: str, wait_s: float) -> InputError:
    """Another agent speaks for a robot, for so long at most if it is gone."""
    return InputError(
        f"{robot}: another process sends as this robot; stop one of the two or name it differently, "
        f"or wait {wait_s:.0f} s if it is gone"
    )


class Intake:
    """Takes batches for one mission. Any thread may call."""

    def __init__(
        self,
        store: MissionStore,
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
        announced: Callable[[], Mapping[Channel, DetectorFile]] = dict,
        fleet: FleetConfig | None = None,
        agents: Agents | None = None,
        most_waiting: int = MOST_WAITING,
        most_refused_bytes: int = MOST_REFUSED_BYTES,
    ) -> None:
        """``announced``: detectors that robots are to use; ``fleet``: the mission's settings, for what a robot may
        send; ``agents``: who speaks for the robots, if other instances know that as well.
        """
        fleet = fleet or FleetConfig()
        self._in_plane = fleet.dimensions == 2
        self._most_waiting, self._most_refused_bytes = most_waiting, most_refused_bytes
        self._limits = limits = fleet.claims
        burst = max(20.0 * limits.packets_per_s, MAXIMUM_BATCH_PACKETS * MAXIMUM_PACKET_BYTES / PACKET_BYTES)
        self._packet_rate = TokenBuckets(clock, limits.packets_per_s, burst)
        self._session_rate = TokenBuckets(clock, limits.sessions_per_hour / 3600.0, limits.sessions_per_hour)
        self._store, self._wall_clock, self._announced = store, wall_clock, announced
        self.agents = agents or Agents(clock)
        self._lock = threading.Lock()
        self._log, self._arrivals = PacketLog(), 0
        self._released: deque[str] = deque()
        """Robots of the packets that may take effect and that the worker had not read when it noted its backlog."""
        self._warned: set[str] = set()
        """Robots of whose refused packets there was a line."""
        self.follow()

    def take(self, robot: str, agent: str, batch: bytes, known_correction: int) -> tuple[bytes, int, bool]:
        """Store a robot's packets.

        Returns:
            A batch that acknowledges all that is stored without a gap, with a correction and detectors if they are
            news; how many of the robot's packets were refused, by the worker too; and whether an administrator removed
            the session of its newest packet.

        Raises:
            PacketError: the batch cannot be taken apart, and nothing is stored; or, with an index, a packet of it is
                refused.
            PacketConflictError: another packet has the number of one of them; those before it are stored.
            InputError: another agent speaks for the robot.
            PlaneError: it sends poses in space, and the mission is in the plane; nothing is stored.
            UnavailableError: it has to be sent again later.
            StoreError: the disk is full; nothing is stored.
        """
        check_robot(robot)
        self.agents.hold(robot, agent)
        self.follow()
        encoded = read_batch(batch)
        self._limit_packets(robot, encoded)
        refused = self._limit_refused(robot, bool(encoded))
        packets, refusal = _checked(robot, encoded, self._in_plane)
        numbers = [(packet.robot, packet.epoch, packet.sequence) for packet in packets]
        self._make_room(robot, numbers)
        self._limit_sessions(robot, {epoch for _, epoch, _ in numbers})
        try:
            self._store.put(packets, self._wall_clock())
        finally:
            self.follow()
        if refusal:
            raise refusal
        epochs = sorted({epoch for _, epoch, _ in numbers}) or [s.epoch for s in self.sessions(robot)[-1:]]
        removed = bool(epochs) and is_removed(session_name(robot, epochs[-1]), in_force(self._store.edits()))
        return self._replies(robot, epochs, known_correction), refused, removed

    def sessions(self, robot: str | None = None) -> list[SessionState]:
        """Sessions of one robot or of all, by robot and epoch."""
        with self._lock:
            found = [(*robot_and_epoch(name), self._log.next_sequence(name)) for name in self._log.sessions]
        return [SessionState(*session) for session in sorted(found) if robot in (None, session[0])]

    def ready_count(self) -> int:
        """How many packets have arrived with all those before them in their sessions."""
        return self._log.released

    def waiting_count(self, robot: str | None = None) -> int:
        """How many packets of one robot or of all wait for one before them."""
        with self._lock:
            names = [name for name in self._log.sessions if robot in (None, robot_of(name))]
            return sum(self._log.waiting_count(name) for name in names)

    def follow(self) -> None:
        """Take into the log what was stored since, here or by another instance; its effect is the worker's."""
        with self._lock:
            for envelope in self._store.envelopes(after=self._arrivals):
                self._arrivals += 1
                session, before = session_name(envelope.robot, envelope.epoch), self._log.released
                self._log.add(PacketNumber(session, envelope.sequence), 0.0)
                for _ in self._log.ready(session):
                    pass
                self._released.extend([envelope.robot] * (self._log.released - before))

    def _limit_packets(self, robot: str, batch: Sequence[bytes]) -> None:
        unpacked = sum(map(unpacked_size, batch))  # unpacking takes time
        limit = f"{self._limits.packets_per_s:g} packets of {PACKET_BYTES} bytes per second"
        _take_tokens(self._packet_rate, robot, max(1.0, len(batch), unpacked / PACKET_BYTES), limit)

    def _limit_refused(self, robot: str, sends: bool) -> int:
        """How many packets of a robot were refused; if they are too many, it sends no more in this mission."""
        refused = self._store.refused(robot)
        count, share = refused.count, (refused.bytes + refused.count * PACKET_BYTES) / self._most_refused_bytes
        if share > 0.5 and robot not in self._warned:
            self._warned.add(robot)
            _log.warning("%s: %d packets were refused; at twice as many the mission takes no more of it", robot, count)
        if share > 1.0 and sends:
            raise UnavailableError(
                f"{robot}: {count} packets were refused, so this mission takes no more of this robot", 60.0
            )
        return count

    def _limit_sessions(self, robot: str, epochs: Collection[int]) -> None:
        with self._lock:
            names = [session_name(robot, epoch) for epoch in epochs]
            new = sum(1 for name in names if not self._log.next_sequence(name) and not self._log.waiting_count(name))
        _take_tokens(self._session_rate, robot, new, f"{self._limits.sessions_per_hour:g} sessions per hour")

    def _make_room(self, robot: str, numbers: Sequence[tuple[str, int, int]]) -> None:
        """Refuse, for now, what would make the robot's packets that wait too many."""
        if not numbers:
            return
        applied, queued = self._store.backlog()
        with self._lock:
            early = self._log.would_wait(PacketNumber(session_name(robot, epoch), k) for _, epoch, k in numbers)
            read = applied + sum(queued.values())
            while self._released and self._log.released - len(self._released) < read:  # others may have stored more
                self._released.popleft()
            waiting = queued.get(robot, 0) + self._released.count(robot)
        if waiting > self._most_waiting:
            raise UnavailableError(
                f"{robot}: {waiting} packets have not taken effect yet; send these again later", retry_after_s=2.0
            )
        if early and self.waiting_count(robot) + len(early) > self._most_waiting:
            session = early[0].session
            raise UnavailableError(
                f"{robot}: over {self._most_waiting} packets wait for one before them; "
                f"send packet {self._log.next_sequence(session)} of epoch {robot_and_epoch(session)[1]} first",
                retry_after_s=2.0,
            )

    def _replies(self, robot: str, epochs: Sequence[int], known_correction: int) -> bytes:
        announced, newest = self._announced(), epochs[-1] if epochs else None
        hello = self._store.newest_hello(robot, newest) if announced and newest is not None else None
        expected = {epoch: self._log.next_sequence(session_name(robot, epoch)) for epoch in epochs}
        correction = None if newest is None else self._store.correction(robot, newest)
        versions = {} if hello is None else hello.detector_versions
        packets = replies(robot, expected, correction, known_correction, announced, versions)
        return write_batch(map(encode, packets))


def _take_tokens(buckets: TokenBuckets, robot: str, cost: float, limit: str) -> None:
    wait_s = buckets.wait_s(robot, cost)
    if wait_s > 0.0:
        raise UnavailableError(f"{robot}: over {limit} (fleet.claims); send the others in {wait_s:.0f} s", wait_s)


def _checked(robot: str, batch: Sequence[bytes], in_plane: bool) -> tuple[list[StoredPacket], PacketError | None]:
    """The packets to be stored: all, or those up to and with the first that is refused."""
    packets: list[StoredPacket] = []
    for index, data in enumerate(batch):
        try:
            packets.append(_read(robot, data, in_plane))
        except PacketError as error:
            number = read_number(data)
            if number is not None and number[0] == robot:
                packets.append(StoredPacket(*number, 0.0, None, None, data, str(error)))
            return packets, PacketError(str(error), index)
    return packets, None


def _read(robot: str, data: bytes, in_plane: bool) -> StoredPacket:
    sized = SizedPacket(decode(data), data)
    if sized.label.robot != robot:
        raise PacketError(f"a packet of robot {sized.label.robot}, sent by {robot}")
    if sized.label.kind not in UPLINK:
        raise PacketError(f"{robot}: a {sized.label.kind} goes to a robot, not to the cloud")
    if in_plane and is_in_space(sized.packet.body):
        raise PlaneError(
            f"{robot}: sends poses in space, and this mission began in the plane, which --3d does not change; create a "
            "mission of a service that runs with --3d (POST /missions), or start the robot without --3d"
        )
    return as_stored(sized)
