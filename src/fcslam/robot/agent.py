"""A robot that takes part in a mission over a network that fails: it maps as if there were none.

The front end runs where ``run`` is called and hands its packets to the outbox, which is on disk. A thread of its own
brings them to the cloud; the front end never waits for it, unless the outbox is full.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from fcslam.errors import StateError
from fcslam.records import Constraint, ConstraintKind, Correction, FloatArray, Keyscan, LaserScan, SensorRecord
from fcslam.robot.budget import Budget
from fcslam.robot.detector_updates import DetectorUpdates
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.localization import Localizer
from fcslam.robot.outbox import Outbox, WaitingPackets
from fcslam.robot.sender import Sender
from fcslam.wire.http_transport import BatchTransport
from fcslam.wire.messages import Packet

LOOK_EVERY_S = 0.1
"""How often what waits for the sender looks after it."""
FAREWELL_S = 2.0
"""How long a request under way may take when the robot stops; what it brought is sent again next time."""


class LocalizationState(StrEnum):
    """Whether a robot knows where it is."""

    MAPPING = "mapping"
    """It has not been lost."""
    LOST = "lost"
    """It maps, but how that lies to the fleet's map, and to what it mapped before, nobody knows yet."""
    RELOCALISED = "relocalised"
    """It was lost, and the cloud has found it."""


@dataclass(frozen=True, slots=True)
class AgentProgress:
    """How far a robot is."""

    scans: int
    keyscans: int
    waiting: WaitingPackets
    """Packets that the cloud has not confirmed."""
    confirmed: int
    """Packets that it has."""
    sent_bytes: int
    left_out: int
    """Places that are not sent: too much waits, or the budget does not allow for them."""
    refused: int
    """Packets that the cloud will never store."""
    map_index: int | None
    """Which of the fleet's maps the robot is in; None: the cloud has not said."""
    correction_age_s: float | None
    quality: float
    """How well the newest correction is borne out, in [0, 1], as in ``Correction``."""
    times_lost: int
    """How often it was lost since it started."""
    trouble: str | None
    """Why nothing gets through; None: it does."""
    catching_up: bool
    """Whether the recording is still where it was when the robot was stopped."""
    notices: tuple[str, ...]
    """What became of packets for another mission, what the cloud refused, and what became of the last detector that was
    announced, if there were any."""

    @property
    def localization(self) -> LocalizationState:
        """Whether the robot knows where it is, as far as it needed to find out."""
        if not self.times_lost:
            return LocalizationState.MAPPING
        return LocalizationState.RELOCALISED if self.quality > 0.0 else LocalizationState.LOST


AgentWatch = Callable[[AgentProgress], None]


