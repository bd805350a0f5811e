"""A mission: recordings in, robots, cloud, one map out. The paper's figure 1 on one screen.

sources -> robot (LiDAR SLAM, features) -> packets -> cloud (places -> graph -> fusion) -> run folder
"""

import heapq
import itertools
import json
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import Field

from fcslam.anchoring.anchors import Anchors, anchored
from fcslam.cloud.cloud import Cloud
from fcslam.cloud.edits import in_force
from fcslam.cloud.report import Track, fuse_members, keyscan_track, run_of, traffic_metrics
from fcslam.cloud.result import FleetResult
from fcslam.cloud.sessions import check_robot, robot_and_epoch, robot_of, session_name
from fcslam.cloud.settings import CloudConfig, FleetConfig, FusionStrategy
from fcslam.config import Settings, dump
from fcslam.errors import FcslamError, InputError, PacketError, SourceError
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.lidar.pair_verification import VerifyPairs, verify_here
from fcslam.mission.driving import Drive, Leg, continued, one_by_one
from fcslam.mission.floors import on_floors
from fcslam.mission.mission_file import EMPTY, SavedMission, as_stored, mission_bytes
from fcslam.mission.mission_store import StoredPacket
from fcslam.processes import trim_memory
from fcslam.records import Edit, Keyscan, Placement, Veto
from fcslam.robot.frontend import RobotConfig
from fcslam.runs import Metric, Run, check_names
from fcslam.sources import Source
from fcslam.sources.contradictions import count_returns
from fcslam.sources.faults import Faults
from fcslam.sources.source import Doubt, Survey
from fcslam.wire.ledger import Ledger
from fcslam.wire.messages import Acknowledgement, Packet
from fcslam.wire.packets import SizedPacket, measure

_log = logging.getLogger(__name__)

AUTHOR = "fcslam map"
"""The author of vetoes that are given with the recordings."""
_KEYSCANS_SHARED = 3
"""Keyscans that two recordings share at least if they overlap: robots never measure the same numbers at one time."""


class MissionConfig(Settings):
    """All settings; the defaults serve all recordings."""

    seed: int = Field(default=0, ge=0, description="seed of the random generator; the same seed gives the same run")
    robot: RobotConfig = Field(default=RobotConfig(), description="settings of the robots")
    fleet: FleetConfig = Field(default=FleetConfig(), description="settings of the cloud")
    map: OccupancyConfig = Field(default=OccupancyConfig(), description="the occupancy grid")

    @property
    def cloud(self) -> CloudConfig:
        """The part that a mission stores."""
        return CloudConfig.model_validate({key: getattr(self, key) for key in CloudConfig.model_fields})


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a mission."""

    scans: int
    keyscans: int
    closures: dict[str, int]
    fusing: bool = False
    """Whether all packets are sent, and the cloud decides and fuses."""
    faults: Mapping[str, Faults] = field(default_factory=dict)
    """Faults of the recordings that were read to their end, by robot."""


Watch = Callable[[Progress], None]


Live = Callable[["MissionCloud"], None]
"""Called after every packet; it may look at the cloud, and changes nothing."""


@dataclass(frozen=True, slots=True)
class MissionInputs:
    """What a mission knows before its recordings, and where it verifies closures."""

    onto: SavedMission = EMPTY
    """An earlier mission that goes on; its packets take effect again, and the result is that of all recordings at once.
    A robot of it that has a recording again begins a new session."""
    vetoes: tuple[Veto, ...] = ()
    """Closures that must not count."""
    floors: Mapping[str, str] = field(default_factory=dict)
    """Floor of each recording that has one, by its robot's name, or by NAME@TIME from a time on, in seconds since the
    first scan. Places of different floors are never compared."""
    anchors: Anchors = Anchors()  # noqa: RUF009
    """What is known about the building; it places the maps, and joins none."""
    verify_pairs: VerifyPairs = verify_here
    """Verifies pairs of submaps, here or elsewhere; the run is the same."""


def continued_config(earlier: SavedMission) -> MissionConfig:
    """The default configuration, with the cloud's settings of an earlier mission."""
    return MissionConfig.model_validate(dict(earlier.config))


