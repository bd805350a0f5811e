"""The cloud within one process: packets in, replies out, one map in the end."""

from dataclasses import replace

from fcslam.cloud.host import FleetHost
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.replies import SessionCorrection, is_news, replies
from fcslam.cloud.result import FleetResult
from fcslam.cloud.sessions import in_session, session_name
from fcslam.cloud.settings import CloudConfig, FleetConfig
from fcslam.errors import PacketError
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.lidar.pair_verification import VerifyPairs, verify_here
from fcslam.records import Place
from fcslam.wire.messages import Packet
from fcslam.wire.packets import decode, encode

_GRID = OccupancyConfig()


class Cloud(FleetHost):
    """The host of a fleet that keeps the packets in memory, and replies to them."""

    def __init__(
        self, config: FleetConfig, seed: int, verify_pairs: VerifyPairs = verify_here, grid: OccupancyConfig = _GRID
    ) -> None:
        super().__init__(
            CloudConfig(seed=seed, fleet=config, map=grid), lambda number: self._packets[number], verify_pairs
        )
        self._packets: dict[PacketNumber, Packet] = {}
        self._corrections: dict[str, SessionCorrection] = {}
        """The newest that was sent, by session."""
        self._sent = 0
        """How many corrections were sent: the version of the next one."""

    def receive(self, data: bytes) -> list[bytes]:
        """As ``apply``, with encoded packets."""
        return [encode(reply) for reply in self.apply(decode(data))]

    def apply(self, packet: Packet) -> list[Packet]:
        """Apply a packet as it was received, and those that waited for it; returns the replies to its sender."""
        number = PacketNumber(in_session(packet).robot, packet.sequence)
        if number not in self.log:
            self._packets[number] = packet
        self.log.add(number, packet.time)
        refusal = None
        for ready in self.log.ready(number.session):
            try:
                self.apply_next(ready, self._packets[ready])
            except PacketError as error:
                del self._packets[ready]
                refusal = error if ready == number else refusal
        if refusal is not None:
            raise refusal
        return self._replies(packet, number.session)

    def refuse(self, robot: str, epoch: int, sequence: int) -> None:
        """A packet that was refused where it was received; later packets are applied without it."""
        self.log.refuse(PacketNumber(session_name(robot, epoch), sequence))

    def finalize(self) -> FleetResult:
        """The result of all packets so far; it depends on their set alone."""
        return self.conclude((packet.time, number) for number, packet in self._packets.items())

    def _replies(self, packet: Packet, session: str) -> list[Packet]:
        robot, epoch = packet.robot, packet.epoch
        news = self._corrected(packet, session) if isinstance(packet.body, Place) else None
        known = -1 if news is None else news.correction.version - 1
        return replies(robot, {epoch: self.log.next_sequence(session)}, news, known)

    def _corrected(self, packet: Packet, session: str) -> SessionCorrection | None:
        estimates, last = self.fleet.corrections(session), self._corrections.get(session)
        if not estimates or not is_news(last.correction if last else None, estimates[0]):
            return None
        correction = replace(estimates[0], robot=packet.robot, version=self._sent)
        self._sent += 1
        self._corrections[session] = SessionCorrection(packet.robot, packet.epoch, packet.time, correction)
        return self._corrections[session]
