"""Robots that lie, by the thousand: the cloud survives each, and the map of honest robots stays where it is.

    python benchmarks/hostile_sessions.py --sets 10000 --kept /tmp/hostile.jsonl

Three honest robots of a simulated flat, and in every set one to three hostile sessions: copies of honest packets that
are scaled, sheared, mirrored, reordered or shifted in time, copies whose places lie somewhere else, a copy of one place
joined to that of another, and random junk; with any precision, epoch and name, an honest robot's included. In most
sets the hostile packets come after the honest ones; in every eighth they come between them, and the sessions are then
removed again. A set breaks a bar if anything but a PacketError comes out of the cloud, if honest robots that shared a
map do not any more, if an honest keyscan moves by more than 5 cm (the map of each group of robots aligned rigidly), or
by more than 5 mm after the removal. With FCSLAM_DATA, named attacks on intel in three robots follow.

The file of ``--kept`` holds one line for each finished set; a run that was interrupted goes on from there.
"""

import os
import resource
import time
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.result import FleetResult
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import PacketError
from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.records import Constraint, ConstraintKind, Keyscan, KeyscanId, Place, Removal, frozen
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import open_source, split
from fcslam.wire.checks import check
from fcslam.wire.messages import Body, Hello, Packet
from fcslam.wire.packets import decode, encode

BEFORE_M, AFTER_M = 0.05, 0.005
CRASH = "exception:"
INTERLEAVED = 8
"""Of so many sets, one comes between the honest packets."""
COLUMNS = {"attack": "", "sets": ",", "refused packets": ",", "joined": ",", "bars broken": ",",
           "moved 90 %, mm": ".1f", "moved most, mm": ".1f", "removed again": ",", "left most, mm": ".1f",
           "slowest, s": ".1f"}  # fmt: skip
BROKEN = {"set": "", "attack": "", "what broke": ""}
NAMED = {"attack on intel": "", "robots in a map with the attacker": "", "moved most, mm": ".1f",
         "honest closures lost": ",", "CPU, s": ".1f"}  # fmt: skip

Stream = list[Packet]
Rng = np.random.Generator


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--sets", type=int, default=10_000, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="of the fleet; set k has a generator of its own")
    parser.add_argument("--kept", type=Path, help="file that keeps finished sets")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    mission = Mission(chosen.seed)
    kept = common.Kept(chosen.kept)
    rows = [Outcome(*row) for k in range(chosen.sets) for row in kept.rows((chosen.seed, k), partial(mission.rows, k))]
    broken = [row for row in rows if row.broken]
    crashed = sum(row.broken.startswith(CRASH) for row in rows)
    report.say(
        f"{len(rows):,} sets, {sum(row.cpu_s for row in rows):,.0f} s of CPU: {len(broken)} broke a bar, {crashed} of "
        f"them by an exception. Peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB."
    )
    report.table("Attacks", COLUMNS, [summary(name, [r for r in rows if r.attack == name]) for name in ATTACKS])
    report.table("Sets that broke a bar (the first 40)", BROKEN, [(r.number, r.attack, r.broken) for r in broken[:40]])
    if os.environ.get("FCSLAM_DATA"):
        report.table("Named attacks", NAMED, named_attacks())
    report.write()


class Outcome(NamedTuple):
    """What one set of hostile sessions did."""

    number: int
    attack: str
    refused: int
    """Packets."""
    joined: bool
    """Whether a hostile session shares a map with an honest robot."""
    moved_m: float
    """Largest distance of an honest keyscan from where it is without them."""
    left_m: float | None
    """The same after the sessions were removed again; None if they were not."""
    broken: str
    """The bars that it broke."""
    cpu_s: float


