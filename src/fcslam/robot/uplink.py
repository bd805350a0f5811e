"""The way of a robot's packets to a cloud over an unreliable network: mapping never depends on the network.

One thread encodes the packets and puts them into the outbox, which is on disk, and another one sends them. So neither a
disk nor the network delays the pose of a scan.
"""

import hashlib
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fcslam.errors import InputError
from fcslam.records import Correction
from fcslam.robot.budget import Budget
from fcslam.robot.detector_updates import DetectorUpdates
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.outbox import Outbox, WaitingPackets
from fcslam.robot.sender import Sender
from fcslam.wire.http_transport import HttpTransport
from fcslam.wire.messages import Packet

STOP_TIMEOUT_S = 2.0
"""Time that a running request may take when the robot stops; its packets are sent again at the next start."""


@dataclass(frozen=True, slots=True)
class UplinkStatus:
    """Counts of packets since the start of a robot."""

    waiting: WaitingPackets = field(default=WaitingPackets(0, 0))
    """Packets that the server has not confirmed."""
    confirmed: int = 0
    """Packets that the server has confirmed."""
    sent_bytes: int = 0
    """Bytes of the packets that were sent, each time that they were."""
    left_out: int = 0
    """Places that are not sent, because the state folder or the budget has no room for them."""
    refused: int = 0
    """Packets that the server will never store."""
    trouble: str | None = None
    """Why packets do not arrive; None if they do, or if there is no server."""
    is_catching_up: bool = False
    """Whether a resumed recording has not yet reached the point of interruption."""


class Uplink:
    """Stores the packets of one start of a robot, and sends them if there is a cloud."""

    def __init__(
        self,
        frontend: RobotFrontend,
        outbox: Outbox,
        transport: HttpTransport | None,
        folder: Path,
        rng: np.random.Generator,
        clock: Callable[[], float],
        correct: Callable[[int, Correction], None],
        known: int,
        budget: Budget | None = None,
    ) -> None:
        """Start both threads.

        The front end uses the detectors that the cloud announces. Without a transport, all packets stay in the outbox,
        which has ``known`` packets from before an interruption that come again. The folder holds refused packets and
        detectors. ``correct`` is called in the sender's thread, with the session of this start and its correction.
        """
        self._outbox, self._refused, self._budget = outbox, folder / "refused", budget
        self._correct_session, self._known = correct, known
        self._detector_updates = DetectorUpdates(folder / "detectors", outbox, frontend)
        self._put = self._crowded_out = self._records = 0
        self._storing = ThreadPoolExecutor(1, "outbox")
        self._given = self._stored = 0
        """Batches of packets that were given to the outbox, and those of them that it has handled."""
        self._storing_failure: Exception | None = None
        self._sender: Sender | None = None
        self._stop = threading.Event()
        if transport is not None:
            self._sender = Sender(
                outbox, transport, rng, clock, self._correct, self._detector_updates.store, self._keep_refused
            )
            self._thread = threading.Thread(target=self._sender.run, args=(self._stop,), name="sender", daemon=True)
            self._thread.start()

    def before_record(self) -> None:
        """Give the front end the detector that is due before the next record."""
        self._detector_updates.apply_due(self._records, self._put < self._known)
        self._records += 1

    def between_records(self) -> None:
        """Give the front end a detector that came while no record does: the robot stands still."""
        if self._detector_updates.is_due(self._records):
            self.before_record()

    def put(self, packets: Sequence[Packet]) -> None:
        """Store the next packets of the front end, later; none after the outbox failed."""
        if packets:
            self._given += 1
            self._storing.submit(self._store, packets)

    def close(self) -> None:
        """Stop both threads; packets on their way into the outbox are stored, and wait there."""
        self._stop.set()
        self._storing.shutdown()
        if self._sender is not None:
            self._thread.join(STOP_TIMEOUT_S)

    @property
    def failure(self) -> Exception | None:
        """The error that ended one of the threads: a cloud that rejects the robot, or an outbox that cannot be used."""
        return self._storing_failure or (None if self._sender is None else self._sender.failure)

    @property
    def unstored(self) -> int:
        """Number of batches of packets on their way into the outbox."""
        return self._given - self._stored if self.failure is None else 0

    @property
    def is_full(self) -> bool:
        """Whether enough packets wait that a recording should wait, too."""
        return self._sender is not None and self._outbox.is_full

    @property
    def waiting(self) -> WaitingPackets:
        """Packets that the cloud has not confirmed."""
        return self._outbox.waiting if self._sender is not None else WaitingPackets(0, 0)

    def status(self) -> UplinkStatus:
        """The counts so far."""
        left_out, sender = self._crowded_out + (self._budget.left_out if self._budget else 0), self._sender
        is_catching_up = self._put < self._known
        if sender is None:
            return UplinkStatus(left_out=left_out, is_catching_up=is_catching_up)
        counts = sender.confirmed, sender.sent_bytes, left_out, sender.refusals
        return UplinkStatus(self.waiting, *counts, sender.trouble, is_catching_up)

    @property
    def trouble(self) -> str | None:
        """Why packets do not arrive; None if they do, or if there is no cloud."""
        return None if self._sender is None else self._sender.trouble

    @property
    def notices(self) -> tuple[str, ...]:
        """Messages about packets of another mission, refused packets, removed sessions and the last detector update."""
        if self._sender is None:
            return ()
        return tuple(filter(None, (*self._sender.notices, self._detector_updates.notice)))

    def _store(self, packets: Sequence[Packet]) -> None:
        try:
            chosen = packets if self._budget is None else self._budget.fit(packets)
            if chosen and self._storing_failure is None:
                self._crowded_out += self._outbox.put(chosen)
                self._put += len(chosen)
        except Exception as error:  # the thread that adds scans tells it
            self._storing_failure = error
        finally:
            self._stored += 1

    def _correct(self, epoch: int, correction: Correction) -> None:
        session = self._outbox.session_of(epoch)
        if session is not None:
            self._correct_session(session, correction)

    def _keep_refused(self, data: bytes, reason: str) -> None:
        try:
            self._refused.mkdir(parents=True, exist_ok=True)
            digest = hashlib.blake2b(data, digest_size=8).hexdigest()
            (self._refused / f"{digest}.bin").write_bytes(data)
            (self._refused / f"{digest}.txt").write_text(reason + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError(
                f"{self._refused}: cannot store a refused packet ({error}); free some space, then use --resume"
            ) from error
