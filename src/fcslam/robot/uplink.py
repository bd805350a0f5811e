"""The way of a robot's packets to a cloud over an unreliable network: mapping never depends on the network.

One thread encodes the packets and puts them into the outbox, which is on disk, and another one sends them. So neither a
disk nor the network delays the pose of a scan.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
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

        Args:
            frontend: uses the detectors that the cloud announces.
            outbox: begun.
            transport: to the cloud; None: all packets stay in the outbox.
            folder: holds refused packets and detectors.
            rng: of the delays after failures.
            clock: seconds.
            correct: called in the sender's thread, with the session of this start and its correction.
            known: number of packets that the outbox has from before an interruption, and that come again.
            budget: None: every packet is sent.
        """
        self._outbox = outbox
        self._refused = folder / "refused"
        self._budget = budget
        self._correct_session = correct
        self._known = known
        self._detector_updates = DetectorUpdates(folder / "detectors", outbox, frontend)
        self._detector_updates.resume()
        self._refused_files: int | None = None
        """Number of files of refused packets; None until they are counted, as there may be many."""
        self._put = self._crowded_out = self._records = 0
        self._storing = ThreadPoolExecutor(1, "outbox")
        self._unstored: deque[Future[None]] = deque()
        """Packets on their way into the outbox."""
        self._unstored_lock = threading.Lock()
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
        # A resumed recording takes it at the same number again.
        if self._detector_updates.has_news or self._detector_updates.is_due(self._records):
            self.before_record()

    def put(self, packets: Sequence[Packet]) -> None:
        """Store the next packets of the front end, later; none after the outbox failed."""
        if packets and self._failure_of_storing() is None:
            self._unstored.append(self._storing.submit(self._store, packets))

    def close(self) -> None:
        """Stop both threads; packets on their way into the outbox are stored, and wait there."""
        self._stop.set()
        self._storing.shutdown()
        if self._sender is not None:
            self._thread.join(STOP_TIMEOUT_S)

    @property
    def failure(self) -> Exception | None:
        """The error that ended one of the threads: a cloud that rejects the robot, or an outbox that cannot be used."""
        failure = self._failure_of_storing()
        return self._sender.failure if failure is None and self._sender is not None else failure

    @property
    def unstored(self) -> int:
        """Number of batches of packets on their way into the outbox."""
        return len(self._unstored) if self.failure is None else 0

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
        left_out = self._crowded_out + (0 if self._budget is None else self._budget.left_out)
        status = UplinkStatus(left_out=left_out, is_catching_up=self._put < self._known)
        sender = self._sender
        if sender is None:
            return status
        return replace(
            status,
            waiting=self.waiting,
            confirmed=sender.confirmed,
            sent_bytes=sender.sent_bytes,
            refused=sender.refusals,
            trouble=sender.trouble,
        )

    @property
    def trouble(self) -> str | None:
        """Why packets do not arrive; None if they do, or if there is no cloud."""
        return None if self._sender is None else self._sender.trouble

    @property
    def notices(self) -> tuple[str, ...]:
        """Messages about packets of another mission, refused packets, removed sessions and the last detector update."""
        if self._sender is None:
            return ()
        sender = self._sender
        found = sender.notice, sender.refused_notice, sender.removed_notice, self._detector_updates.notice
        return tuple(filter(None, found))

    def _failure_of_storing(self) -> Exception | None:
        """The error that ended the outbox; batches that were stored are forgotten, and all of them once it failed."""
        with self._unstored_lock:
            while self._unstored and self._unstored[0].done():
                error = self._unstored.popleft().exception()
                if isinstance(error, Exception):
                    self._storing_failure = self._storing_failure or error
                    self._unstored.clear()
            return self._storing_failure

    def _store(self, packets: Sequence[Packet]) -> None:
        chosen = packets if self._budget is None else self._budget.fit(packets)
        if chosen:
            self._crowded_out += self._outbox.put(chosen)
            self._put += len(chosen)

    def _correct(self, epoch: int, correction: Correction) -> None:
        session = self._outbox.session_of(epoch)
        if session is not None:
            self._correct_session(session, correction)

    def _keep_refused(self, data: bytes, reason: str) -> None:
        try:
            self._refused.mkdir(parents=True, exist_ok=True)
            if self._refused_files is None:
                self._refused_files = len(list(self._refused.glob("*.bin")))
            stem = f"{self._refused_files:06d}"
            (self._refused / f"{stem}.bin").write_bytes(data)
            (self._refused / f"{stem}.txt").write_text(reason + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError(
                f"{self._refused}: cannot store a refused packet ({error}); free some space, then use --resume"
            ) from error
        self._refused_files += 1
