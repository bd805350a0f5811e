"""The cloud within one process: packets in, replies out, one map in the end."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fcslam.cloud.host import FleetHost
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.replies import ReplyState, SessionCorrection, is_news, replies
from fcslam.cloud.result import FleetResult
from fcslam.cloud.sessions import in_session, session_name
from fcslam.cloud.settings import CloudConfig, FleetConfig
from fcslam.errors import PacketError
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.lidar.pair_verification import VerifyPairs, verify_here
from fcslam.records import Correction, Edit, Place, WordPlace, frozen
from fcslam.storage.state_file import State
from fcslam.wire.messages import Packet
from fcslam.wire.packets import decode, encode

_GRID = OccupancyConfig()


class Cloud(FleetHost):
    """The host of a fleet that keeps the packets in memory, and replies to them."""

    def __init__(
        self,
        config: FleetConfig,
        seed: int,
        verify_pairs: VerifyPairs = verify_here,
        grid: OccupancyConfig = _GRID,
    ) -> None:
        super().__init__(CloudConfig(seed=seed, fleet=config, map=grid), self._packet, verify_pairs)
        self._times: dict[PacketNumber, float] = {}
        """Time of each packet."""
        self._packets: dict[PacketNumber, Packet] = {}
        """Those that this cloud applied itself."""
        self._earlier: Callable[[PacketNumber], Packet] | None = None
        """Gives the others; None if this cloud applied all itself."""
        self._corrections: dict[str, SessionCorrection] = {}
        """The newest that was sent, by session."""
        self._sent = 0
        """How many corrections were sent: the version of the next one."""

    def state(self) -> State:
        """As in ``FleetHost``; with it no submap has to be built again, and no correction is sent again."""
        return {
            **super().state(),
            "submaps": self.fleet.submaps(),
            "sent": self._sent,
            "corrections": {
                session: {
                    "sender": [sent.robot, sent.epoch, sent.time],
                    "correction": [c.version, c.map_index, c.quality],
                    "T_map_odom": np.array(c.T_map_odom),
                }
                for session, sent in self._corrections.items()
                for c in (sent.correction,)
            },
        }

    def take_over(
        self,
        state: State,
        edits: Sequence[Edit],
        times: Mapping[PacketNumber, float],
        read: Callable[[PacketNumber], Packet],
    ) -> None:
        """Take over the state of another cloud and its edits; ``times`` are of its packets, which ``read`` gives."""
        self._times, self._earlier = dict(times), read
        self.restore(state, edits)
        self.fleet.restore_submaps(state["submaps"])
        self._sent = state["sent"]
        for session, kept in state["corrections"].items():
            robot, epoch, time = kept["sender"]
            version, map_index, quality = kept["correction"]
            correction = Correction(robot, version, map_index, frozen(kept["T_map_odom"]), quality)
            self._corrections[session] = SessionCorrection(robot, epoch, time, correction)

    def receive(self, data: bytes) -> list[bytes]:
        """As ``apply``, with encoded packets.

        Raises:
            PacketError: as there, or ``data`` is not a packet.
        """
        return [encode(reply) for reply in self.apply(decode(data))]

    def apply(self, packet: Packet) -> list[Packet]:
        """Apply a packet as it was received, and those that waited for it; returns the replies to its sender.

        Raises:
            PacketError: the packet does not fit what its robot sent before; then it has no effect and its number is
                used up.
        """
        number = PacketNumber(in_session(packet).robot, packet.sequence)
        if number not in self.log:
            self._packets[number], self._times[number] = packet, packet.time
        self.log.add(number, packet.time)
        refusal = None
        for ready in self.log.ready(number.session):
            try:
                self.apply_next(ready, self._packets[ready])
            except PacketError as error:
                del self._packets[ready], self._times[ready]
                refusal = error if ready == number else refusal
        if refusal is not None:
            raise refusal
        return self._replies(packet, number.session)

    def refuse(self, robot: str, epoch: int, sequence: int) -> None:
        """A packet that was refused where it was received; later packets are applied without it."""
        self.log.refuse(PacketNumber(session_name(robot, epoch), sequence))

    def finalize(self) -> FleetResult:
        """The result of all packets so far; it depends on their set alone."""
        return self.conclude((time, number) for number, time in self._times.items())

    def _packet(self, number: PacketNumber) -> Packet:
        if number in self._packets:
            return self._packets[number]
        assert self._earlier is not None, "only a restored cloud lacks packets"
        return self._earlier(number)

    def _replies(self, packet: Packet, session: str) -> list[Packet]:
        robot, epoch = packet.robot, packet.epoch
        news = self._corrected(packet, session) if isinstance(packet.body, Place | WordPlace) else None
        known = -1 if news is None else news.correction.version - 1
        state = ReplyState({epoch: self.log.next_sequence(session)}, news)
        return replies(robot, state, known, {})

    def _corrected(self, packet: Packet, session: str) -> SessionCorrection | None:
        """The session's correction if it is news."""
        estimate, last = self.fleet.correction(session), self._corrections.get(session)
        if estimate is None or not is_news(last.correction if last else None, estimate):
            return None
        correction = replace(estimate, robot=packet.robot, version=self._sent)
        self._sent += 1
        self._corrections[session] = SessionCorrection(packet.robot, packet.epoch, packet.time, correction)
        return self._corrections[session]
