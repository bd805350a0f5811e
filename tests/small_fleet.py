"""A small simulated fleet, what its robots send, and a result as bytes, for the tests of robot, cloud and mission."""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.result import FleetResult
from fcslam.cloud.sessions import in_session
from fcslam.cloud.settings import FleetConfig
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulatedFleet, SimulatedRobot, SimulationSettings, simulate_fleet
from fcslam.records import Change, SensorRecord
from fcslam.robot.backend_runner import Submit
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.storage.state_file import read_state, write_state
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode

PLAIN = FleetConfig()


@lru_cache
def draw(robots: int, path_length_m: float = 15.0, seed: int = 1) -> SimulatedFleet:
    lidar = LidarSettings(beams=180, rate_hz=3.0)
    settings = SimulationSettings(robots=robots, path_length_m=path_length_m, lidar=lidar, camera=None)
    return simulate_fleet(settings, seed)


def driven(
    records: Iterable[SensorRecord],
    config: RobotConfig | None = None,
    name: str = "r",
    backend: Submit | None = None,
) -> tuple[RobotFrontend, list[Packet]]:
    """The front end of a robot after a recording, and everything that it sent."""
    frontend = RobotFrontend(name, config or RobotConfig(), backend)
    packets = [packet for record in records for packet in frontend.process(record)]
    return frontend, packets + frontend.finish()


def sent_by(robot: SimulatedRobot, name: str | None = None) -> list[Packet]:
    """Everything that a robot sends over its recording."""
    return driven(robot.scans(), name=name or robot.name)[1]


def in_order(packets: Iterable[Packet]) -> list[Packet]:
    return sorted(packets, key=lambda packet: packet.order)


def feed(cloud: Cloud, packets: Iterable[Packet]) -> Cloud:
    for packet in packets:
        cloud.receive(encode(packet))
    return cloud


def restored(
    fleet: Fleet, packets: Iterable[Packet], path: Path, config: FleetConfig = PLAIN, changes: Sequence[Change] = ()
) -> Fleet:
    """The fleet by way of a file of its state."""
    write_state(path, "test", fleet.state())
    stored = {PacketNumber(in_session(packet).robot, packet.sequence): packet for packet in packets}
    return Fleet.restored(config, 0, read_state(path, "test") or {}, stored.__getitem__, changes=changes)


def fingerprint(result: FleetResult) -> tuple[object, ...]:
    """All that a result says, to the last bit."""
    robots = tuple(
        (r.robot, r.map_index, len(r.keyscans), r.T_map_base.tobytes(), r.T_local_base.tobytes(), r.lasers)
        for r in result.robots
    )
    closures = tuple(
        (c.i, c.j, c.similarity, c.T_i_j.tobytes(), c.information.tobytes(), c.status, c.reason, c.informative)
        for c in result.closures
    )
    edges = tuple((e.i, e.j, e.T_i_j.tobytes(), e.information.tobytes(), e.robust) for e in result.graph.edges)
    return robots, closures, result.graph.poses().tobytes(), edges


def contents(folder: Path) -> dict[Path, bytes]:
    """All files in a folder, to the last bit."""
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def map_of(result: FleetResult) -> dict[str, int]:
    return {robot.robot: robot.map_index for robot in result.robots}


def truth_at(robot: SimulatedRobot, stamps: Sequence[float]) -> np.ndarray:
    """True poses (N, 3) at stamps of the recording."""
    return robot.T_building_base[np.searchsorted(robot.stamps, np.asarray(stamps) - 1e-6)]
