"""Robots that are picked up and put down elsewhere: do they notice, and does the fleet find them again?

    python benchmarks/relocalization.py

Two robots map a simulated building by LiDAR. Half-way through its drive one is put down at least 10 m away, turned by
at least 30 degrees; its wheels never notice (odometry goes on), and it drives on there. Per building and seed:

- lost: the front end ended its session and began another, after so many metres driven and seconds since;
- found: the new session's first correction that is borne out at all (quality over 0) puts the robot within 0.3 m and
  5 degrees of where it is, after so many metres; wrong: it puts the robot elsewhere; -: by the end it was not found;
- map error: RMSE and maximum of the distance of all keyscans in the first robot's map from the truth, that map moved
  onto it as a whole, and the share of keyscans that are in other maps; with the detection, and blind, without it
  (`robot.lost.doubted` = 0);
- false alarms: sessions begun on the same robots' own drives, where nothing happens.

Quality: of every correction of the kidnapped robot from the kidnapping on, by whether it is right (0.3 m, 5 degrees).
Seeds below 100 chose the settings; those here were not looked at.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import common
import numpy as np

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.sessions import session_name
from fcslam.geometry import se2
from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.simulated_fleet import SimulatedRobot, SimulationSettings, simulate_fleet
from fcslam.lidar.lost import LostConfig
from fcslam.metrics.trajectory import align, position_errors
from fcslam.mission.mission import MissionConfig
from fcslam.records import Channel, Constraint, ConstraintKind, Correction, FloatArray, Keyscan, LaserScan, frozen
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.wire.messages import Packet
from fcslam.wire.packets import decode, encode

BUILDINGS = ("default", "office")
SEEDS = tuple(range(101, 111))
PATH_M = 60.0
LEAST_M, LEAST_RAD = 10.0, np.deg2rad(30.0)
RIGHT_M, RIGHT_RAD = 0.3, np.deg2rad(5.0)
WATCHED = RobotConfig(channels=(Channel.LIDAR,))
BLIND = WATCHED.model_copy(update={"lost": LostConfig(doubted=0.0)})
QUALITIES = (0.25, 0.5, 0.75)

COLUMNS = {"building": "", "seed": "", "put down, m away": ".1f", "lost": "", "after, m": ".1f", "after, s": ".0f",
           "found": "", "after, m ": ".1f", "off, m": ".3f", "off, deg": ".1f", "map RMSE, m": ".3f", "max, m": ".3f",
           "elsewhere": ".2f", "blind: RMSE, m": ".3f", "max, m ": ".3f", "elsewhere ": ".2f"}  # fmt: skip


@dataclass(frozen=True)
class Drive:
    """What one robot sensed, and where it was."""

    name: str
    scans: list[LaserScan]
    T_building_base: FloatArray
    """At each scan, shape (N, 3)."""

    def truth(self, stamps: Sequence[float] | FloatArray) -> FloatArray:
        """Poses (M, 3) at stamps of scans."""
        known = np.array([scan.stamp for scan in self.scans])
        return self.T_building_base[np.searchsorted(known, np.asarray(stamps) - 1e-6)]

    def travel_m(self, first: int, last: int) -> float:
        """Way driven between two scans."""
        return float(np.hypot(*np.diff(self.T_building_base[first : last + 1, :2], axis=0).T).sum())


@dataclass(frozen=True)
class Told:
    """One correction, against the truth."""

    session: int
    stamp: float
    quality: float
    off_m: float
    off_rad: float

    @property
    def is_right(self) -> bool:
        return self.off_m <= RIGHT_M and bool(self.off_rad <= RIGHT_RAD)


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--buildings", nargs="+", choices=[str(b) for b in Building], default=BUILDINGS)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the fleets")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows, told, alarms, hours = [], {"with": [], "without": []}, 0, 0.0
    for building in chosen.buildings:
        for seed in chosen.seeds:
            drives = recorded(building, seed)
            calm = [driven(drive, WATCHED) for drive in drives]
            alarms += sum(len(sessions) for _, sessions in calm)
            hours += sum(drive.scans[-1].stamp - drive.scans[0].stamp for drive in drives) / 3600.0
            kidnapped, moment = kidnap(drives[1], drives[2], np.random.default_rng(seed))
            if moment:
                rows.append((building, seed, *row((drives[0], kidnapped), calm[0][0], moment, told)))
                print(*rows[-1], flush=True)
    report.table("Summary", {"": "", "value": ".2f"}, summary(rows, alarms, hours))
    columns = {"corrections": "", "number": "", "quality 0": ".3f", **{f"over {q}": ".3f" for q in QUALITIES},
               "median": ".2f"}  # fmt: skip
    report.table("Quality", columns, qualities(told))
    report.table("Kidnappings", COLUMNS, rows)
    report.write()


def recorded(building: str, seed: int) -> list[Drive]:
    settings = SimulationSettings(building=Building(building), robots=3, path_length_m=PATH_M, camera=None)
    return [_drive(robot) for robot in simulate_fleet(settings, seed).robots]


def _drive(robot: SimulatedRobot) -> Drive:
    return Drive(robot.name, list(robot.scans()), robot.T_building_base)


def kidnap(a: Drive, b: Drive, rng: np.random.Generator) -> tuple[Drive, int]:
    """The first half of one drive and what follows of another, from far away and turned; the number of its first scan.

    That number is 0 if the building is too small.
    """
    half = len(a.scans) // 2
    here, last = a.T_building_base[half - 1], a.scans[half - 1]
    away = np.hypot(*(b.T_building_base[:, :2] - here[:2]).T)
    turned = np.abs(se2.wrap_angle(b.T_building_base[:, 2] - here[2]))
    possible = np.flatnonzero((away >= LEAST_M) & (turned >= LEAST_RAD) & (np.arange(len(away)) < len(away) // 2))
    if not len(possible):
        return a, 0
    start = int(rng.choice(possible))
    there = b.scans[start]
    rest = [
        replace(scan, stamp=last.stamp + scan.stamp - there.stamp + 0.1, T_odom_base=frozen(
            se2.compose(last.T_odom_base, se2.between(there.T_odom_base, scan.T_odom_base))
        ))
        for scan in b.scans[start:]
    ]  # fmt: skip
    return Drive(a.name, a.scans[:half] + rest, np.vstack((a.T_building_base[:half], b.T_building_base[start:]))), half


def driven(drive: Drive, config: RobotConfig) -> tuple[list[Packet], list[int]]:
    """What the robot says, and the scans at which sessions began on the way."""
    robot, packets, begun = RobotFrontend(drive.name, config), [], []
    for number, scan in enumerate(drive.scans):
        sessions = len(robot.tracks)
        packets += robot.process(scan)
        begun += [number] * (len(robot.tracks) - sessions)
    return packets + robot.finish(), begun


def row(drives: tuple[Drive, Drive], others: list[Packet], moment: int, told: dict[str, list[Told]]) -> tuple:
    """One kidnapping, of the second of two robots; ``others``: what the first says."""
    drive = drives[1]
    packets, begun = driven(drive, WATCHED)
    corrections, errors = mission(drives, others, packets)
    blind_corrections, blind_errors = mission(drives, others, driven(drive, BLIND)[0])
    since = drive.scans[moment].stamp
    told["with"] += [one for one in corrections if one.stamp >= since]
    told["without"] += [one for one in blind_corrections if one.stamp >= since]
    noticed = next((number for number in begun if number >= moment), None)
    first = next((one for one in corrections if one.session and one.stamp >= since and one.quality > 0.0), None)
    lost = (False, np.nan, np.nan) if noticed is None else (
        True, drive.travel_m(moment, noticed), drive.scans[noticed].stamp - since
    )  # fmt: skip
    if first is None:
        found = ("-", np.nan, np.nan, np.nan)
    else:
        at = next(k for k, scan in enumerate(drive.scans) if scan.stamp >= first.stamp - 1e-6)
        off = first.off_m, np.rad2deg(first.off_rad)
        found = ("right" if first.is_right else "wrong", drive.travel_m(moment, at), *off)
    away = float(np.hypot(*np.diff(drive.T_building_base[moment - 1 : moment + 1, :2], axis=0)[0]))
    return away, *lost, *found, *errors, *blind_errors


def mission(
    drives: tuple[Drive, Drive], others: list[Packet], packets: list[Packet]
) -> tuple[list[Told], tuple[float, float, float]]:
    """Corrections of the second robot as they come; in the end RMSE, maximum, share of keyscans in other maps."""
    drive = drives[1]
    cloud = Cloud(MissionConfig().fleet, 0)
    chains: dict[int, list[FloatArray]] = {}
    origins: dict[str, FloatArray] = {}
    newest, corrections = 0.0, []
    for packet in heapq.merge(others, packets, key=lambda packet: packet.order):
        replies = cloud.receive(encode(packet))
        if isinstance(packet.body, Keyscan) and packet.body.id.number == 0:
            of = next(one for one in drives if one.name == packet.robot)
            origins[session_name(packet.robot, packet.epoch)] = of.truth([packet.body.stamp])[0]
        if packet.robot != drive.name:
            continue
        chain = chains.setdefault(packet.epoch, [np.zeros(3)])
        match packet.body:
            case Constraint(kind=ConstraintKind.ODOMETRY) as motion:
                chain.append(se2.compose(chain[-1], motion.T_i_j))
                newest = packet.time
        for body in (decode(data).body for data in replies):
            if isinstance(body, Correction):
                # A map's origin is the first keyscan of its oldest session.
                oldest = next(c.robot for c in cloud.fleet.corrections() if c.map_index == body.map_index)
                estimate = se2.compose(origins[oldest], se2.compose(body.T_map_odom, chain[-1]))
                off = se2.between(drive.truth([newest])[0], estimate)
                off_m, off_rad = float(np.hypot(off[0], off[1])), abs(float(off[2]))
                corrections.append(Told(packet.epoch, newest, body.quality, off_m, off_rad))
    return corrections, final_errors(cloud, drives)


def true_poses(robot, drives: Sequence[Drive]) -> FloatArray:
    """At a session's keyscans."""
    names = {session_name(drive.name, epoch): drive for drive in drives for epoch in range(20)}
    return names[robot.robot].truth(robot.stamps)


