"""Sends the packets of the outbox to the cloud, with retries, and reads the replies."""

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from fcslam.errors import CloudError, OversizeError, PacketError, UnavailableError
from fcslam.records import Correction, DetectorFile
from fcslam.robot.outbox import Outbox, PacketBatch
from fcslam.wire.http_transport import CloudState, HttpResponse, HttpTransport
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES, MAXIMUM_BATCH_PACKETS
from fcslam.wire.messages import Acknowledgement, DetectorUpdate
from fcslam.wire.packets import decode

SEND_INTERVAL_S = 1.0
"""Time between two batches if the first took all waiting packets: a request itself costs some hundred bytes."""
ASK_AFTER_S = 5.0
"""A robot without waiting packets asks for its correction after this time, which also shows that it is alive."""
REMOVED = "an administrator removed this session: the cloud stores its packets, but they have no effect"
CONNECTING = "connecting"
"""The trouble before the first reply."""
FIRST_RETRY_S, LONGEST_RETRY_S = 0.5, 30.0


def retry_delay_s(failures: int, rng: np.random.Generator) -> float:
    """Delay after a number of consecutive failures: exponential backoff with full jitter.

    The jitter keeps robots that lost the cloud at the same moment from returning at the same moment.
    """
    return float(rng.uniform(0.0, min(LONGEST_RETRY_S, FIRST_RETRY_S * 2.0 ** min(failures, 16))))


