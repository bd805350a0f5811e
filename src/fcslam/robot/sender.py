"""Brings what waits in the outbox to the cloud, however long that takes, and what the cloud says back."""

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from fcslam.errors import CloudError, OversizeError, PacketError, UnavailableError
from fcslam.records import Correction, DetectorFile
from fcslam.robot.outbox import Outbox, PacketBatch
from fcslam.wire.http_transport import BatchTransport, CloudState, HttpResponse
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES, MAXIMUM_BATCH_PACKETS
from fcslam.wire.messages import Acknowledgement, DetectorUpdate
from fcslam.wire.packets import decode

EVERY_S = 1.0
"""Between two batches, if one took all that waited: a request costs some hundred bytes whatever is in it."""
ASK_AFTER_S = 5.0
"""A robot that has nothing to say asks for its correction, and shows that it is there."""
FIRST_RETRY_S, LONGEST_RETRY_S = 0.5, 30.0


def retry_delay_s(failures: int, rng: np.random.Generator) -> float:
    """How long to wait after so many failures in a row: exponential backoff with full jitter.

    Robots that lost one cloud at one instant do not come back at one instant.
    """
    return float(rng.uniform(0.0, min(LONGEST_RETRY_S, FIRST_RETRY_S * 2.0 ** min(failures, 16))))