def run_mission(
    sources: Sequence[Source],
    config: MissionConfig,
    watch: Watch = lambda _: None,
    inputs: MissionInputs = MissionInputs(),
    drive: Drive = one_by_one,
    live: Live = lambda _: None,
) -> Run:
    """Map recordings together, one robot each; ``drive`` runs the robots."""
    onto = inputs.onto
    check_robots(sources)
    recordings = [source.name for source in sources]
    known = [*onto.robots, *recordings]
    _check_known("a veto", (name for veto in inputs.vetoes for name in (veto.robot_i, veto.robot_j)), known)
    _check_known("a start", config.fleet.starts, known)
    if config.fleet.dimensions == 3 and inputs.anchors != Anchors():
        raise InputError("floor plans and surveyed tags place maps in the plane; leave them out with --3d")
    sources = on_floors(sources, inputs.floors)
    cloud = MissionCloud(config, inputs)
    meter = _Meter(watch, cloud, known)
    with drive(sources, config.robot) as robots:
        new = [continued(legs, onto.session_count(name)) for legs, name in zip(robots, recordings, strict=True)]
        earlier = itertools.chain(*onto.packets.values())
        sessions = {key: f"{name} of the earlier mission" for sent in earlier for key, name in _keyscan(sent)}
        streams = [_without_copies(_packets(legs, meter), sessions) for legs in new]
        streams += [_packets(legs, meter) for legs in onto.legs()]
        for sent in heapq.merge(*streams, key=lambda sent: sent.packet.order):
            cloud.apply(sent)
            live(cloud)
    meter.report(fusing=True)
    return cloud.run(meter.tracks, meter.scans)


def doubted(run: Run, surveys: Mapping[str, Survey]) -> Run:
    """The run, with what the recording of each robot says against its map in the map's certificate."""
    doubts = {name: [note for note in survey.notes if isinstance(note, Doubt)] for name, survey in surveys.items()}
    if not any(doubts.values()) or not run.quality:
        return run
    certificates = json.loads(run.quality)
    for index, certificate in certificates.items():
        members = {robot_of(its.robot): None for its in run.trajectories.values() if str(its.map_index) == index}
        certificate["doubts"] = [doubt for robot in members for doubt in doubts.get(robot, ())]
    return replace(run, quality=json.dumps(certificates, separators=(",", ":")).encode())


class MissionCloud:
    """The cloud of a mission within one process; it counts what is sent, without acknowledgements."""

    def __init__(self, config: MissionConfig, inputs: MissionInputs = MissionInputs()) -> None:
        """Begin with the edits and the refused packets of an earlier mission; its other packets are still to come."""
        self.config, self._inputs, onto = config, inputs, inputs.onto
        self.host = Cloud(config.fleet, config.seed, inputs.verify_pairs, config.map)
        """The fleet."""
        self._traffic = Ledger()
        self._packets: list[StoredPacket] = []
        self._refused = onto.refused
        numbers = itertools.count(len(onto.edits) + 1)
        self.host.follow([*onto.edits, *(Edit(next(numbers), AUTHOR, 0.0, veto) for veto in inputs.vetoes)])
        for packet in onto.refused:
            self.host.refuse(packet.robot, packet.epoch, packet.sequence)

    def apply(self, sent: SizedPacket) -> list[Packet]:
        """Apply the next packet of a robot; returns the replies to it."""
        try:
            replies = self.host.apply(sent.packet)
        except PacketError as error:
            raise FcslamError(f"{sent.packet.robot}: the cloud refused a packet: {error}") from error
        self._packets.append(as_stored(sent))
        news = (reply for reply in replies if not isinstance(reply.body, Acknowledgement))
        for packet in (sent, *map(measure, news)):
            self._traffic.accept(packet.label, len(packet.data))
        return replies

    def run(self, tracks: Mapping[str, Track], scans: int) -> Run:
        """The result of all packets so far.

        Args:
            tracks: the scans of the sessions, in their order. Other sessions come first, with their keyscans alone.
            scans: number of scans.
        """
        trim_memory()  # the robots have ended, and each step below needs much for a moment
        result = self.host.finalize()
        trim_memory()
        unknown = {robot.robot: keyscan_track(robot) for robot in result.robots if robot.robot not in tracks}
        mapped = {robot.robot for robot in result.robots}
        tracks = unknown | {name: track for name, track in tracks.items() if name in mapped}
        recorded_s = sum(float(np.ptp(track.stamps)) for track in tracks.values() if len(track.stamps))
        counts = (Metric("scans", scans, "1"), Metric("recorded_time", recorded_s, "s"))
        metrics = (*counts, *traffic_metrics(self._traffic, tracks))
        mission = mission_bytes(self.config.cloud, self.host.edits, self._packets, self._refused, tracks)
        placed, files = self._placed(result)
        run = run_of(
            placed,
            tracks,
            metrics,
            dump(self.config),
            self.config.map,
            with_certificates=self.config.fleet.fusion is FusionStrategy.JOINT,  # rigid maps do not solve the graph
            measured=result.graph,
        )
        run = replace(run, map_files={**run.map_files, **files})
        return replace(run, mission=mission)

    def _placed(self, result: FleetResult) -> tuple[FleetResult, dict[str, bytes]]:
        if self.config.fleet.dimensions == 3:  # what anchors say is of the plane
            return result, {}
        anchors, is_fixed = self._inputs.anchors, any(robot.fixes for robot in result.robots)
        if anchors == Anchors() and not is_fixed and not result.sightings:
            return result, {}
        by_hand = {change.session for change in in_force(self.host.edits) if isinstance(change, Placement)}
        placed = {robot.map_index for robot in result.robots if robot.robot in by_hand}
        return anchored(result, anchors, placed, lambda members: fuse_members(members, self.config.map))


