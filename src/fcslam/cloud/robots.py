"""What the cloud keeps of each robot: its packets in order, its laser, its keyscans."""

from collections.abc import Iterator

from fcslam.errors import PacketError
from fcslam.records import Constraint, Keyscan, KeyscanId, LaserModel
from fcslam.wire.messages import Hello, Packet


class RobotStore:
    """Packets as received are the truth: each is taken once, a robot's in the order of their numbers."""

    def __init__(self) -> None:
        self._journal: list[Packet] = []
        self._waiting: dict[str, dict[int, Packet]] = {}
        self._expected: dict[str, int] = {}
        self._lasers: dict[str, LaserModel] = {}
        self._keyscans: dict[str, list[Keyscan]] = {}
        self._replies: dict[str, int] = {}
        self.in_canonical_order = True

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots with at least one keyscan, in the order of their first."""
        return tuple(self._keyscans)

    def admit(self, packet: Packet) -> Iterator[Packet]:
        """The packets that may take effect now that this one is here; none if it was here before or comes early.

        Raises:
            PacketError: the robot speaks in another epoch than it began.
        """
        robot, expected = packet.robot, self._expected.setdefault(packet.robot, 0)
        waiting = self._waiting.setdefault(robot, {})
        if packet.epoch != 0:
            raise PacketError(f"{robot}: epoch {packet.epoch}; a robot that starts again needs a name of its own")
        if packet.sequence < expected or packet.sequence in waiting:
            return
        self.in_canonical_order &= not waiting and packet.sequence == expected
        if self._journal and packet.order < self._journal[-1].order:
            self.in_canonical_order = False
        self._journal.append(packet)
        waiting[packet.sequence] = packet
        while (ready := waiting.pop(self._expected[robot], None)) is not None:
            self._expected[robot] += 1
            yield ready

    def canonical(self) -> list[Packet]:
        """All packets in canonical order."""
        return sorted(self._journal, key=lambda packet: packet.order)

    def greet(self, hello: Hello) -> None:
        """A robot introduces its laser."""
        if hello.robot in self._lasers:
            raise PacketError(f"{hello.robot}: said hello before")
        self._lasers[hello.robot] = hello.laser

    def add_keyscan(self, keyscan: Keyscan) -> None:
        """The robot's next keyscan."""
        robot = keyscan.id.robot
        known = self._keyscans.setdefault(robot, []) if robot in self._lasers else None
        if known is None:
            raise PacketError(f"{robot}: sends a keyscan before its hello")
        if keyscan.id.number != len(known):
            raise PacketError(f"{robot}: keyscan {keyscan.id.number} where {len(known)} is next")
        if len(keyscan.ranges_m) != self._lasers[robot].beam_count:
            raise PacketError(f"{robot}: {len(keyscan.ranges_m)} beams, {self._lasers[robot].beam_count} announced")
        known.append(keyscan)

    def require(self, *ids: KeyscanId) -> None:
        """Check that the keyscans are there.

        Raises:
            PacketError: one is not.
        """
        for robot, number in ids:
            if not 0 <= number < len(self._keyscans.get(robot, ())):
                raise PacketError(f"{robot}: names keyscan {number}, which it never sent")

    def require_next(self, motion: Constraint) -> None:
        """Check that the motion leads from the last but one keyscan to the last.

        Raises:
            PacketError: it does not.
        """
        last = len(self._keyscans.get(motion.robot, ())) - 1
        if (motion.i, motion.j) != (last - 1, last) or last < 1:
            raise PacketError(f"{motion.robot}: motion {motion.i} to {motion.j}, but keyscan {last} is the newest")

    def keyscans(self, robot: str, first: int = 0, last: int | None = None) -> tuple[Keyscan, ...]:
        """Keyscans first to last (inclusive) of a robot."""
        return tuple(self._keyscans[robot][first : None if last is None else last + 1])

    def laser(self, robot: str) -> LaserModel:
        """The robot's laser."""
        return self._lasers[robot]

    def number_replies(self, robot: str, count: int) -> int:
        """Number of the first of ``count`` packets that go to the robot now."""
        first = self._replies.get(robot, 0)
        self._replies[robot] = first + count
        return first