class Sender:
    """Sends one request at a time, the oldest packets first, each packet until the cloud has confirmed it."""

    def __init__(
        self,
        outbox: Outbox,
        transport: HttpTransport,
        rng: np.random.Generator,
        clock: Callable[[], float],
        correct: Callable[[int, Correction], None],
        keep: Callable[[DetectorFile, bytes], None],
        refused: Callable[[bytes, str], None],
    ) -> None:
        """Callbacks run in the thread of ``step``: ``correct`` gets the epoch and correction of the newest session,
        ``keep`` a downloaded detector, ``refused`` a refused packet and the reason."""
        self._outbox, self._transport, self._rng, self._clock = outbox, transport, rng, clock
        self._correct, self._keep, self._refused = correct, keep, refused
        self._is_synchronized = False
        self._batch_packets = MAXIMUM_BATCH_PACKETS
        """Largest number of packets in a batch; halved when the cloud refuses the size."""
        self._known_refusals = 0
        """Number of refused packets that the cloud has reported and this robot has read."""
        self._announced: list[DetectorFile] = []
        """Detectors of the last announcement, which were downloaded or cannot be. The cloud may go back to others."""
        self._correction = -1
        self._failures = 0
        self._last_reply_s = -np.inf
        self.sent_bytes = 0
        """Bytes of packets, counted as often as they were sent."""
        self.confirmed = 0
        """Packets that the cloud has stored."""
        self.refusals = 0
        self.trouble: str | None = CONNECTING
        """Why packets do not arrive; None if they do."""
        self._orphans = self._refused_packets = self._removed = ""
        """Messages about packets of earlier starts that belong to another mission, about refused packets, some of them
        refused after confirmation, and about the removal of this session; empty if there is nothing to say."""
        self.failure: Exception | None = None
        """The error that ended ``run``."""

    @property
    def notices(self) -> tuple[str, ...]:
        """Messages about packets of another mission, refused packets and the removal of this session."""
        return tuple(filter(None, (self._orphans, self._refused_packets, self._removed)))

    def run(self, stop: threading.Event) -> None:
        """Send until ``stop`` is set or an error occurs, as a cloud that rejects the robot; see ``failure``."""
        try:
            while not stop.is_set():
                stop.wait(self.step())
            if self.trouble is None and not self._outbox.waiting.packets:
                with suppress(CloudError):
                    self._transport.end()
        except Exception as error:  # the thread that waits for this one raises it
            self.failure = error

    def step(self) -> float:
        """Send at most one batch and read the reply; returns the time until the next step, seconds."""
        try:
            return self._step()
        except UnavailableError as error:
            self._is_synchronized = False  # the cloud may have opened another mission
            self.trouble = str(error)
            self._failures += 1
            return error.retry_after_s + retry_delay_s(self._failures, self._rng)

    def _step(self) -> float:
        if not self._is_synchronized or not self._outbox.is_synchronized:
            self._synchronize()
            self._is_synchronized = True
            self.trouble = None
        batch = self._outbox.batch(MAXIMUM_BATCH_BYTES, self._batch_packets)
        if batch is None:
            if self._clock() - self._last_reply_s >= ASK_AFTER_S:
                self._exchange((), None)
            return SEND_INTERVAL_S
        is_all = len(batch.packets) >= self._outbox.waiting.packets
        try:
            self._exchange(batch.packets, batch)
        except OversizeError:
            if len(batch.packets) == 1:
                raise
            self._batch_packets = len(batch.packets) // 2
            return 0.0
        return SEND_INTERVAL_S if is_all else 0.0

    def _synchronize(self) -> None:
        state = self._transport.state()
        orphans = self._outbox.synchronize(state.expected)
        for epoch, sequence in orphans:
            self._set_aside(
                epoch, sequence, f"epoch {epoch} belongs to another mission: the cloud does not have its first packets"
            )
        if orphans:
            self._orphans = f"{len(orphans)} packets of earlier starts belong to another mission: moved to refused"
        self._read_refusals(state)
        for epoch, sequence in state.expected.items():
            self.confirmed += self._outbox.acknowledge(epoch, sequence - 1)

    def _read_refusals(self, state: CloudState) -> None:
        """Set refused packets aside: those whose reply was lost, and those refused after they were confirmed."""
        for (epoch, sequence), reason in state.refused.items():
            self._set_aside(epoch, sequence, reason)
            self._refused_packets = (
                f"packets of this robot that the cloud refused: {state.refusals}; the last is packet {sequence} of "
                f"start {epoch}: {reason}"
            )
        self._known_refusals = state.refusals

    def _exchange(self, packets: Sequence[bytes], batch: PacketBatch | None) -> None:
        before = self.confirmed + self.refusals
        self.sent_bytes += sum(map(len, packets))
        reply = self._transport.send(packets, self._correction)
        self._last_reply_s = self._clock()
        self._read(reply)
        self._removed = REMOVED if reply.removed else ""
        if batch is not None and reply.refusal is not None:
            sequence = batch.first + reply.refusal[0]
            self.confirmed += self._outbox.acknowledge(batch.epoch, sequence - 1)
            self._set_aside(batch.epoch, sequence, reply.refusal[1])
            self._known_refusals += 1  # read here, so the whole list need not be requested
        if reply.refusal is None and reply.refused != self._known_refusals:
            self._read_refusals(self._transport.state())
        if batch is not None and self.confirmed + self.refusals == before:
            raise UnavailableError("the cloud replies, but confirms no packet")
        self._failures, self.trouble = 0, None

    def _set_aside(self, epoch: int, sequence: int, reason: str) -> None:
        """Store a waiting packet elsewhere before the outbox drops it, so that no interruption loses it."""
        data = self._outbox.packet(epoch, sequence)
        if data is None:
            return
        self._refused(data, reason)
        self._outbox.drop(epoch, sequence)
        self.refusals += 1

    def _read(self, reply: HttpResponse) -> None:
        try:
            packets = [decode(data) for data in reply.packets]
        except PacketError as error:
            raise UnavailableError(f"the cloud's reply is broken: {error}") from error
        for packet in packets:
            match packet.body:
                case Acknowledgement(epoch=epoch, sequence=sequence):
                    self.confirmed += self._outbox.acknowledge(epoch, sequence)
                # A correction of an earlier session, whose packets are sent first, is about another odometry.
                case Correction() as newest if packet.epoch == self._outbox.epoch and newest.version > self._correction:
                    self._correction = newest.version
                    self._correct(packet.epoch, newest)

        announced = [packet.body.file for packet in packets if isinstance(packet.body, DetectorUpdate)]
        for file in announced:
            if file not in self._announced:
                with suppress(CloudError):
                    self._keep(file, self._transport.detector(file.channel, file.version))
                self._announced.append(file)
        self._announced = announced or self._announced
