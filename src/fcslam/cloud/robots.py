"""What the cloud keeps of each robot's session: its packets in order, its laser, its keyscans."""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from fcslam.errors import PacketError
from fcslam.geometry import se2
from fcslam.records import Channel, Constraint, FloatArray, Keyscan, KeyscanId, LaserModel, Place
from fcslam.wire.limits import MAXIMUM_COORDINATE_M
from fcslam.wire.messages import Hello, Packet

FARTHEST_M = MAXIMUM_COORDINATE_M / 4.0
"""Of a robot from its start. What joining and optimising maps adds fits between this and what a packet can tell."""


class RobotStore:
    """Packets as received are the truth: each is taken once, a robot's in the order of their numbers.

    A packet that is refused leaves nothing behind, not even its number.
    """

    def __init__(self) -> None:
        self._times: dict[str, dict[int, float]] = {}
        """Of all packets that came, by session and number."""
        self._early: dict[tuple[str, int], Packet] = {}
        """Those that have not taken effect."""
        self._newest = (-math.inf, "", 0)
        """In canonical order."""
        self._in_order = True
        self._skipped: set[tuple[str, int]] = set()
        """Robot and number of packets that will never come."""
        self._expected: dict[str, int] = {}
        self._hellos: dict[str, Hello] = {}
        self._stamps: dict[str, list[float]] = {}
        """Of every keyscan."""
        self._keyscans: dict[str, list[Keyscan | None]] = {}
        """None where it was let go."""
        self._holders: dict[str, list[int]] = {}
        """How many places hold each keyscan."""
        self._connected: dict[str, int] = {}
        """Keyscans that motions tie to the first; only they are known to others."""
        self._T_odom_base: dict[str, FloatArray] = {}
        """Where the motions lead to, from the first keyscan."""
        self._announced: dict[str, set[tuple[Channel, str]]] = {}
        """Detectors that each robot has said it describes places with, of all its hellos."""
        self._places: set[tuple[KeyscanId, Channel, str]] = set()
        """With their detector versions."""
        self._replies: dict[str, int] = {}

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots with at least one keyscan, in the order of their first."""
        return tuple(self._connected)

    @property
    def arrived_in_canonical_order(self) -> bool:
        """Whether the packets came in the order in which a replay would bring them."""
        return self._in_order

    def knows(self, packet: Packet) -> bool:
        """Whether a packet with this number was here before, or will never come."""
        robot, sequence = packet.robot, packet.sequence
        return sequence in self._times.get(robot, ()) or (robot, sequence) in self._skipped

    def admit(self, packet: Packet) -> Iterator[Packet]:
        """The packets that may take effect now that this one is here; none if it was here before or comes early.

        A packet counts as taken when the next one is asked for.
        """
        if self.knows(packet):
            return
        robot, sequence = packet.robot, packet.sequence
        order = packet.time, robot, sequence
        self._in_order &= order > self._newest
        self._newest = max(order, self._newest)
        self._times.setdefault(robot, {})[sequence] = packet.time
        self._early[robot, sequence] = packet
        yield from self._ready(robot)

    def skip(self, robot: str, sequence: int) -> Iterator[Packet]:
        """As ``admit``, for a packet that was refused for good: those after it need not wait for its number."""
        self._skipped.add((robot, sequence))
        yield from self._ready(robot)

    def _ready(self, robot: str) -> Iterator[Packet]:
        while True:
            sequence = self._expected.get(robot, 0)
            if (robot, sequence) not in self._skipped:
                ready = self._early.get((robot, sequence))
                if ready is None:
                    return
                yield ready
                del self._early[robot, sequence]
            self._expected[robot] = sequence + 1

    @property
    def skipped(self) -> frozenset[tuple[str, int]]:
        """Robot and number of every packet that will never come."""
        return frozenset(self._skipped)

    def withdraw(self, packet: Packet) -> None:
        """Forget a packet that turned out to be refused: the next one with its number takes its place."""
        del self._times[packet.robot][packet.sequence], self._early[packet.robot, packet.sequence]

    def canonical(self) -> list[tuple[str, int]]:
        """Session and number of all packets in canonical order; a session's name tells its epoch."""
        times = [(time, robot, sequence) for robot, of in self._times.items() for sequence, time in of.items()]
        return [(robot, sequence) for _, robot, sequence in sorted(times)]

    def greet(self, hello: Hello) -> None:
        """The robot begins, or has changed a detector.

        Raises:
            PacketError: it has another laser than before.
        """
        before = self._hellos.get(hello.robot)
        if before is not None and before.laser != hello.laser:
            raise PacketError(f"{hello.robot}: says hello again with another laser")
        self._hellos[hello.robot] = hello
        self._announced.setdefault(hello.robot, set()).update(hello.detector_versions.items())

    def add_keyscan(self, keyscan: Keyscan) -> None:
        """The robot's next keyscan.

        Raises:
            PacketError: it is not the next, does not fit the laser, or the motion to the one before is missing.
        """
        robot, number = keyscan.id
        if robot not in self._hellos:
            raise PacketError(f"{robot}: sends a keyscan before its hello")
        known, beam_count = len(self._stamps.get(robot, ())), self.laser(robot).beam_count
        if number != known:
            raise PacketError(f"{robot}: keyscan {number} where {known} is next")
        if number > self._connected.get(robot, 0):
            raise PacketError(f"{robot}: keyscan {number} before the motion to keyscan {number - 1}")
        if len(keyscan.ranges_m) != beam_count:
            raise PacketError(f"{robot}: {len(keyscan.ranges_m)} beams, {beam_count} announced")
        self._keyscans.setdefault(robot, []).append(keyscan)
        self._stamps.setdefault(robot, []).append(keyscan.stamp)
        self._holders.setdefault(robot, []).append(0)
        if number == 0:
            self._connected[robot] = 1

    def connect(self, motion: Constraint) -> None:
        """The motion that leads to the newest keyscan.

        Raises:
            PacketError: it does not, the keyscan has one already, or it leads out of all bounds.
        """
        robot, connected = motion.robot, self._connected.get(motion.robot, 0)
        if connected == len(self._stamps.get(robot, ())) or (motion.i, motion.j) != (connected - 1, connected):
            raise PacketError(f"{robot}: motion {motion.i} to {motion.j} does not lead to a new keyscan")
        before = self._T_odom_base.get(robot)
        T_odom_base = motion.T_i_j if before is None else se2.compose(before, motion.T_i_j)
        if not math.hypot(T_odom_base[0], T_odom_base[1]) <= FARTHEST_M:
            raise PacketError(f"{robot}: motion {motion.i} to {motion.j} leads over {FARTHEST_M:g} m from the start")
        self._T_odom_base[robot] = T_odom_base
        self._connected[robot] = connected + 1

    def add_place(self, place: Place) -> None:
        """A place of the robot.

        Raises:
            PacketError: its keyscans are not there, this detector described it before, or was not announced.
        """
        self.require(place.id, KeyscanId(place.id.robot, place.last))
        robot, number = place.id
        announced = sorted(version for channel, version in self._announced[robot] if channel is place.channel)
        if place.detector_version not in announced:
            raise PacketError(
                f"{robot}: a {place.channel} place of detector {place.detector_version}; "
                f"{', '.join(announced) or 'none'} was announced"
            )
        described = place.id, place.channel, place.detector_version
        if described in self._places:
            raise PacketError(f"{robot}: {place.channel} place {number} was described before")
        self._places.add(described)

    def require(self, *ids: KeyscanId) -> None:
        """Check that the keyscans are there.

        Raises:
            PacketError: one is not.
        """
        for robot, number in ids:
            if not 0 <= number < self._connected.get(robot, 0):
                raise PacketError(f"{robot}: names keyscan {number}, which it never sent")

    def hold(self, place: Place) -> bool:
        """Keep the keyscans of the submap around a place until it is released; False if some were let go before."""
        robot, numbers = place.id.robot, slice(place.first, place.last + 1)
        if None in self._keyscans[robot][numbers]:
            return False
        self._holders[robot][numbers] = [count + 1 for count in self._holders[robot][numbers]]
        return True

    def release(self, place: Place) -> None:
        """A place that was held is needed no more: let those keyscans go that no other place holds."""
        robot, holders = place.id.robot, self._holders[place.id.robot]
        for number in range(place.first, place.last + 1):
            holders[number] -= 1
            if not holders[number]:
                self._keyscans[robot][number] = None

    def keyscans(self, robot: str, first: int = 0, last: int | None = None) -> tuple[Keyscan, ...]:
        """Connected keyscans first to last (inclusive) of a robot, without those that were let go."""
        end = self._connected[robot] if last is None else last + 1
        return tuple(keyscan for keyscan in self._keyscans[robot][first:end] if keyscan is not None)

    def stamp(self, keyscan: KeyscanId) -> float:
        """When the keyscan was taken."""
        return self._stamps[keyscan.robot][keyscan.number]

    def stamps(self, robot: str) -> FloatArray:
        """When the robot's connected keyscans were taken, shape (N,), whether they were let go or not."""
        return np.array(self._stamps[robot][: self._connected[robot]])

    def detector_versions(self, robot: str) -> Mapping[Channel, str]:
        """What the robot describes places with now; nothing before its hello."""
        return self._hellos[robot].detector_versions if robot in self._hellos else {}

    def laser(self, robot: str) -> LaserModel:
        """The robot's laser."""
        return self._hellos[robot].laser

    def number_replies(self, robot: str, count: int) -> int:
        """Number of the first of ``count`` packets that go to the robot now."""
        first = self._replies.get(robot, 0)
        self._replies[robot] = first + count
        return first