def summary(name: str, rows: Sequence[Outcome]) -> tuple[Any, ...]:
    moved = [1e3 * row.moved_m for row in rows] or [0.0]
    left = [1e3 * row.left_m for row in rows if row.left_m is not None]
    return (
        name, len(rows), sum(row.refused for row in rows), sum(row.joined for row in rows),
        sum(bool(row.broken) for row in rows), float(np.quantile(moved, 0.9)), max(moved), len(left),
        max(left, default=0.0), max((row.cpu_s for row in rows), default=0.0),
    )  # fmt: skip


class Mission:
    """The honest robots, their map, and the state of the fleet after their packets."""

    def __init__(self, seed: int) -> None:
        lidar = LidarSettings(beams=180, rate_hz=3.0)
        fleet = simulate_fleet(SimulationSettings(robots=3, path_length_m=18.0, lidar=lidar, camera=None), seed + 3)
        self.seed = seed
        self.streams = [sent(RobotFrontend(robot.name, RobotConfig()), robot.scans()) for robot in fleet.robots]
        self.packets = in_order(*self.streams)
        cloud = Cloud(FleetConfig(), 0)
        for packet in self.packets:
            cloud.apply(packet)
        self.alone = cloud.finalize()
        self._state = cloud.fleet.state()
        self._stored = {PacketNumber(packet.robot, packet.sequence): packet for packet in self.packets}

    def rows(self, number: int) -> list[Outcome]:
        """What one set of hostile sessions does, as one row."""
        rng = np.random.default_rng((self.seed, number))
        attack = list(ATTACKS)[number % len(ATTACKS)]
        hostile = self._sessions(attack, rng)
        began = time.process_time()
        refused, joined, moved_m, left_m, broken = 0, False, 0.0, None, ""
        try:
            if number // len(ATTACKS) % INTERLEAVED == 0:
                found, evicted, refused = self._between(hostile)
            else:
                (found, refused), evicted = self._after(hostile), None
            joined, moved_m, left_m, broken = self._judge(found, evicted)
        except Exception as error:  # whatever it is, it would have ended the worker
            broken = f"{CRASH} {type(error).__name__}: {error}"[:200]
        return [Outcome(number, attack, refused, joined, moved_m, left_m, broken, time.process_time() - began)]

    def _judge(self, found: FleetResult, evicted: FleetResult | None) -> tuple[bool, float, float | None, str]:
        honest = {stream[0].robot for stream in self.streams}
        maps = {robot.robot: robot.map_index for robot in found.robots}
        joined = not {maps[name] for name in honest}.isdisjoint(maps[name] for name in maps if name not in honest)
        moved_m, separated = moved(found, self.alone, honest)
        left_m, still_separated = (None, False) if evicted is None else moved(evicted, self.alone, honest)
        broken = ["honest robots separated"] * separated
        broken += [f"moved by {1e3 * moved_m:.1f} mm"] * (moved_m > BEFORE_M)
        broken += ["removed, and not as before"] * (still_separated or (left_m or 0.0) > AFTER_M)
        return joined, moved_m, left_m, "; ".join(broken)

    def _after(self, hostile: Stream) -> tuple[FleetResult, int]:
        """The result with hostile sessions that come last, and how many of their packets are refused."""
        fleet = Fleet.restored(FleetConfig(), 0, deepcopy(self._state), self._stored.__getitem__)
        refused = sum(is_refused(packet, fleet.apply) for packet in hostile)
        return fleet.conclude(), refused

    def _between(self, hostile: Stream) -> tuple[FleetResult, FleetResult, int]:
        """The result with hostile sessions among the others, after their removal, and how many packets are refused."""
        cloud = Cloud(FleetConfig(), 0)
        refused = sum(is_refused(packet, cloud.apply) for packet in in_order(self.packets, hostile))
        found = cloud.finalize()
        cloud.fleet.edit([Removal(packet.robot, packet.epoch) for packet in hostile if isinstance(packet.body, Hello)])
        return found, cloud.finalize(), refused

    def _sessions(self, attack: str, rng: Rng) -> Stream:
        """One to three hostile sessions, under names of their own or as another epoch of an honest robot."""
        sessions = []
        start_s = self.packets[0].time if rng.random() < 0.5 else self.packets[-1].time
        for k in range(int(rng.integers(1, 4))):
            victim = self.streams[int(rng.integers(len(self.streams)))]
            robot = victim[0].robot if rng.random() < 0.2 else f"hostile{k}"
            epoch = int(rng.choice((0, 1, 7, 2**31 - 1))) if robot.startswith("hostile") else 1 + k
            bodies = claimed(ATTACKS[attack](victim, rng, self.streams), rng)
            sessions.append(as_session(robot, epoch, start_s, bodies))
        return in_order(*sessions)


