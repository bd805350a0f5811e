"""The cloud within one process: packets in, replies out, one map in the end."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Self

import numpy as np

from fcslam.cloud.fleet import Fleet
from fcslam.cloud.packet_log import PacketLog, PacketNumber
from fcslam.cloud.replies import ReplyState, SessionCorrection, is_news, replies
from fcslam.cloud.result import FleetResult
from fcslam.cloud.sessions import in_session, session_name
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import PacketError
from fcslam.lidar.pair_verification import VerifyPairs, verify_here
from fcslam.records import Correction, Place, WordPlace, frozen
from fcslam.storage.state_file import State
from fcslam.wire.messages import Packet
from fcslam.wire.packets import decode, encode


class Cloud:
    """A fleet and the packets that it is made of, in memory."""

    def __init__(self, config: FleetConfig, seed: int, verify_pairs: VerifyPairs = verify_here) -> None:
        self.fleet = Fleet(config, seed, verify_pairs)
        self._log = PacketLog()
        self._times: dict[PacketNumber, float] = {}
        """Time of each packet."""
        self._packets: dict[PacketNumber, Packet] = {}
        """Those that this cloud applied itself."""
        self._read: Callable[[PacketNumber], Packet] | None = None
        """Gives the others; None if this cloud applied all itself."""
        self._corrections: dict[str, SessionCorrection] = {}
        """The newest that was sent, by session."""
        self._sent = 0
        """How many corrections were sent: the version of the next one."""

    def state(self) -> State:
        """The state after the packets so far, without these; ``restored`` makes an equal cloud of it."""
        return {
            "fleet": self.fleet.state(),
            "submaps": self.fleet.submaps(),
            "log": self._log.state(),
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

    @classmethod
    def restored(
        cls,
        config: FleetConfig,
        seed: int,
        state: State,
        times: Mapping[PacketNumber, float],
        read: Callable[[PacketNumber], Packet],
        verify_pairs: VerifyPairs = verify_here,
    ) -> Self:
        """The cloud of a ``state``.

        ``times`` are those of the packets that its cloud applied; ``read`` gives these packets when the cloud needs
        them.
        """
        cloud = cls(config, seed, verify_pairs)
        cloud._times, cloud._read = dict(times), read
        cloud.fleet = Fleet.restored(config, seed, state["fleet"], read, verify_pairs)
        cloud.fleet.restore_submaps(state["submaps"])
        cloud._log = PacketLog.restored(state["log"])
        cloud._sent = state["sent"]
        for session, kept in state["corrections"].items():
            robot, epoch, time = kept["sender"]
            version, map_index, quality = kept["correction"]
            correction = Correction(robot, version, map_index, frozen(kept["T_map_odom"]), quality)
            cloud._corrections[session] = SessionCorrection(robot, epoch, time, correction)
        return cloud

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
        if number not in self._log:
            self._packets[number], self._times[number] = packet, packet.time
        self._log.add(number, packet.time)
        refusal = None
        for ready in self._log.ready(number.session):
            try:
                self.fleet.apply(self._packets[ready])
            except PacketError as error:
                self._log.refuse(ready)
                del self._packets[ready], self._times[ready]
                refusal = error if ready == number else refusal
        if refusal is not None:
            raise refusal
        return self._replies(packet, number.session)

    def refuse(self, robot: str, epoch: int, sequence: int) -> None:
        """A packet that was refused where it was received; later packets are applied without it."""
        self._log.refuse(PacketNumber(session_name(robot, epoch), sequence))

    def finalize(self) -> FleetResult:
        """The result of all packets so far; it depends on their set alone."""
        arrived = ((time, number) for number, time in self._times.items())
        return self.fleet.finalize(self._log, arrived, self._packet)

    def _packet(self, number: PacketNumber) -> Packet:
        if number in self._packets:
            return self._packets[number]
        assert self._read is not None, "only a restored cloud lacks packets"
        return self._read(number)

    def _replies(self, packet: Packet, session: str) -> list[Packet]:
        robot, epoch = packet.robot, packet.epoch
        news = self._corrected(packet, session) if isinstance(packet.body, Place | WordPlace) else None
        known = -1 if news is None else news.correction.version - 1
        state = ReplyState({epoch: self._log.next_sequence(session)}, news)
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
