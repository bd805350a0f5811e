"""A mission: recordings in, robots, cloud, one map out. The paper's figure 1 on one screen.

sources -> robot (LiDAR SLAM, features) -> packets -> cloud (places -> graph -> fusion) -> run folder
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fcslam.cloud.fleet import Fleet, FleetConfig
from fcslam.cloud.fusion import FusedMap, fuse
from fcslam.cloud.picture import Meeting, map_png
from fcslam.cloud.result import FleetResult, MappedRobot
from fcslam.config import Settings, dump
from fcslam.errors import ConfigError, FcslamError, PacketError, SourceError
from fcslam.geometry import se2
from fcslam.graph.g2o import g2o_text
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.map_files import map_yaml, pgm_bytes
from fcslam.records import Channel, ClosureStatus, FloatArray, Keyscan, LaserScan, LoopClosure, Veto
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.runs import ClosureRow, LocalMap, Metric, RobotTrajectory, Run, check_names
from fcslam.sources import Source
from fcslam.wire.checks import check_name
from fcslam.wire.ledger import Ledger
from fcslam.wire.messages import Kind, Packet
from fcslam.wire.packets import encode
from fcslam.wire.transport import InMemoryTransport


class MissionConfig(Settings):
    """Everything that can be set; one default for all recordings."""

    seed: int = Field(default=0, ge=0, description="of the one random generator; the same seed gives the same run")
    robot: RobotConfig = Field(default=RobotConfig(), description="what runs on a robot")
    fleet: FleetConfig = Field(default=FleetConfig(), description="what runs in the cloud")
    map: OccupancyConfig = Field(default=OccupancyConfig(), description="the occupancy grid")


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a mission is."""

    scans: int
    keyscans: int
    recorded_s: float
    """Time that the recordings have played, of all robots together."""
    closures: dict[str, int]
    fusing: bool = False
    """All is recorded and sent; the cloud decides and fuses."""


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
    cloud = Fleet(config.fleet, config.seed)
    for veto in vetoes:
        cloud.veto(veto)
    transport = InMemoryTransport(cloud.receive)
    meter = _Meter(watch, cloud)
    streams = [_packets(source, robot, meter) for source, robot in zip(sources, robots, strict=True)]
    for packet in heapq.merge(*streams, key=lambda packet: packet.order):
        reply = transport.send(encode(packet))
        if reply.refusal:
            raise FcslamError(f"{packet.robot}: the cloud refused a packet: {reply.refusal}")
    meter.tell(fusing=True)
    return _run_of(robots, cloud.finalize(), transport.ledger(), config, meter)


def _packets(source: Source, robot: RobotFrontend, meter: "_Meter") -> Iterator[Packet]:
    """What one robot sends over its whole recording."""
    for record in source.records():
        packets = robot.process(record)
        if isinstance(record, LaserScan):
            meter.count(robot.robot, record.stamp, packets)
        yield from packets
    yield from robot.finish()


class _Meter:
    """Counts scans, keyscans and recorded time, and tells the watcher now and then."""

    EVERY = 50

    def __init__(self, watch: Watch, cloud: Fleet) -> None:
        self._watch = watch
        self._cloud = cloud
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
        self.keyscans += any(isinstance(packet.body, Keyscan) for packet in packets)
        if self.scans % self.EVERY == 0:
            self.tell()

    def tell(self, fusing: bool = False) -> None:
        """Where the mission is now."""
        closures = self._cloud.closure_counts()
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
        except PacketError as error:
            raise SourceError(f"{error}; a robot is named by its file, so rename it, or give NAME=LOG") from error
    check_names(names)


def _check_vetoes(vetoes: Sequence[Veto], robots: Sequence[str]) -> None:
    for name in (name for veto in vetoes for name in (veto.robot_i, veto.robot_j)):
        if name not in robots:
            raise ConfigError(f"a veto names '{name}', but the robots are {', '.join(robots)}")


def _run_of(
    robots: Sequence[RobotFrontend], result: FleetResult, ledger: Ledger, config: MissionConfig, meter: _Meter
) -> Run:
    """Collect what the run folder holds."""
    mapped = {robot.robot: robot for robot in result.robots}
    trajectories = tuple(_trajectory(robot, mapped[robot.robot]) for robot in robots)
    return Run(
        trajectories=trajectories,
        closures=tuple(_closure_row(closure, mapped) for closure in result.closures),
        metrics=(*_metrics(result, meter), *_traffic(ledger)),
        config_yaml=dump(config),
        pose_graph_g2o=g2o_text(result.graph),
        map_files=_map_files(result, trajectories, config.map),
        local_maps=tuple(_local_map(robot, mapped[robot.robot], config.map) for robot in robots),
    )


def _trajectory(robot: RobotFrontend, mapped: MappedRobot) -> RobotTrajectory:
    return RobotTrajectory(robot.robot, mapped.map_index, *_at_every_scan(robot, mapped.T_map_base))


