"""A robot in a mission over an unreliable network: mapping never depends on the network.

The front end runs in the thread that calls ``run``. A second thread encodes the packets and puts them into the outbox,
which is on disk, and a third one sends them to the cloud. The front end waits for them only if the outbox is full. The
back end may run in another process (``fcslam.robot.beside``). So neither it nor a disk delays the pose of a scan.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from fcslam.errors import StateError
from fcslam.records import Correction, FloatArray, Keyscan, LaserScan, SensorRecord
from fcslam.robot.budget import Budget
from fcslam.robot.detector_updates import DetectorUpdates
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.localization import Localizer
from fcslam.robot.outbox import Outbox, WaitingPackets
from fcslam.robot.sender import Sender
from fcslam.wire.http_transport import BatchTransport
from fcslam.wire.messages import Packet

POLL_INTERVAL_S = 0.1
"""Interval at which the main thread checks the sender while it waits for it."""
LARGEST_BACKLOG = 200
"""Largest number of keyscans and images that wait for the back end; a robot in real time never has as many."""
STOP_TIMEOUT_S = 2.0
"""Time that a running request may take when the robot stops; its packets are sent again at the next start."""


class LocalizationState(StrEnum):
    """Whether a robot knows its pose in the fleet's map."""

    MAPPING = "mapping"
    """It was never lost."""
    LOST = "lost"
    """It maps in a new session, whose transform to the fleet's map and to its earlier sessions is not known yet."""
    RELOCALISED = "relocalised"
    """It was lost, and the cloud has joined its new session to the map."""


@dataclass(frozen=True, slots=True)
class AgentProgress:
    """Progress of a robot."""

    scans: int
    keyscans: int
    waiting: WaitingPackets
    """Packets that the cloud has not confirmed."""
    confirmed: int
    """Packets that the cloud has confirmed."""
    sent_bytes: int
    left_out: int
    """Places that are not sent, because the outbox or the budget has no room for them."""
    refused: int
    """Packets that the cloud will never store."""
    map_index: int | None
    """Index of the robot's map; None before the first correction."""
    correction_age_s: float | None
    quality: float
    """Quality of the newest correction, in [0, 1], as in ``Correction``."""
    times_lost: int
    """Number of times the robot was lost since it started."""
    trouble: str | None
    """Why packets do not arrive; None if they do."""
    catching_up: bool
    """Whether a resumed recording has not yet reached the point of interruption."""
    notices: tuple[str, ...]
    """Messages about packets of another mission, refused packets, the last detector update, a failed back end, and
    jumps of the odometry, if there were any."""

    @property
    def localization(self) -> LocalizationState:
        """Whether the robot knows its pose."""
        if not self.times_lost:
            return LocalizationState.MAPPING
        return LocalizationState.RELOCALISED if self.quality > 0.0 else LocalizationState.LOST


AgentWatch = Callable[[AgentProgress], None]