class Sender:
    """One request at a time, the oldest packets first; each is sent until the cloud has confirmed it."""

    def __init__(
        self, outbox: Outbox, transport: BatchTransport, rng: np.random.Generator, clock: Callable[[], float],
        correct: Callable[[int, Correction], None], keep: Callable[[DetectorFile, bytes], None],
        refused: Callable[[bytes, str], None],
    ) -> None:  # fmt: skip
        """Whom to tell, from where ``step`` is called: ``correct`` of the newest session's corrections and its
        epoch, ``keep`` of detectors that were announced and fetched, ``refused`` of packets that the cloud will never
        take, and why."""
        self._outbox = outbox
        self._transport = transport
        self._rng = rng
        self._clock = clock
        self._correct = correct
        self._keep = keep
        self._refused = refused
        self._is_synchronized = False
        self._most = MAXIMUM_BATCH_PACKETS
        """In a batch."""
        self._refused_there = 0
        """How many packets the cloud has refused as far as this robot has heard."""
        self._known: set[DetectorFile] = set()
        """Detectors that were fetched, or cannot be."""
        self._correction = -1
        self._failures = 0
        self._last_answer_s = -np.inf
        self.sent_bytes = 0
        """Of packets, those that were sent more than once included."""
        self.confirmed = 0
        """Packets that the cloud has stored."""
        self.refusals = 0
        self.trouble: str | None = "connecting"
        """Why nothing gets through; None: it does."""
        self.notice: str | None = None
        """What became of packets of earlier starts that the cloud can no longer take; None: there were none."""
        self.refused_notice: str | None = None
        """What the cloud says that it refused, some of it after it had confirmed it; None: nothing."""
        self.failure: Exception | None = None
        """What ended ``run``."""

    def run(self, stop: threading.Event) -> None:
        """Work until ``stop`` is set or something ends it, as the cloud that turns the robot away: see ``failure``."""
        try:
            while not stop.is_set():
                stop.wait(self.step())
        except Exception as error:  # the thread that waits for this one raises it
            self.failure = error

    def step(self) -> float:
        """At most one batch and its answer; returns how many seconds the next step may wait.

        Raises:
            CloudError: the cloud turns the robot away.
            StateError: the outbox or its folder cannot be used, or the cloud lacks the beginning of this epoch.
        """
        try:
            return self._step()
        except UnavailableError as error:
            self._is_synchronized = False  # its mission may be another one
            self.trouble = str(error)
            self._failures += 1
            return error.retry_after_s + retry_delay_s(self._failures, self._rng)

    def _step(self) -> float:
        if not self._is_synchronized or not self._outbox.is_synchronized:
            self._synchronize()
            self._is_synchronized = True
            self.trouble = None
        batch = self._outbox.batch(MAXIMUM_BATCH_BYTES, self._most)
        if batch is None:
            if self._clock() - self._last_answer_s >= ASK_AFTER_S:
                self._exchange((), None)
            return EVERY_S
        is_all = len(batch.packets) >= self._outbox.waiting.packets
        try:
            self._exchange(batch.packets, batch)
        except OversizeError:
            if len(batch.packets) == 1:
                raise
            self._most = len(batch.packets) // 2
            return 0.0
        return EVERY_S if is_all else 0.0

    def _synchronize(self) -> None:
        state = self._transport.state()
        in_vain = self._outbox.synchronize(state.expected)
        for epoch, sequence in in_vain:
            self._set_aside(epoch, sequence, f"epoch {epoch} is of another mission: the cloud lacks its beginning")
        if in_vain:
            self.notice = f"{len(in_vain)} packets of earlier starts are of another mission: set aside in refused"
        self._hear(state)
        for epoch, sequence in state.expected.items():
            self.confirmed += self._outbox.acknowledge(epoch, sequence - 1)

    def _hear(self, state: CloudState) -> None:
        """Of refusals: one whose answer was lost, and what was found out after it was confirmed, is heard of here."""
        for (epoch, sequence), reason in state.refused.items():
            self._set_aside(epoch, sequence, reason)
            self.refused_notice = (
                f"packets of this robot that the cloud refused: {len(state.refused)}; the last is packet {sequence} of "
                f"start {epoch}: {reason}"
            )
        self._refused_there = len(state.refused)

    def _exchange(self, packets: Sequence[bytes], batch: PacketBatch | None) -> None:
        before = self.confirmed + self.refusals
        self.sent_bytes += sum(map(len, packets))
        answer = self._transport.send(packets, self._correction)
        self._last_answer_s = self._clock()
        self._read(answer)
        if batch is not None and answer.refusal is not None:
            sequence = batch.first + answer.refusal.index
            self.confirmed += self._outbox.acknowledge(batch.epoch, sequence - 1)
            self._set_aside(batch.epoch, sequence, answer.refusal.reason)
            self._refused_there += 1  # heard of here: the whole list need not be asked for because of it
        if answer.refusal is None and answer.refused != self._refused_there:
            self._hear(self._transport.state())
        if batch is not None and self.confirmed + self.refusals == before:
            raise UnavailableError("the cloud answers, but confirms nothing")
        self._failures, self.trouble = 0, None

    def _set_aside(self, epoch: int, sequence: int, reason: str) -> None:
        """One that waits is forgotten only once it is kept elsewhere: whatever comes between, it is not lost."""
        data = self._outbox.packet(epoch, sequence)
        if data is None:
            return
        self._refused(data, reason)
        self._outbox.drop(epoch, sequence)
        self.refusals += 1

    def _read(self, answer: HttpResponse) -> None:
        try:
            packets = [decode(data) for data in answer.packets]
        except PacketError as error:
            raise UnavailableError(f"the cloud's answer is broken: {error}") from error
        for packet in packets:
            match packet.body:
                case Acknowledgement(epoch=epoch, sequence=sequence):
                    self.confirmed += self._outbox.acknowledge(epoch, sequence)
                # That of an earlier session, whose packets go first, is about another odometry.
                case Correction() as news if packet.epoch == self._outbox.epoch and news.version > self._correction:
                    self._correction = news.version
                    self._correct(packet.epoch, news)
                case DetectorUpdate(file=file) if file not in self._known:
                    self._fetch(file)

    def _fetch(self, file: DetectorFile) -> None:
        """The robot goes on with its old detector if there is no such file."""
        with suppress(CloudError):
            self._keep(file, self._transport.detector(file.channel, file.version))
        self._known.add(file)