def _local_map(robot: RobotFrontend, mapped: MappedRobot, config: OccupancyConfig) -> LocalMap:
    """What the robot would have mapped had it been alone."""
    fused = fuse(mapped.keyscans, mapped.T_local_base, {robot.robot: mapped.laser}, config)
    stamps, T_local_base = _at_every_scan(robot, mapped.T_local_base)
    return LocalMap(robot.robot, stamps, T_local_base, pgm_bytes(fused), map_yaml(fused, f"{robot.robot}.pgm"))


def _at_every_scan(robot: RobotFrontend, keyscans: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Stamps (N,) and poses (N, 3) of all scans: each hangs on its keyscan, whose poses (K, 3) are given."""
    stamps = np.array([pose.stamp for pose in robot.scan_poses])
    offsets = np.array([pose.T_keyscan_base for pose in robot.scan_poses])
    return stamps, se2.compose(keyscans[[pose.keyscan for pose in robot.scan_poses]], offsets)


def _closure_row(closure: LoopClosure, mapped: dict[str, MappedRobot]) -> ClosureRow:
    i, j = closure.i, closure.j
    return ClosureRow(
        i.robot, mapped[i.robot].keyscans[i.number].stamp, j.robot, mapped[j.robot].keyscans[j.number].stamp,
        closure.channel, closure.similarity, closure.T_i_j, closure.status, closure.reason,
    )  # fmt: skip


def _map_files(
    result: FleetResult, trajectories: Sequence[RobotTrajectory], config: OccupancyConfig
) -> dict[str, bytes]:
    """map.* of the largest map, map_<k>.* of robots that are not connected to it."""
    files: dict[str, bytes] = {}
    for k in sorted({robot.map_index for robot in result.robots}):
        members = [robot for robot in result.robots if robot.map_index == k]
        stem = "map" if k == 0 else f"map_{k}"
        fused = _fuse(members, config)
        drawn = {t.robot: t.T_map_base for t in trajectories if t.map_index == k}
        files[f"{stem}.pgm"] = pgm_bytes(fused)
        files[f"{stem}.yaml"] = map_yaml(fused, f"{stem}.pgm").encode()
        files[f"{stem}.png"] = map_png(fused, drawn, _meetings(result.closures, members))
    return files


def _fuse(members: Sequence[MappedRobot], config: OccupancyConfig) -> FusedMap:
    keyscans = [keyscan for robot in members for keyscan in robot.keyscans]
    poses: FloatArray = np.concatenate([robot.T_map_base for robot in members])
    return fuse(keyscans, poses, {robot.robot: robot.laser for robot in members}, config)


def _meetings(closures: Sequence[LoopClosure], members: Sequence[MappedRobot]) -> list[Meeting]:
    """Accepted closures between robots, as lines of the picture."""
    poses = {robot.robot: robot.T_map_base for robot in members}
    return [
        Meeting(poses[c.i.robot][c.i.number][:2], poses[c.j.robot][c.j.number][:2], c.i.robot, c.j.robot)
        for c in closures
        if c.status is ClosureStatus.ACCEPTED and c.i.robot != c.j.robot and c.i.robot in poses
    ]


def _metrics(result: FleetResult, meter: _Meter) -> list[Metric]:
    between = [c.status for c in result.closures if c.i.robot != c.j.robot]
    within = [c.status for c in result.closures if c.i.robot == c.j.robot]
    return [
        Metric("robots", len(result.robots), "1"),
        Metric("maps", len({robot.map_index for robot in result.robots}), "1"),
        Metric("scans", meter.scans, "1"),
        Metric("recorded_time", meter.recorded_s, "s"),
        Metric("keyscans", sum(len(robot.keyscans) for robot in result.robots), "1"),
        Metric("intra_robot_closures_accepted", within.count(ClosureStatus.ACCEPTED), "1"),
        Metric("intra_robot_closures_revoked", within.count(ClosureStatus.REVOKED), "1"),
        *(Metric(f"inter_robot_closures_{status}", between.count(status), "1") for status in ClosureStatus),
    ]


def _traffic(ledger: Ledger) -> list[Metric]:
    """Packets and bytes per kind of message and channel of places, of the whole fleet; bytes that each robot sent."""
    traffic = {str(kind): ledger.total(kind=kind) for kind in sorted({label.kind for label in ledger.accepted})}
    traffic |= {f"{channel}_{Kind.PLACE}": ledger.total(channel=channel) for channel in Channel}
    robots = sorted({label.robot for label in ledger.accepted})
    return [
        *(Metric(f"{name}_packets", total.count, "1") for name, total in traffic.items()),
        *(Metric(f"{name}_bytes", total.bytes, "B") for name, total in traffic.items()),
        *(Metric(f"uplink_bytes_{robot}", ledger.uplink(robot).bytes, "B") for robot in robots),
    ]