def final_errors(cloud: Cloud, drives: Sequence[Drive]) -> tuple[float, float, float]:
    robots = cloud.finalize().robots
    home = next(robot.map_index for robot in robots if robot.robot == drives[0].name)
    here = [robot for robot in robots if robot.map_index == home]
    truth = np.vstack([true_poses(robot, drives) for robot in here])
    poses = np.vstack([robot.T_map_base for robot in here])
    off = position_errors(align(truth, poses), truth, poses)
    total = sum(len(robot.stamps) for robot in robots)
    return float(np.sqrt(np.mean(off**2))), float(off.max()), 1.0 - len(poses) / total


def summary(rows: list[tuple], alarms: int, hours: float) -> Iterator[tuple[str, float]]:
    some = [dict(zip(COLUMNS, row, strict=True)) for row in rows]

    def median(name: str) -> float:
        return float(np.nanmedian([row[name] for row in some]))

    yield "kidnappings", len(some)
    yield "noticed", sum(row["lost"] for row in some)
    yield "after, m (median)", median("after, m")
    yield "after, s (median)", median("after, s")
    for found in ("right", "wrong"):
        yield f"found, {found}", sum(row["found"] == found for row in some)
    yield "found after, m (median)", median("after, m ")
    yield "false alarms", alarms
    yield "hours driven without a kidnapping", hours
    for name in ("map RMSE, m", "max, m", "elsewhere", "blind: RMSE, m", "max, m ", "elsewhere "):
        kind = "without detection, " if name.endswith(" ") or name.startswith("blind") else "with detection, "
        yield f"{kind}{name.removeprefix('blind: ').strip()}: median", median(name)
        yield f"{kind}{name.removeprefix('blind: ').strip()}: worst", max(row[name] for row in some)


def qualities(told: dict[str, list[Told]]) -> Iterator[tuple]:
    for which, all_of_them in told.items():
        for kind, right in (("right", True), ("wrong", False)):
            values = np.array([one.quality for one in all_of_them if one.is_right is right])
            shares = [float(np.mean(values > q)) for q in QUALITIES] if len(values) else [np.nan] * len(QUALITIES)
            nothing = float(np.mean(values == 0.0)) if len(values) else np.nan
            middle = float(np.median(values)) if len(values) else np.nan
            yield f"{which} detection, {kind}", len(values), nothing, *shares, middle


if __name__ == "__main__":
    main()
