"""One of four robots lies about its places or its closures: what the others' paths are while it is there, and after.

    python benchmarks/byzantine.py [--fleets 10]

Four simulated robots drive in one flat; the last one is hostile, and its packets come among those of the others. Each
kind of lie is mapped in each fleet, then the robot is removed. The absolute trajectory error (RMSE) is that of the
three honest robots in their maps, against the truth; each map is aligned rigidly.

Lies
- shifted places: each place has the descriptors of one that was seen later
- mirrored places: the keypoints of each place are mirrored
- copied places: places are those of the first robot
- copied scans: keyscans and places are those of the first robot, with motions of its own
- closures of 10 m more: 10 m is added to every closure that the robot reports, as in Byzantine attacks on Swarm-SLAM
"""

from collections.abc import Callable
from dataclasses import replace

import common
import numpy as np
from hostile_sessions import Stream, in_order, is_refused, sent

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.result import FleetResult
from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulatedFleet, SimulationSettings, simulate_fleet
from fcslam.records import Constraint, ConstraintKind, FloatArray, Keyscan, Place, Removal, frozen
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.wire.messages import Packet

COLUMNS = {
    "lie": "", "fleets": "d", "in a map with others": "d", "packets refused": ",d", "ATE, median ratio": ".3f",
    "ATE, largest ratio": ".3f", "ratio over 1.2": "d", "honest robots separated": "d", "same bytes after": "d",
}  # fmt: skip
ROBOTS, LATER = 4, 5
"""Robots of a fleet; a shifted place is that of so many places later."""

Lie = Callable[[Stream, Stream], Stream]
"""Changes the hostile robot's packets, given those of the first robot."""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--fleets", type=int, default=10)
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows: dict[str, list[tuple[object, ...]]] = {name: [] for name in LIES}
    closures = []
    for seed in range(chosen.fleets):
        lidar = LidarSettings(beams=180, rate_hz=3.0)
        fleet = simulate_fleet(SimulationSettings(robots=ROBOTS, path_length_m=18.0, lidar=lidar, camera=None), seed)
        streams = [sent(RobotFrontend(robot.name, RobotConfig()), robot.scans()) for robot in fleet.robots]
        *honest, hostile = streams
        alone, _ = mapped(in_order(*honest))
        error_m = trajectory_error(fleet, alone)
        closures.append(sum(is_closure(packet) for packet in hostile))
        for name, lie in LIES.items():
            row = judged(fleet, alone, error_m, honest, lie(hostile, honest[0]))
            rows[name].append(row)
            print(seed, name, *row, flush=True)
    report.say(f"The hostile robot reports {min(closures)} to {max(closures)} closures of its own in a fleet.")
    report.table("Lies of one robot of four", COLUMNS, [summary(name, some) for name, some in rows.items()])
    report.write()


def judged(
    fleet: SimulatedFleet, alone: FleetResult, error_m: float, honest: list[Stream], hostile: Stream
) -> tuple[object, ...]:
    """Whether the hostile robot shares a map, refused packets, ratio of errors, separations, and the same bytes."""
    liar = hostile[0].robot
    found, cloud, refused = attacked(honest, hostile)
    maps = {robot.robot: robot.map_index for robot in found.robots}
    joined = sum(index == maps.get(liar) for index in maps.values()) > 1
    ratio = trajectory_error(fleet, found, liar) / error_m
    before = {robot.robot: robot.map_index for robot in alone.robots}
    pairs = [(a, b) for a in before for b in before if a < b and before[a] == before[b]]
    apart = any(maps[a] != maps[b] for a, b in pairs)
    cloud.fleet.edit([Removal(liar, packet.epoch) for packet in hostile[:1]])
    return joined, refused, ratio, apart, paths(cloud.finalize()) == paths(alone)


def summary(name: str, rows: list[tuple[object, ...]]) -> tuple[object, ...]:
    joined, refused, ratios, apart, same = (np.array(column) for column in zip(*rows, strict=True))
    return (
        name, len(rows), int(joined.sum()), int(refused.sum()), float(np.median(ratios)), float(ratios.max()),
        int((ratios > 1.2).sum()), int(apart.sum()), int(same.sum()),
    )  # fmt: skip