class PlaybackPace:
    """Paces a recording by its own clock."""

    def __init__(self, speed: float | None, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        """``speed``: factor of the recorded speed; None: as fast as the robot can map."""
        self._speed = speed
        self._clock = clock
        self._sleep = sleep
        self._origin: tuple[float, float] | None = None
        """The first stamp, and the time of the clock at which it was due."""

    def wait(self, stamp: float) -> None:
        """Sleep until ``stamp`` is due; the first stamp is due at once."""
        if self._speed is None:
            return
        if self._origin is None:
            self._origin = stamp, self._clock()
        due = self._origin[1] + (stamp - self._origin[0]) / self._speed
        self._sleep(max(0.0, due - self._clock()))


class Agent:
    """One robot: front end, outbox, sender, and its pose in the fleet's map."""

    def __init__(
        self, frontend: RobotFrontend, outbox: Outbox, transport: BatchTransport, folder: Path,
        rng: np.random.Generator, clock: Callable[[], float], sleep: Callable[[float], None],
        budget: Budget | None = None,
    ) -> None:  # fmt: skip
        """``folder`` holds refused packets and detectors; without ``budget`` every packet is sent."""
        self._frontend = frontend
        self._outbox = outbox
        self._refused = folder / "refused"
        self._sleep = sleep
        self._budget = budget
        self._detector_updates = DetectorUpdates(folder / "detectors", outbox, frontend)
        self._clock = clock
        self._localizers: dict[int, Localizer] = {}
        """By part of this start: each part has its own ``odom`` frame."""
        self._sender = Sender(
            outbox, transport, rng, clock, self._correct, self._detector_updates.store, self._keep_refused
        )
        self._refused_files: int | None = None
        """Number of files of refused packets; None until they are counted, as there may be many."""
        self._known = self._put = self._keyscans = self._crowded_out = 0
        self._storing = ThreadPoolExecutor(1, "outbox")
        self._unstored: deque[Future[None]] = deque()
        """Packets on their way into the outbox."""

    def run(self, records: Iterable[SensorRecord], known: int, pace: PlaybackPace, watch: AgentWatch) -> None:
        """Map a whole recording and send all packets. An agent runs once.

        The outbox knows the first ``known`` packets from before an interruption; up to them nothing is paced.

        Raises:
            CloudError: the cloud rejects the robot; unconfirmed packets stay in the outbox.
            StateError: the outbox or its folder cannot be used.
            SourceError: the recording cannot be read.
        """
        self._known = known
        self._detector_updates.resume()
        with self._sending(), self._storing:
            for number, record in enumerate(records):
                self._detector_updates.apply_due(number, self._put < known)
                if isinstance(record, LaserScan) and self._put >= known:
                    pace.wait(record.stamp)
                self._queue(self._frontend.process(record))  # map one record
                self._wait_while(lambda: self._outbox.is_full or self._is_behind(), watch)
                watch(self.progress())
            self._queue(self._frontend.finish())
            self._wait_while(lambda: bool(self._unstored), watch)
            self._wait_while(lambda: self._outbox.waiting.packets > 0, watch)  # until the cloud has everything

    def progress(self) -> AgentProgress:
        """The progress now."""
        sender = self._sender
        failure = self._frontend.backend_failure
        broken = f"no closures and places from now on, as the back end failed: {failure}" if failure else None
        jumps = "the odometry jumps; scan matching bridges it" if self.odometry_jumps else None
        told = sender.notice, sender.refused_notice, sender.removed_notice, self._detector_updates.notice
        found = *told, broken, jumps
        notices = tuple(filter(None, found))
        left_out = self._crowded_out + (0 if self._budget is None else self._budget.left_out)
        return AgentProgress(
            sum(map(len, self._frontend.tracks)), self._keyscans, self._outbox.waiting, sender.confirmed,
            sender.sent_bytes, left_out, sender.refusals, self.localizer.map_index, self.localizer.age_s,
            self.localizer.quality, len(self._frontend.tracks) - 1, sender.trouble, self._put < self._known, notices,
        )  # fmt: skip

    @property
    def odometry_jumps(self) -> int:
        """Number of jumps of the odometry so far."""
        return self._frontend.odometry.jumps

    @property
    def localizer(self) -> Localizer:
        """Pose of the robot, for the part of this start that is running."""
        return self._localizer(len(self._frontend.tracks) - 1)

    def trajectory(self) -> tuple[FloatArray, FloatArray] | None:
        """The trajectory in the fleet's map by the newest correction, since the robot was last lost.

        Corrections of earlier parts are out of date, because maps are renumbered when they join.

        Returns:
            Stamps (N,) in seconds of the recording's clock, and poses (N, 3) of ``base`` in ``map``, metres and
            radians; None before the first correction.
        """
        track = self._frontend.scan_poses
        poses = self.localizer.T_map_base(track.T_odom_base())
        return None if poses is None else (track.stamps, poses)

    def _localizer(self, part: int) -> Localizer:
        return self._localizers.setdefault(part, Localizer(self._clock))

    def _correct(self, epoch: int, correction: Correction) -> None:
        part = self._outbox.part(epoch)
        if part is not None:
            self._localizer(part).correct(correction)

    def _queue(self, packets: list[Packet]) -> None:
        if packets:
            self._unstored.append(self._storing.submit(self._store, packets))

    def _store(self, packets: list[Packet]) -> None:
        """Put packets into the outbox."""
        for packet in packets:
            self._keyscans += isinstance(packet.body, Keyscan)
        chosen = packets if self._budget is None else self._budget.fit(packets)
        if chosen:
            self._crowded_out += self._outbox.put(chosen)
            self._put += len(chosen)

    def _is_behind(self) -> bool:
        """Whether back end or disk have to catch up, as in a recording that is played as fast as possible."""
        behind = max(self._frontend.backlog, len(self._unstored)) > LARGEST_BACKLOG
        if behind:
            self._queue(self._frontend.ready())
        return behind

    def _wait_while(self, condition: Callable[[], bool], watch: AgentWatch) -> None:
        """Wait while the other threads work on ``condition``."""
        self._raise_failures()
        while condition():
            watch(self.progress())
            self._sleep(POLL_INTERVAL_S)
            self._raise_failures()

    def _raise_failures(self) -> None:
        """Raise what ended another thread."""
        while self._unstored and self._unstored[0].done():
            self._unstored.popleft().result()
        if self._sender.failure is not None:
            raise self._sender.failure

    @contextmanager
    def _sending(self) -> Iterator[None]:
        """Run the sender in a second thread."""
        stop = threading.Event()
        thread = threading.Thread(target=self._sender.run, args=(stop,), name="sender", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(STOP_TIMEOUT_S)

    def _keep_refused(self, data: bytes, reason: str) -> None:
        try:
            self._refused.mkdir(parents=True, exist_ok=True)
            if self._refused_files is None:
                self._refused_files = len(list(self._refused.glob("*.bin")))
            stem = f"{self._refused_files:06d}"
            (self._refused / f"{stem}.bin").write_bytes(data)
            (self._refused / f"{stem}.txt").write_text(reason + "\n", encoding="utf-8")
        except OSError as error:
            raise StateError(
                f"{self._refused}: cannot store a refused packet ({error}); free some space, then use --resume"
            ) from error
        self._refused_files += 1