def sent(frontend: RobotFrontend, records: Iterable[Any]) -> Stream:
    """What the cloud gets of everything that a robot sends."""
    packets = [packet for record in records for packet in frontend.process(record)] + frontend.finish()
    return [decode(encode(packet)) for packet in packets]


def in_order(*streams: Stream) -> Stream:
    return sorted((packet for stream in streams for packet in stream), key=lambda packet: packet.order)


def is_refused(packet: Packet, apply: Callable[[Packet], Any]) -> bool:
    try:
        check(packet)
        apply(packet)
    except PacketError:
        return True
    return False


def as_session(robot: str, epoch: int, start_s: float, bodies: "Timed") -> Stream:
    return [
        Packet(robot, epoch, number, start_s + time_s, renamed(body, robot, epoch))
        for number, (time_s, body) in enumerate(bodies)
    ]


def renamed(body: Body, robot: str, epoch: int) -> Body:
    match body:
        case Keyscan() | Place():
            return replace(body, id=KeyscanId(robot, body.id.number))
        case Hello():
            return replace(body, robot=robot, epoch=epoch)
        case _:
            return replace(body, robot=robot)


def moved(found: FleetResult, alone: FleetResult, honest: Iterable[str]) -> tuple[float, bool]:
    """Largest distance of an honest keyscan from where it is without hostile robots, and whether maps came apart."""
    now, then = ({robot.robot: robot for robot in result.robots} for result in (found, alone))
    groups: dict[tuple[int, int], list[str]] = {}
    for robot in sorted(honest):
        groups.setdefault((then[robot].map_index, now[robot].map_index), []).append(robot)
    most = 0.0
    for robots in groups.values():
        xy, wanted = (np.concatenate([those[r].T_map_base[:, :2] for r in robots]) for those in (now, then))
        aligned = se2.transform(n_point_alignment(wanted, xy), xy)
        most = max(most, float(np.hypot(*(aligned - wanted).T).max()))
    return most, len(groups) > len({before for before, _ in groups})


# Attacks: the bodies of a session, with their time since its start.
Timed = list[tuple[float, Body]]


def copied(stream: Stream, change: Callable[[Body], Body]) -> Timed:
    return [(packet.time - stream[0].time, change(packet.body)) for packet in stream]


def deformed(stream: Stream, matrix: np.ndarray, turn: float = 1.0, ranges: float = 1.0) -> Timed:
    """A copy whose motions are deformed by a matrix (2, 2), turns and ranges scaled."""

    def change(body: Body) -> Body:
        match body:
            case Keyscan():
                return replace(body, ranges_m=frozen(body.ranges_m * ranges, np.float32))
            case Constraint():
                T = np.append(matrix @ body.T_i_j[:2], turn * body.T_i_j[2])
                return replace(body, T_i_j=frozen(se2.compose(np.zeros(3), T)))
            case Place():
                return replace(body, keypoints=frozen(body.keypoints * ranges, np.float32))
            case _:
                return body

    return copied(stream, change)


def scaled(stream: Stream, rng: Rng, _: Sequence[Stream]) -> Timed:
    scale = float(np.exp(rng.choice((-1, 1)) * 10 ** rng.uniform(-3, -0.5)))
    return deformed(stream, scale * np.eye(2), ranges=scale)


