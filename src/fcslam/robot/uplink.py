"""The way of a robot's packets to a cloud over an unreliable network: mapping never depends on the network.

One thread encodes the packets and puts them into the outbox, which is on disk, and another one sends them. So neither a
disk nor the network delays the pose of a scan.
"""

import hashlib
import queue
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fcslam.errors import InputError
from fcslam.records import CODE_BYTES, Correction, DetectorFile, Place
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.outbox import Outbox
from fcslam.robot.sender import Sender
from fcslam.storage.files import write_file
from fcslam.wire.http_transport import HttpTransport
from fcslam.wire.limits import BYTES_PER_AXIS, KEYPOINT_AXES
from fcslam.wire.messages import Body, Packet
from fcslam.wire.packets import encode

if TYPE_CHECKING:
    from fcslam.robot.frontend3d import RobotFrontend3d

BURST_S = 10.0
"""Seconds of the budget that may be spent in advance: a place is sent in one packet."""
ENVELOPE_BYTES = 100
"""Largest part of a place's packet besides its keypoints and descriptors."""
FEWEST_DESCRIPTORS = 50
"""A place with fewer descriptors is rarely recognised, so it is dropped."""
STOP_TIMEOUT_S = 2.0
"""Time that a running request may take when the robot stops; its packets are sent again at the next start."""


class Uplink:
    """Stores the packets of one start of a robot, and sends them."""

    def __init__(
        self,
        frontend: "RobotFrontend | RobotFrontend3d",
        outbox: Outbox,
        transport: HttpTransport,
        folder: Path,
        rng: np.random.Generator,
        clock: Callable[[], float],
        correct: Callable[[int, Correction], None],
        known: int,
        budget_kBps: float | None = None,
    ) -> None:
        """Start both threads.

        The front end uses the detectors that the cloud announces. The outbox has ``known`` packets from before an
        interruption that come again. The folder holds refused packets and detectors. ``correct`` is called in the
        sender's thread, with the session of this start and its correction.
        """
        self.outbox, self._refused = outbox, folder / "refused"
        self._budget = None if budget_kBps is None else Budget(1e3 * budget_kBps)
        self._correct_session, self._known = correct, known
        self._detector_updates = DetectorUpdates(folder / "detectors", outbox, frontend)
        self._put = self._crowded_out = self._records = 0
        """Packets in the outbox, places for which it had no room, and records of the robot."""
        self._storing = ThreadPoolExecutor(1, "outbox")
        self._given = self._stored = 0
        """Batches of packets that were given to the outbox, and those of them that it has handled."""
        self._storing_failure: Exception | None = None
        self._stop = threading.Event()
        self.sender = Sender(
            outbox, transport, rng, clock, self._correct, self._detector_updates.store, self._keep_refused
        )
        """Counts what it sends."""
        self._thread = threading.Thread(target=self.sender.run, args=(self._stop,), name="sender", daemon=True)
        self._thread.start()

    def before_record(self) -> None:
        """Give the front end the detector that is due before the next record."""
        self._detector_updates.apply_due(self._records, self.is_catching_up)
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
        self._thread.join(STOP_TIMEOUT_S)

    @property
    def failure(self) -> Exception | None:
        """The error that ended one of the threads: a cloud that rejects the robot, or an outbox that cannot be used."""
        return self._storing_failure or self.sender.failure

    @property
    def unstored(self) -> int:
        """Number of batches of packets on their way into the outbox."""
        return self._given - self._stored if self.failure is None else 0

    @property
    def left_out(self) -> int:
        """Number of places that are not sent, because the outbox or the budget has no room for them."""
        return self._crowded_out + (0 if self._budget is None else self._budget.left_out)

    @property
    def is_catching_up(self) -> bool:
        """Whether a resumed recording has not yet reached the point of interruption."""
        return self._put < self._known

    @property
    def notices(self) -> tuple[str, ...]:
        """Messages about packets of another mission, refused packets, removed sessions and the last detector update."""
        return tuple(filter(None, (*self.sender.notices, self._detector_updates.notice)))

    def _store(self, packets: Sequence[Packet]) -> None:
        try:
            chosen = packets if self._budget is None else self._budget.fit(packets)
            if chosen and self._storing_failure is None:
                self._crowded_out += self.outbox.put(chosen)
                self._put += len(chosen)
        except Exception as error:  # the thread that adds scans tells it
            self._storing_failure = error
        finally:
            self._stored += 1

    def _correct(self, epoch: int, correction: Correction) -> None:
        session = self.outbox.session_of(epoch)
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


