"""What a robot-hour and a square metre cost: CPU, bytes sent and bytes stored, from one robot to a hundred.

    python benchmarks/cost.py [--robots 1 5 20 50 100] [--keep cost.jsonl]

Ten simulated buildings, each a mission of its own. The robots of a fleet are spread evenly over them: fewer than ten
robots are in as many buildings, a hundred are ten in each. A robot drives 60 m with a LiDAR of 360 beams at 10 Hz. The
same robots are in every fleet, so the front end of each runs once.

CPU is user and system, all threads, after two robots have loaded all compiled code. "Robot": the front end with
every packet that it sends. "Cloud": decode, match, verify and solve as packets come, in the order of their stamps.
"End": the last robust solve, the fused map and the mission file. HTTP and the write of each packet come on top;
`live.py` measures them. "Sent" counts packets as a robot sends them, "stored" the mission file. Area: known cells of
the fused maps. Times are added up over the buildings, so the figures hold for any number of machines.
"""

import heapq
import itertools
import time
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np

from fcslam.cloud.report import Track
from fcslam.cloud.sessions import session_name
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulatedRobot, SimulationSettings, simulate_fleet
from fcslam.mission.driving import track_of
from fcslam.mission.mission import MissionCloud, MissionConfig
from fcslam.robot.frontend import RobotFrontend
from fcslam.wire.packets import SizedPacket, decode, measure

ROBOTS = (1, 5, 20, 50, 100)
BUILDINGS = 10
LARGEST = 10
"""Most robots in a building; its size depends on it."""
PATH_M = 60.0
SEED = 2100
"""Of the first building; not used while settings were chosen."""
KNOWN = (1, 2)
"""Cells that are free or occupied."""

HOUR = {"robots": "", "buildings": "", "robot-hours": ".2f", "robot: CPU, s": ".1f", "cloud: CPU, s": ".1f",
        "cloud, end: CPU, s": ".1f", "sent, MB": ".2f", "stored, MB": ".2f"}  # fmt: skip
AREA = {"robots": "", "buildings": "", "area, m2": ",.0f", "driven, m/m2": ".2f", "maps": "", "cloud: CPU, ms": ".1f",
        "stored, kB": ".2f"}  # fmt: skip


class Driven(NamedTuple):
    """What a robot sent over its drive."""

    packets: list[SizedPacket]
    tracks: Mapping[str, Track]
    hours: float
    scans: int
    cpu_s: float


class Spent(NamedTuple):
    """What one building cost."""

    hours: float
    robot_s: float
    cloud_s: float
    end_s: float
    sent: int
    stored: int
    area_m2: float
    maps: int


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--robots", nargs="+", type=int, default=ROBOTS, help="sizes of the fleets, 100 at most")
    parser.add_argument("--keep", type=Path, help="file that keeps finished buildings; the same one resumes")
    chosen = parser.parse_args()
    report, kept = common.Report(__file__, __doc__, chosen), common.Kept(chosen.keep)
    fleets = {robots: shares(robots) for robots in chosen.robots}
    spent: dict[tuple[int, int], Spent] = {}
    for building in range(max(map(len, fleets.values()))):
        sizes = tuple(sorted({share[building] for share in fleets.values() if building < len(share)}))
        rows = kept.rows((building, *sizes), lambda building=building, sizes=sizes: building_rows(building, sizes))
        spent |= {(building, size): Spent(*row) for size, row in zip(sizes, rows, strict=True)}
    totals = {
        robots: Spent(*map(sum, zip(*(spent[place] for place in enumerate(share)), strict=True)))
        for robots, share in fleets.items()
    }
    hours = [hour_row(robots, len(fleets[robots]), total) for robots, total in totals.items()]
    report.table("A robot-hour", HOUR, hours)
    report.table("A square metre", AREA, [area_row(n, len(fleets[n]), total) for n, total in totals.items()])
    report.write()


def shares(robots: int) -> tuple[int, ...]:
    """Robots in each building."""
    buildings = min(robots, BUILDINGS)
    return tuple(robots // buildings + (building < robots % buildings) for building in range(buildings))


def building_rows(building: int, sizes: Iterable[int]) -> Iterable[Spent]:
    """What a building costs with its first robots, for each number of them."""
    config = MissionConfig()
    settings = SimulationSettings(robots=LARGEST, path_length_m=PATH_M, camera=None, lidar=LidarSettings(rate_hz=10.0))
    robots = simulate_fleet(settings, SEED + building).robots
    warm_up()
    driven = [drive(robot, config) for robot in robots[: max(sizes)]]
    for size in sizes:
        print(f"building {building + 1}: {size} robots", flush=True)
        yield map_building(driven[:size], config)


def drive(robot: SimulatedRobot, config: MissionConfig) -> Driven:
    """The front end over a whole drive. Simulated scans are not counted."""
    frontend = RobotFrontend(robot.name, config.robot)
    packets: list[SizedPacket] = []
    cpu_s, scans = 0.0, 0
    for scan in robot.scans():
        began = time.process_time()
        packets += map(measure, frontend.process(scan))
        cpu_s += time.process_time() - began
        scans += 1
    began = time.process_time()
    packets += map(measure, frontend.finish())
    cpu_s += time.process_time() - began
    tracks = {session_name(robot.name, epoch): track_of(poses) for epoch, poses in enumerate(frontend.tracks)}
    return Driven(packets, tracks, robot.duration_s / 3600.0, scans, cpu_s)


def map_building(driven: list[Driven], config: MissionConfig) -> Spent:
    """A mission of these robots from their packets, as they would come live."""
    cloud = MissionCloud(config)
    began = time.process_time()
    for sized in heapq.merge(*(robot.packets for robot in driven), key=lambda sized: sized.packet.order):
        cloud.apply(SizedPacket(decode(sized.data), sized.data))
    applied = time.process_time()
    tracks = dict(itertools.chain(*(robot.tracks.items() for robot in driven)))
    hours = sum(robot.hours for robot in driven)
    run = cloud.run(tracks, sum(robot.scans for robot in driven))
    ended = time.process_time()
    sent = sum(len(sized.data) for robot in driven for sized in robot.packets)
    area_m2 = sum(np.isin(grid.cells, KNOWN).sum() * grid.resolution_m**2 for grid in run.maps.values())
    robot_s = sum(robot.cpu_s for robot in driven)
    return Spent(
        hours, robot_s, applied - began, ended - applied, sent, len(run.mission), float(area_m2), len(run.maps)
    )


@cache
def warm_up() -> None:
    """Load or compile every kernel of robot and cloud, once in a process."""
    config = MissionConfig()
    settings = SimulationSettings(robots=2, path_length_m=PATH_M, camera=None, lidar=LidarSettings(rate_hz=10.0))
    map_building([drive(robot, config) for robot in simulate_fleet(settings, SEED - 1).robots], config)


def hour_row(robots: int, buildings: int, spent: Spent) -> tuple[Any, ...]:
    hours = spent.hours
    cpu_s = (spent.robot_s / hours, spent.cloud_s / hours, spent.end_s / hours)
    return (robots, buildings, hours, *cpu_s, spent.sent / hours / 1e6, spent.stored / hours / 1e6)


def area_row(robots: int, buildings: int, spent: Spent) -> tuple[Any, ...]:
    area = spent.area_m2
    cloud_ms = 1e3 * (spent.cloud_s + spent.end_s) / area
    return robots, buildings, area, robots * PATH_M / area, spent.maps, cloud_ms, spent.stored / area / 1e3


if __name__ == "__main__":
    main()