def stretched(stream: Stream, rng: Rng, _: Sequence[Stream]) -> Timed:
    return deformed(stream, np.eye(2) * np.exp(rng.choice((-1, 1)) * 10 ** rng.uniform(-3, -0.5)))


def sheared(stream: Stream, rng: Rng, _: Sequence[Stream]) -> Timed:
    return deformed(stream, np.eye(2) + rng.normal(0, 10 ** rng.uniform(-3, -0.5), (2, 2)))


def bent(stream: Stream, rng: Rng, _: Sequence[Stream]) -> Timed:
    """Each motion turns a little more."""
    more = rng.choice((-1, 1)) * 10 ** rng.uniform(-4, -1.5)

    def change(body: Body) -> Body:
        odometry = isinstance(body, Constraint) and body.kind is ConstraintKind.ODOMETRY
        return replace(body, T_i_j=frozen(se2.compose(body.T_i_j, np.array((0.0, 0.0, more))))) if odometry else body

    return copied(stream, change)


def mirrored(stream: Stream, _: Rng, __: Sequence[Stream]) -> Timed:
    def change(body: Body) -> Body:
        match body:
            case Keyscan():
                return replace(body, ranges_m=frozen(body.ranges_m[::-1].copy(), np.float32))
            case Constraint():
                return replace(body, T_i_j=frozen(body.T_i_j * (1.0, -1.0, -1.0)))
            case _:
                return body

    return copied(stream, change)


def late(stream: Stream, rng: Rng, _: Sequence[Stream]) -> Timed:
    """A true copy at another time, some stamps shuffled."""
    shift_s = float(rng.choice((-1e6, -10.0, 10.0, 1e6)))
    return [(max(0.0, time_s + shift_s * rng.random()), body) for time_s, body in copied(stream, lambda body: body)]


def displaced(stream: Stream, rng: Rng, _: Sequence[Stream]) -> Timed:
    """True scans and places, with some motions between them that were not."""
    often = rng.uniform(0.01, 1.0)

    def change(body: Body) -> Body:
        if not isinstance(body, Constraint) or rng.random() > often:
            return body
        return replace(body, T_i_j=frozen(rng.uniform((-5, -5, -np.pi), (5, 5, np.pi))))

    return copied(stream, change)


def bridged(stream: Stream, rng: Rng, streams: Sequence[Stream]) -> Timed:
    """The start of one robot's packets and, at a chosen offset, those of another."""
    other = streams[int(rng.integers(len(streams)))]
    first = copied(stream[: int(rng.integers(20, len(stream)))], lambda body: body)
    scans = sum(isinstance(body, Keyscan) for _, body in first)
    seam = Constraint("x", scans - 1, scans, ConstraintKind.ODOMETRY,
                      frozen(rng.uniform((-5, -5, -np.pi), (5, 5, np.pi))), frozen(1e4 * np.eye(3)))  # fmt: skip

    def later(body: Body) -> Body:
        match body:
            case Keyscan():
                return replace(body, id=KeyscanId("x", body.id.number + scans))
            case Constraint():
                return replace(body, i=body.i + scans, j=body.j + scans)
            case Place():
                id_ = KeyscanId("x", body.id.number + scans)
                return replace(body, id=id_, first=body.first + scans, last=body.last + scans)
            case _:
                return body

    rest = [(first[-1][0] + 1.0 + time_s, body) for time_s, body in copied(other[1:], later)]
    return [*first, rest[0], (rest[0][0], seam), *rest[1:]]


