"""A mission: recordings in, robots, cloud, one map out. The paper's figure 1 on one screen.

sources -> robot (LiDAR SLAM, features) -> packets -> cloud (places -> graph -> fusion) -> run folder
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from pydantic import Field

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.report import Track, run_of, traffic_metrics
from fcslam.cloud.sessions import check_robot, robot_of, session_name
from fcslam.cloud.settings import FleetConfig
from fcslam.config import Settings, dump
from fcslam.errors import ConfigError, FcslamError, PacketError, SourceError
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.metrics.jumps import JumpLimits
from fcslam.records import Keyscan, LaserScan, Veto
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.track import ScanTrack
from fcslam.runs import Metric, Run, check_names
from fcslam.sources import Source
from fcslam.wire.checks import check_name
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode
from fcslam.wire.transport import InMemoryTransport


class MissionConfig(Settings):
    """All settings; the defaults serve all recordings."""

    seed: int = Field(default=0, ge=0, description="seed of the random generator; the same seed gives the same run")
    robot: RobotConfig = Field(default=RobotConfig(), description="settings of the robots")
    fleet: FleetConfig = Field(default=FleetConfig(), description="settings of the cloud")
    map: OccupancyConfig = Field(default=OccupancyConfig(), description="the occupancy grid")
    jumps: JumpLimits = Field(default=JumpLimits(), description="limits of motion beyond which `fcslam map` warns")


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a mission."""

    scans: int
    keyscans: int
    recorded_s: float
    """Recorded time so far, summed over the robots, in seconds."""
    closures: dict[str, int]
    fusing: bool = False
    """Whether all packets are sent, and the cloud decides and fuses."""


Watch = Callable[[Progress], None]


def run_mission(
    sources: Sequence[Source], config: MissionConfig, watch: Watch = lambda _: None, vetoes: Sequence[Veto] = ()
) -> Run:
    """Map recordings together, one robot each, without the closures of ``vetoes``.

    Raises:
        SourceError: two recordings have one name, or one cannot be read.
        ConfigError: a veto names a robot that is not there.
        OutputError: a robot's name cannot be a file name.
    """
    _check_robots(sources)
    _check_vetoes(vetoes, [source.name for source in sources])
    robots = [RobotFrontend(source.name, config.robot) for source in sources]
    cloud = Cloud(config.fleet, config.seed)
    for veto in vetoes:
        cloud.fleet.veto(veto)
    transport = InMemoryTransport(cloud.receive)
    meter = _Meter(watch, cloud.fleet)
    streams = [_packets(source, robot, meter) for source, robot in zip(sources, robots, strict=True)]
    for packet in heapq.merge(*streams, key=lambda packet: packet.order):
        reply = transport.send(encode(packet))
        if reply.refusal:
            raise FcslamError(f"{packet.robot}: the cloud refused a packet: {reply.refusal}")
    meter.report(fusing=True)
    scans = (Metric("scans", meter.scans, "1"), Metric("recorded_time", meter.recorded_s, "s"))
    tracks = {
        session_name(robot.robot, epoch): _track(poses) for robot in robots for epoch, poses in enumerate(robot.tracks)
    }
    metrics = (*scans, *traffic_metrics(transport.ledger(), tracks))
    return run_of(cloud.finalize(), tracks, metrics, dump(config), config.map)


def _packets(source: Source, robot: RobotFrontend, meter: "_Meter") -> Iterator[Packet]:
    """The packets that one robot sends over its recording."""
    for record in source.records():
        packets = robot.process(record)
        if isinstance(record, LaserScan):
            meter.count(robot.robot, record.stamp, packets)
        yield from packets
    yield from robot.finish()


class _Meter:
    """Counts scans, keyscans and recorded time, and reports the progress."""

    EVERY = 50

    def __init__(self, watch: Watch, fleet: Fleet) -> None:
        self._watch = watch
        self._fleet = fleet
        self._span: dict[str, tuple[float, float]] = {}
        self.scans = self.keyscans = 0

    @property
    def recorded_s(self) -> float:
        """Time between the first and the last scan, of all robots together."""
        return sum(last - first for first, last in self._span.values())

    def count(self, robot: str, stamp: float, packets: Sequence[Packet]) -> None:
        """One more scan."""
        first, last = self._span.get(robot, (stamp, stamp))
        self._span[robot] = min(first, stamp), max(last, stamp)
        self.scans += 1
        self.keyscans += sum(isinstance(packet.body, Keyscan) for packet in packets)
        if self.scans % self.EVERY == 0:
            self.report()

    def report(self, fusing: bool = False) -> None:
        """Report the progress now."""
        closures = self._fleet.closure_counts()
        self._watch(Progress(self.scans, self.keyscans, self.recorded_s, closures, fusing))


def _check_robots(sources: Sequence[Source]) -> None:
    names = [source.name for source in sources]
    for name in names:
        if names.count(name) > 1:
            raise SourceError(
                f"two recordings are called '{name}'; a robot is named by its file, so name one: NAME=LOG"
            )
        try:
            check_name(name, "robot")
            check_robot(name)
        except PacketError as error:
            raise SourceError(f"{error}; a robot is named by its file, so rename it, or give NAME=LOG") from error
    check_names(names)


def _check_vetoes(vetoes: Sequence[Veto], robots: Sequence[str]) -> None:
    for name in (name for veto in vetoes for name in (veto.robot_i, veto.robot_j)):
        if robot_of(name) not in robots:
            raise ConfigError(f"a veto names '{name}', but the robots are {', '.join(robots)}")


def _track(poses: ScanTrack) -> Track:
    return Track(poses.stamps, poses.keyscans, poses.T_keyscan_base)