class Budget:
    """A limit of bytes per second of the recording's own clock, so the same recording always sends the same packets.

    Hello, keyscans, constraints and voxel maps are always sent, as without them there is no map; so are tags and fixes.
    Places get the rest of the budget: they are sent with all their descriptors, with the strongest ones, or not at all.
    """

    def __init__(self, bytes_per_s: float) -> None:
        self._bytes_per_s = bytes_per_s
        self._began: float | None = None
        self._spent = 0
        self.left_out = 0
        """Number of places that were not sent."""

    def fit(self, packets: Iterable[Packet]) -> list[Packet]:
        """Select what to send of the next packets of the front end; descriptors are sorted, strongest first."""
        kept = []
        for packet in packets:
            if self._began is None:
                self._began = packet.time
            place = packet.body
            chosen = self._thinned(packet, place) if isinstance(place, Place) else packet
            if chosen is None:
                self.left_out += 1
                continue
            self._spent += len(encode(chosen))
            kept.append(chosen)
        return kept

    def _thinned(self, packet: Packet, place: Place) -> Packet | None:
        seconds = packet.time - (packet.time if self._began is None else self._began)
        room = self._bytes_per_s * (seconds + BURST_S) - self._spent - ENVELOPE_BYTES
        fitting = room / (CODE_BYTES + BYTES_PER_AXIS * KEYPOINT_AXES[place.channel])
        if fitting >= len(place.keypoints):
            return packet
        if fitting < FEWEST_DESCRIPTORS:
            return None
        count = int(fitting)
        few = replace(place, keypoints=place.keypoints[:count], descriptors=place.descriptors[:count])
        return replace(packet, body=few)


class DetectorUpdates:
    """Passes new detectors from the thread that downloads them to the one that uses them, from the next record on.

    A resumed recording switches at the same records again, so that it produces the same packets.
    """

    def __init__(self, folder: Path, outbox: Outbox, frontend: "RobotFrontend | RobotFrontend3d") -> None:
        """``folder`` holds the files; the outbox records when each was applied, also before an interruption."""
        self._folder, self._outbox, self._frontend = folder, outbox, frontend
        self._fetched: queue.SimpleQueue[DetectorFile] = queue.SimpleQueue()
        self._applied = outbox.detector_updates()
        self._last: tuple[DetectorFile, Future[list[Body]]] | None = None
        """The last update, and whether the back end took it."""

    @property
    def notice(self) -> str | None:
        """Outcome of the last update, once it is known."""
        if self._last is None or not self._last[1].done():
            return None
        file, error = self._last[0], self._last[1].exception()
        return f"detector {file.version} " + ("from now on" if error is None else f"not taken: {error}")

    def store(self, file: DetectorFile, content: bytes) -> None:
        """Store a downloaded detector. Called by the sender."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_file(self._path(file), content)  # a resumed recording may need the old one
        except OSError as error:
            raise InputError(
                f"{self._folder}: cannot store detector {file.version} ({error}); free some space, then use --resume"
            ) from error
        self._fetched.put(file)

    def is_due(self, record: int) -> bool:
        """Whether a new detector waits, or an interrupted recording applied one before this record."""
        return record in self._applied or not self._fetched.empty()

    def apply_due(self, record: int, catching_up: bool) -> None:
        """Give the front end the detector that is due before this record, counted from 0."""
        newest = max(self._applied, default=-1)
        if not catching_up and record > newest and not self._fetched.empty():
            file = self._fetched.get()
            if file == self._applied.get(newest):
                return
            self._outbox.record_detector_update(record, file)
            self._applied[record] = file
        if record in self._applied:
            file = self._applied[record]
            self._last = file, self._frontend.set_detector(file, self._path(file))

    def _path(self, file: DetectorFile) -> Path:
        return self._folder / f"{file.channel.value}-{file.version}.onnx"