def junk(stream: Stream, rng: Rng, _: Sequence[Stream]) -> Timed:
    """Random ranges, motions, places and numbers; some of each as they were."""
    share = rng.uniform(0.05, 1.0)

    def change(body: Body) -> Body:
        if rng.random() > share:
            return body
        match body:
            case Keyscan():
                return replace(body, ranges_m=frozen(rng.uniform(0.0, 30.0, len(body.ranges_m)), np.float32))
            case Constraint():
                reach = 10.0 ** rng.uniform(-3, 5)
                T = rng.uniform((-reach, -reach, -np.pi), (reach, reach, np.pi))
                return replace(body, T_i_j=frozen(T), j=body.j + int(rng.integers(0, 3)))
            case Place():
                first = max(0, body.first - int(rng.integers(0, 1000)))
                codes = rng.integers(0, 256, body.descriptors.shape, dtype=np.uint8)
                return replace(body, first=first, descriptors=frozen(codes, np.uint8))
            case _:
                return body

    return copied(stream, change)


ATTACKS: dict[str, Callable[[Stream, Rng, Sequence[Stream]], Timed]] = {
    "scaled": scaled, "scaled motions": stretched, "sheared motions": sheared, "bent motions": bent,
    "mirrored": mirrored, "other times": late, "false motions": displaced, "two places joined": bridged, "junk": junk,
}  # fmt: skip


def claimed(bodies: Timed, rng: Rng) -> Timed:
    """The session with the precision that the attacker claims; now and then as the victim stated it."""
    if rng.random() < 0.3:
        return bodies
    sigma_m, sigma_rad = 10.0 ** rng.uniform(-6.0, 1.0), 10.0 ** rng.uniform(-6.0, 0.0)
    if rng.random() < 0.7:  # as much as is not refused
        sigma_m, sigma_rad = max(sigma_m, 0.001), max(sigma_rad, 0.0002)
    information = frozen(np.diag((sigma_m**-2, sigma_m**-2, sigma_rad**-2)))
    return [
        (time_s, replace(body, information=information) if isinstance(body, Constraint) else body)
        for time_s, body in bodies
    ]


def named_attacks() -> list[tuple[Any, ...]]:
    """Copies of one of three robots on intel, scaled and with the best precision that is not refused."""
    folder = common.recordings("slam-benchmark/intel.clf.xz")
    parts = split(open_source(common.log_path(folder, "intel")), 3)
    streams = [sent(RobotFrontend(part.name, RobotConfig()), part.records()) for part in parts]
    names = [stream[0].robot for stream in streams]
    precise = frozen(np.diag((1e6, 1e6, 2.5e7)))
    alone, rows = mapped(in_order(*streams)), []
    for label, scale, ranges in (("scaled by 1.03", 1.03, 1.03), ("scaled by 0.97", 0.97, 0.97),
                                 ("scaled by 1.01", 1.01, 1.01), ("motions scaled by 1.03", 1.03, 1.0)):  # fmt: skip
        copy = deformed(streams[1], scale * np.eye(2), ranges=ranges)
        bodies = [(t, replace(b, information=precise) if isinstance(b, Constraint) else b) for t, b in copy]
        hostile = as_session("hostile", 0, streams[1][0].time, bodies)
        began = time.process_time()
        found = mapped(in_order(*streams, hostile))
        maps = {robot.robot: robot.map_index for robot in found.robots}
        together = [name for name in names if maps[name] == maps["hostile"]]
        lost = len(accepted(alone, names) - accepted(found, names))
        moved_m, _ = moved(found, alone, names)
        rows.append((label, ", ".join(together) or "none", 1e3 * moved_m, lost, time.process_time() - began))
    return rows


def mapped(packets: Stream) -> FleetResult:
    cloud = Cloud(FleetConfig(), 0)
    for packet in packets:
        cloud.apply(packet)
    return cloud.finalize()


def accepted(result: FleetResult, names: Sequence[str]) -> set[tuple[KeyscanId, KeyscanId]]:
    """Accepted closures between honest robots, or within one."""
    kept = [c for c in result.closures if c.status == "accepted"]
    return {(c.i, c.j) for c in kept if c.i.robot in names and c.j.robot in names}


if __name__ == "__main__":
    main()