class PlaybackPace:
    """Plays a recording by its own clock."""

    def __init__(self, speed: float | None, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        """``speed`` times as fast as it was recorded; None: as fast as it can be mapped."""
        self._speed = speed
        self._clock = clock
        self._sleep = sleep
        self._origin: tuple[float, float] | None = None
        """A stamp, and the time that it stands for."""

    def wait(self, stamp: float) -> None:
        """Until ``stamp`` is due; the first one is at once."""
        if self._speed is None:
            return
        if self._origin is None:
            self._origin = stamp, self._clock()
        due = self._origin[1] + (stamp - self._origin[0]) / self._speed
        self._sleep(max(0.0, due - self._clock()))


class Agent:
    """One robot: front end, outbox, sender, and where it is in the fleet's map."""

    def __init__(
        self, frontend: RobotFrontend, outbox: Outbox, transport: BatchTransport, folder: Path,
        rng: np.random.Generator, clock: Callable[[], float], sleep: Callable[[float], None],
        budget: Budget | None = None,
    ) -> None:  # fmt: skip
        """``folder``: for packets that the cloud will never take, and for detectors; without ``budget`` all is sent."""
        self._frontend = frontend
        self._outbox = outbox
        self._refused = folder / "refused"
        self._sleep = sleep
        self._budget = budget
        self._detector_updates = DetectorUpdates(folder / "detectors", outbox, frontend)
        self._clock = clock
        self._localizers: dict[int, Localizer] = {}
        """Of every part of this start: each has a frame of its own."""
        self._sender = Sender(
            outbox, transport, rng, clock, self._correct, self._detector_updates.store, self._keep_refused
        )
        self._kept: int | None = None
        """Files of refused packets, once they were counted: there may be many."""
        self._known = self._said = self._keyscans = self._crowded_out = 0

    def run(self, records: Iterable[SensorRecord], known: int, pace: PlaybackPace, watch: AgentWatch) -> None:
        """Map a whole recording and send all of it; ``known`` packets of it were said before, and hurry by.

        Raises:
            CloudError: the cloud turns the robot away; what it does not have stays in the outbox.
            StateError: the outbox or its folder cannot be used.
            SourceError: the recording cannot be read.
        """
        self._known = known
        self._detector_updates.resume()
        with self._sending():
            for number, record in enumerate(records):
                self._detector_updates.apply_due(number, self._said < known)
                if isinstance(record, LaserScan) and self._said >= known:
                    pace.wait(record.stamp)
                self._say(self._frontend.process(record))
                self._wait_while(lambda: self._outbox.is_full, watch)
                watch(self.progress())
            self._say(self._frontend.finish())
            self._wait_while(lambda: self._outbox.waiting.packets > 0, watch)

    def progress(self) -> AgentProgress:
        """Where the robot is now."""
        sender = self._sender
        notices = tuple(filter(None, (sender.notice, sender.refused_notice, self._detector_updates.notice)))
        left_out = self._crowded_out + (0 if self._budget is None else self._budget.left_out)
        return AgentProgress(
            sum(map(len, self._frontend.tracks)), self._keyscans, self._outbox.waiting, sender.confirmed,
            sender.sent_bytes, left_out, sender.refusals, self.localizer.map_index, self.localizer.age_s,
            self.localizer.quality, len(self._frontend.tracks) - 1, sender.trouble, self._said < self._known, notices,
        )  # fmt: skip

    @property
    def localizer(self) -> Localizer:
        """Where the robot is, in the frame of the part that runs."""
        return self._localizer(len(self._frontend.tracks) - 1)

    def trajectory(self) -> tuple[FloatArray, FloatArray] | None:
        """Stamps (N,) and poses (N, 3) of ``base`` in the fleet's map at every scan, by the newest correction.

        Since the robot was last lost: of what was before, corrections are as old as that, and maps are numbered anew as
        they join. None: the cloud has not said where the map is.
        """
        localizer, track = self.localizer, self._frontend.tracks[-1]
        poses = [localizer.T_map_base(pose) for pose in track]
        known = [pose for pose in poses if pose is not None]
        return (np.array([pose.stamp for pose in track]), np.array(known)) if known else None

    def _localizer(self, part: int) -> Localizer:
        return self._localizers.setdefault(part, Localizer(self._clock))

    def _correct(self, epoch: int, correction: Correction) -> None:
        part = self._outbox.part(epoch)
        if part is not None:
            self._localizer(part).correct(correction)

    def _say(self, packets: list[Packet]) -> None:
        for packet in packets:
            body = packet.body
            if isinstance(body, Constraint) and body.kind is ConstraintKind.ODOMETRY:
                self._localizer(packet.epoch).extend(body)
            self._keyscans += isinstance(body, Keyscan)
        chosen = packets if self._budget is None else self._budget.fit(packets)
        if chosen:
            self._crowded_out += self._outbox.put(chosen)
            self._said += len(chosen)

    def _wait_while(self, condition: Callable[[], bool], watch: AgentWatch) -> None:
        """Until the sender has changed that."""
        self._require_sender()
        while condition():
            watch(self.progress())
            self._sleep(LOOK_EVERY_S)
            self._require_sender()

    def _require_sender(self) -> None:
        if self._sender.failure is not None:
            raise self._sender.failure

    @contextmanager
    def _sending(self) -> Iterator[None]:
        """A thread that sends meanwhile."""
        stop = threading.Event()
        thread = threading.Thread(target=self._sender.run, args=(stop,), name="sender", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(FAREWELL_S)

    def _keep_refused(self, data: bytes, reason: str) -> None:
        try:
            self._refused.mkdir(parents=True, exist_ok=True)
            if self._kept is None:
                self._kept = len(list(self._refused.glob("*.bin")))
            stem = f"{self._kept:06d}"
            (self._refused / f"{stem}.bin").write_bytes(data)
            (self._refused / f"{stem}.txt").write_text(reason + "\n", encoding="utf-8")
        except OSError as error:
            raise StateError(
                f"{self._refused}: a refused packet cannot be kept there ({error}); make room, and --resume"
            ) from error
        self._kept += 1