def mapped(packets: Stream) -> tuple[FleetResult, Cloud]:
    cloud = Cloud(FleetConfig(), 0)
    for packet in packets:
        cloud.apply(packet)
    return cloud.finalize(), cloud


def attacked(honest: list[Stream], hostile: Stream) -> tuple[FleetResult, Cloud, int]:
    """The result with the hostile robot, the cloud, and how many of the packets were refused."""
    cloud = Cloud(FleetConfig(), 0)
    refused = sum(is_refused(packet, cloud.apply) for packet in in_order(*honest, hostile))
    return cloud.finalize(), cloud, refused


def trajectory_error(fleet: SimulatedFleet, result: FleetResult, liar: str = "") -> float:
    """RMSE of the positions of all robots but one; each map is aligned to the truth."""
    squared = []
    truth = {robot.name: robot for robot in fleet.robots}
    for index in {robot.map_index for robot in result.robots}:
        robots = [robot for robot in result.robots if robot.map_index == index and robot.robot != liar]
        if robots:
            found = np.concatenate([robot.T_map_base[:, :2] for robot in robots])
            true = np.concatenate([true_xy(truth[robot.robot].truth, robot.stamps) for robot in robots])
            squared.append(((se2.transform(n_point_alignment(true, found), found) - true) ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squared).mean()))


def true_xy(truth: tuple[FloatArray, FloatArray], stamps: FloatArray) -> FloatArray:
    return np.stack([np.interp(stamps, truth[0], truth[1][:, axis]) for axis in (0, 1)], axis=1)


def paths(result: FleetResult) -> dict[str, tuple[int, bytes]]:
    return {robot.robot: (robot.map_index, robot.T_map_base.tobytes()) for robot in result.robots}


def changed(stream: Stream, change: Callable[[Packet], object]) -> Stream:
    return [replace(packet, body=change(packet)) for packet in stream]


def is_closure(packet: Packet) -> bool:
    return isinstance(packet.body, Constraint) and packet.body.kind is not ConstraintKind.ODOMETRY


def places_of(stream: Stream) -> list[Place]:
    return [packet.body for packet in stream if isinstance(packet.body, Place)]


def with_places(stream: Stream, others: list[Place]) -> Stream:
    """The packets, with descriptors and keypoints of other places, one after another."""
    rest = iter(others * (1 + len(places_of(stream)) // max(1, len(others))))

    def change(packet: Packet) -> object:
        if not isinstance(packet.body, Place):
            return packet.body
        other = next(rest)
        return replace(packet.body, descriptors=other.descriptors, keypoints=other.keypoints)

    return changed(stream, change)


def shifted(hostile: Stream, _: Stream) -> Stream:
    places = places_of(hostile)
    return with_places(hostile, places[LATER:] + places[:LATER])


def mirrored(hostile: Stream, _: Stream) -> Stream:
    def change(packet: Packet) -> object:
        if not isinstance(packet.body, Place):
            return packet.body
        return replace(packet.body, keypoints=frozen(packet.body.keypoints * (1.0, -1.0), np.float32))

    return changed(hostile, change)


def copied_places(hostile: Stream, other: Stream) -> Stream:
    return with_places(hostile, places_of(other))


def copied_scans(hostile: Stream, other: Stream) -> Stream:
    scans = [packet.body for packet in other if isinstance(packet.body, Keyscan)]

    def change(packet: Packet) -> object:
        if not isinstance(packet.body, Keyscan):
            return packet.body
        return replace(packet.body, ranges_m=scans[packet.body.id.number % len(scans)].ranges_m)

    return with_places(changed(hostile, change), places_of(other))


def ten_metres(hostile: Stream, _: Stream) -> Stream:
    def change(packet: Packet) -> object:
        if not is_closure(packet):
            return packet.body
        return replace(packet.body, T_i_j=frozen(packet.body.T_i_j + np.array((10.0, 0.0, 0.0))))

    return changed(hostile, change)


LIES: dict[str, Lie] = {
    "shifted places": shifted, "mirrored places": mirrored, "copied places": copied_places,
    "copied scans": copied_scans, "closures of 10 m more": ten_metres,
}  # fmt: skip


if __name__ == "__main__":
    main()
