"""The robots of a mission, each over its own recording: one after another in this process, or side by side in others.

Either way a robot gives the same packets, as it knows no other robot. The back end of a single robot runs beside it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, cycle, islice
from typing import TYPE_CHECKING, Any, Final

from fcslam.cloud.report import Track
from fcslam.cloud.sessions import session_name
from fcslam.errors import FcslamError, InputError
from fcslam.processes import Stream, semaphore, trim_memory
from fcslam.records import CloudScan, Keyscan, LaserScan, Odometry, SensorRecord
from fcslam.robot.backend_runner import Submit, backend_process
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.track import ScanTrack
from fcslam.sources import Source
from fcslam.sources.faults import Fault, Faults
from fcslam.wire.packets import SizedPacket, decode, measure, readdress

if TYPE_CHECKING:
    from fcslam.robot.frontend3d import RobotFrontend3d

SCANS_PER_LEG: Final = 50
"""Also the scans between two reports of progress."""
LEGS_PER_TRIM: Final = 4
"""Legs after which freed memory goes back to the system: the arrays of a submap leave gaps that others do not fill."""
MOST_WAITING: Final = 64
"""Inputs that wait for a back end beside the robot; with more, the robot waits."""


@dataclass(frozen=True, slots=True)
class Leg:
    """Motion and packets of a robot over some consecutive scans of its recording."""

    robot: str
    packets: tuple[SizedPacket, ...]
    stamps: tuple[float, ...]
    """Stamps of the scans, seconds."""
    tracks: Mapping[str, Track] = field(default_factory=dict)
    """All scans, by the name of the session; empty before the last leg."""
    faults: Faults | None = None
    """Faults of the recording; None before the last leg."""

    @property
    def keyscans(self) -> int:
        """Number of keyscans."""
        return sum(isinstance(sized.packet.body, Keyscan) for sized in self.packets)


Drive = Callable[[Sequence[Source], RobotConfig], AbstractContextManager[Sequence[Iterator[Leg]]]]
"""Starts the robots and gives the legs of each; whatever still runs ends with the context."""


def one_by_one(sources: Sequence[Source], config: RobotConfig) -> AbstractContextManager[Sequence[Iterator[Leg]]]:
    """Drive each robot in this process, as far as its next leg is asked for."""
    return nullcontext([legs(source, config) for source in sources])


def side_by_side(processes: int) -> Drive:
    """Drive every robot in a process of its own, ``processes`` at a time.

    A single robot drives in this process, with its back end in another. One process does everything itself. A robot's
    error is raised where its legs are read.
    """
    if processes < 1:
        raise InputError(f"processes={processes}: no robot can be mapped; give 1 or more")

    @contextmanager
    def drive(sources: Sequence[Source], config: RobotConfig) -> Iterator[Sequence[Iterator[Leg]]]:
        if processes == 1 or not sources:
            with one_by_one(sources, config) as robots:
                yield robots
            return
        if len(sources) == 1:
            with _with_backend_beside(sources[0], config) as robot:
                yield [robot]
            return
        turns = semaphore(processes)
        streams: list[Stream[Leg]] = []
        try:
            for source in sources:
                streams.append(Stream(source.name, partial(_work, source, config, turns)))
            yield [iter(stream) for stream in streams]
        finally:
            for stream in streams:
                stream.stop()

    return drive


@contextmanager
def _with_backend_beside(source: Source, config: RobotConfig) -> Iterator[Iterator[Leg]]:
    with ExitStack() as stack:
        backend = None
        with suppress(InputError):
            backend = stack.enter_context(backend_process(source.name, config))
        yield legs(source, config, backend)


def legs(source: Source, config: RobotConfig, backend: Submit | None = None) -> Iterator[Leg]:
    """Drive one robot over its whole recording; ``backend`` is that of a robot with a 2D laser."""
    records = source.records()
    first = list(islice(records, 1))
    robot = front_end_of(source.name, config, first, backend)
    packets: list[SizedPacket] = []
    stamps: list[float] = []
    turns = cycle(range(LEGS_PER_TRIM))
    for record in chain(first, records):
        if isinstance(record, Odometry):
            continue  # scans carry their odometry
        packets += map(measure, robot.process(record))
        if robot.packets.backlog > MOST_WAITING:
            packets += map(measure, robot.ready(wait=True))
        if isinstance(record, LaserScan | CloudScan):
            stamps.append(record.stamp)
        if len(stamps) == SCANS_PER_LEG:
            yield Leg(robot.robot, tuple(packets), tuple(stamps))
            packets, stamps = [], []
            if next(turns) == 0:
                trim_memory()
    packets += map(measure, robot.finish())
    if robot.packets.failure is not None:
        raise FcslamError(f"{robot.robot}: the process of its back end failed: {robot.packets.failure}")
    faults = source.faults.plus(Fault.ODOMETRY_JUMP, robot.jumps)
    tracks = {session_name(robot.robot, epoch): track_of(poses) for epoch, poses in enumerate(robot.tracks)}
    yield Leg(robot.robot, tuple(packets), tuple(stamps), tracks, faults)


def front_end_of(
    robot: str, config: RobotConfig, first: Sequence[SensorRecord], backend: Submit | None = None
) -> "RobotFrontend | RobotFrontend3d":
    """The front end of a robot with these first records."""
    if any(isinstance(record, CloudScan) for record in first):
        from fcslam.robot.frontend3d import RobotFrontend3d

        return RobotFrontend3d(robot, config)
    return RobotFrontend(robot, config, backend)


def continued(legs: Iterator[Leg], first_session: int) -> Iterator[Leg]:
    """The legs of a robot, with sessions renumbered from ``first_session``."""
    if first_session == 0:
        yield from legs
        return
    for leg in legs:
        packets = tuple(_readdressed(sized, first_session) for sized in leg.packets)
        names = (session_name(leg.robot, first_session + epoch) for epoch in range(len(leg.tracks)))
        yield replace(leg, packets=packets, tracks=dict(zip(names, leg.tracks.values(), strict=True)))


def _readdressed(sized: SizedPacket, first_session: int) -> SizedPacket:
    packet = sized.packet
    data = readdress(sized.data, first_session + packet.epoch, packet.sequence)
    return SizedPacket(decode(data), data)


def track_of(poses: ScanTrack) -> Track:
    """A robot's scans of one session, as a run needs them."""
    return Track(poses.stamps, poses.keyscans, poses.T_keyscan_base)


def _work(source: Source, config: RobotConfig, turns: Any, send: Callable[[Leg], None]) -> None:
    """Drive one robot when it is its turn, in a process of its own.

    The first leg needs no turn: the cloud applies packets in the order of time, so it waits until each robot has begun.
    """
    drive = legs(source, config)
    send(next(drive))
    with turns:
        for leg in drive:
            send(leg)