def _packets(legs: Iterator[Leg], meter: "_Meter") -> Iterator[SizedPacket]:
    for leg in legs:
        meter.count(leg)
        yield from leg.packets


def _without_copies(packets: Iterator[SizedPacket], sessions: dict[int, str]) -> Iterator[SizedPacket]:
    """The packets of a recording, which must not share scans with another one, whatever names and formats they have.

    Args:
        packets: those of the recording.
        sessions: the session of each keyscan that is known; those of the recording are added.

    Raises:
        SourceError: the recording shares ``_KEYSCANS_SHARED`` keyscans with another session.
    """
    shared: Counter[str] = Counter()
    for sent in packets:
        for key, name in _keyscan(sent):
            other = sessions.setdefault(key, name)
            shared[other] += other != name
            if shared[other] == _KEYSCANS_SHARED:
                raise SourceError(
                    f"{name} and {other} have the same scans at {sent.packet.time:.3f} s, so they are copies or "
                    "overlapping parts of one recording; give each scan once"
                )
        yield sent


def _keyscan(sent: SizedPacket) -> Iterator[tuple[int, str]]:
    """A number that copies of a keyscan share, and its session; nothing without a return and for other packets."""
    packet, body = sent.packet, sent.packet.body
    if isinstance(body, Keyscan) and count_returns(body.ranges_m, math.inf):
        key = hash((round(body.stamp, 3), body.ranges_m.tobytes()))  # formats round stamps to a millisecond
        yield key, session_name(packet.robot, packet.epoch)


class _Meter:
    def __init__(self, watch: Watch, cloud: MissionCloud, robots: Sequence[str]) -> None:
        self._watch = watch
        self._cloud = cloud
        self._faults: dict[str, Faults] = {}
        self.scans = self.keyscans = 0
        self._tracks: dict[str, dict[str, Track]] = {robot: {} for robot in robots}
        """By robot and session, of the robots that are done."""

    @property
    def tracks(self) -> dict[str, Track]:
        """The scans of the robots that are done, by session; robots and their sessions in order."""
        by_robot = (sorted(robot.items(), key=lambda item: robot_and_epoch(item[0])) for robot in self._tracks.values())
        return dict(itertools.chain.from_iterable(by_robot))

    def count(self, leg: Leg) -> None:
        """One more leg of a robot."""
        self.scans += len(leg.stamps)
        self.keyscans += leg.keyscans
        if leg.faults is None:
            self.report()
        else:
            self._tracks[leg.robot] |= leg.tracks
            self._faults[leg.robot] = leg.faults

    def report(self, fusing: bool = False) -> None:
        """Report the progress now."""
        closures = self._cloud.host.fleet.closure_counts()
        self._watch(Progress(self.scans, self.keyscans, closures, fusing, self._faults.copy()))


def check_robots(sources: Sequence[Source]) -> None:
    """Check that each recording names a robot of its own."""
    names = [source.name for source in sources]
    for name in names:
        if names.count(name) > 1:
            raise SourceError(
                f"two recordings are called '{name}'; a robot is named by its file, so name one: NAME=LOG"
            )
        try:
            check_robot(name)
        except PacketError as error:
            raise SourceError(f"{error}; a robot is named by its file, so rename it, or give NAME=LOG") from error
    check_names(names)


def _check_known(what: str, names: Iterable[str], robots: Sequence[str]) -> None:
    for name in names:
        if robot_of(name) not in robots:
            raise InputError(f"{what} names '{name}', but the robots are {', '.join(robots)}")
