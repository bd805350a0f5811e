"""One robot that comes back again and again, in a building that changes: what grows, and how good the map is.

    python benchmarks/lifelong.py [--sessions 20] [--path 60] [--kept 2 4] [--seeds 11 12 13]

A simulated robot (LiDAR, 360 beams at 5 Hz) drives one building session after session, each with odometry that begins
at zero and from another start. Before each further one a fifth of the furniture moves in the rooms that it then visits,
and stays there; of the doors that it drives by, 30 % are closed. People walk in the corridors. The front end runs
beforehand, and what it sends goes into a mission's store as the service keeps it. Then the packets take effect in a
fleet that reads them from there, in a process of its own, as in a worker that starts again: with places of so many
sessions kept in each square of 2 m (`fleet.matcher.most_sessions_nearby`; the default comes first), and with nothing
ever forgotten. After some of the sessions:

- memory: resident set over that of the process before its first packet, freed memory given back to the system. A fleet
  that took two sessions was there before and is gone, so all code is loaded and compiled. Then that of the process;
- places that can be found again, keyscans whose ranges are held, closures that count;
- CPU seconds a place (match, verify, solve) and a solve, means of the session; of 1,000 packets, whatever they are; and
  of drawing the map;
- the live map against the truth: RMSE of all keyscans of the first map once that is moved onto the truth; F1 of the
  map's surfaces (0.10 m) against the building as it is now, of this map and of one whose beams all count the same; and
  F1 of this map without what no robot can know: surfaces that changed after the robot saw them last;
- traces: occupied cells farther than 0.15 m from every surface that was ever there.

Seeds 1 and 2 were used to develop; the report is of others. The last table has the growth from session 5 to the last.
"""

import ctypes
import gc
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
from scaling import Watches, alone, warm_up

SESSIONS, PATH_M, SEEDS, KEPT = 20, 60.0, (11, 12, 13), (2, 4)
ROBOT = "robot"
BETWEEN_S = 3600.0
"""From the beginning of one session to that of the next."""
MOVED_FURNITURE, CLOSED_DOORS = 0.2, 0.3
PEOPLE, PERSON_RADIUS_M, WALK_M_S = 3, 0.2, 1.2
EVERYTHING = 10**9
LOADED = 2
"""Sessions after which a fleet has run all of its code."""
SHOWN = 1, 2, 5, 10, 15
"""Sessions after which the map is compared with the truth, besides the last."""
TRACE_M = 0.15
GROWTH = {"sessions": "", "packets": ",", "memory, MB": ".1f", "process, MB": ".0f", "places": ",",
          "keyscans held": ",", "of": ",", "closures": ",", "s a place": ".3f", "s a solve": ".3f",
          "s for 1,000 packets": ".1f", "s to draw": ".2f", "maps": "", "RMSE, m": ".3f", "F1": ".3f",
          "F1, all beams the same": ".3f", "F1 of what was seen": ".3f", "traces": ",",
          "traces, all beams the same": ","}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--sessions", type=int, default=SESSIONS)
    parser.add_argument("--path", type=float, default=PATH_M, help="of each session, m")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the buildings and the routes")
    parser.add_argument("--kept", nargs="+", type=int, default=KEPT, help="sessions kept in a square; 0: all")
    parser.add_argument("--keep", type=Path, help="file for finished parts, so that an interrupted run goes on")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    finished, growth = common.Kept(chosen.keep), []
    for seed in chosen.seeds:
        drawn = chosen.sessions, chosen.path, seed
        for kept in (*chosen.kept, EVERYTHING):
            rows = finished.rows((*drawn, kept), lambda drawn=drawn, kept=kept: case(*drawn, kept))
            title = "nothing forgotten" if kept == EVERYTHING else f"{kept} sessions in a square"
            report.table(f"Seed {seed}, {title}", GROWTH, rows)
            growth.append((seed, title, *growth_of(rows)))
    report.table("Growth from session 5 to the last", {"seed": "", "kept": "", **dict.fromkeys(GROWN, ".2f")}, growth)
    report.write()


GROWN = "memory, MB", "process, MB", "s for 1,000 packets", "s to draw", "keyscans held"


def growth_of(rows: list[tuple]) -> list[float]:
    """The last row over that of session 5."""
    fifth = next(row for row in rows if row[0] == 5)
    columns = [list(GROWTH).index(name) for name in GROWN]
    return [rows[-1][column] / fifth[column] for column in columns]


def case(sessions: int, path_m: float, seed: int, kept: int) -> list[tuple]:
    with tempfile.TemporaryDirectory() as place:
        alone(record, Path(place), sessions, path_m, seed)
        return alone(live, Path(place), sessions, path_m, seed, kept)


def robots(sessions: int, path_m: float, seed: int) -> list[Any]:
    """The robot of each session: one building that changes."""
    from worlds.changing import ChangingBuilding, close_doors

    from fcslam.lab.simulation.noise import LidarSettings
    from fcslam.lab.simulation.simulated_fleet import STAMP_SHIFT_S, SimulationSettings, simulate_fleet

    settings = SimulationSettings(
        robots=sessions, path_length_m=path_m, camera=None, lidar=LidarSettings(rate_hz=5.0),
        moved_furniture=MOVED_FURNITURE,
    )  # fmt: skip
    fleet = simulate_fleet(settings, seed, ChangingBuilding(settings.building))
    shift_s = BETWEEN_S - STAMP_SHIFT_S
    return [replace(robot, name=ROBOT, stamps=robot.stamps + k * shift_s, first_stamp=robot.first_stamp + k * shift_s)
            for k, robot in enumerate(close_doors(fleet.robots, CLOSED_DOORS))]  # fmt: skip


def with_people(robot: Any, seed: int) -> Iterator[Any]:
    """Its scans, with people who walk up and down the corridors."""
    import numpy as np

    from fcslam.geometry import se2

    rng = np.random.default_rng((seed, robot.number))
    lanes = [robot.plan.lanes[k] for k in rng.integers(len(robot.plan.lanes), size=PEOPLE)]
    began_s = rng.uniform(0.0, 60.0, PEOPLE)
    for scan, T_building_base in zip(robot.scans(), robot.T_building_base, strict=True):
        x, y, heading = se2.compose(T_building_base, np.array(scan.laser.T_base_laser))
        angles = heading + scan.laser.angles_rad()
        ranges = scan.ranges_m.copy()
        for (start, end), since_s in zip(lanes, began_s, strict=True):
            length = np.linalg.norm(end - start)
            walked = WALK_M_S * (since_s + scan.stamp - robot.first_stamp) % (2.0 * length)
            person = start + min(walked, 2.0 * length - walked) / length * (end - start)
            away = person - (x, y)
            along = away[0] * np.cos(angles) + away[1] * np.sin(angles)
            across = away[0] * np.sin(angles) - away[1] * np.cos(angles)
            met = (np.abs(across) < PERSON_RADIUS_M) & (along > 2.0 * PERSON_RADIUS_M)
            near = along[met] - np.sqrt(PERSON_RADIUS_M**2 - across[met] ** 2)
            ranges[met] = np.where(ranges[met] > 0.0, np.minimum(ranges[met], near), near)
        yield replace(scan, ranges_m=ranges)


def record(place: Path, sessions: int, path_m: float, seed: int) -> None:
    """What the robot sends, as the service would have stored it."""
    from fcslam.mission.mission import MissionConfig
    from fcslam.mission.mission_store import MissionStore, StoredPacket
    from fcslam.robot.frontend import RobotFrontend
    from fcslam.wire.packets import encode, read_label, readdress

    store = MissionStore(place / "mission.sqlite")
    for epoch, robot in enumerate(robots(sessions, path_m, seed)):
        front = RobotFrontend(ROBOT, MissionConfig().robot)
        sent = [packet for scan in with_people(robot, seed) for packet in front.process(scan)] + front.finish()
        rows = []
        for packet in sent:
            data = readdress(encode(packet), epoch, packet.sequence)
            label = read_label(data)
            rows.append(StoredPacket(ROBOT, epoch, packet.sequence, packet.time, label.kind, label.channel, data))
        store.put(rows, time.time())
    store.close()


def live(place: Path, sessions: int, path_m: float, seed: int, kept: int) -> list[tuple]:
    """One row after each of the sessions that are shown."""
    from fcslam.cloud.fleet import Fleet
    from fcslam.cloud.packet_log import PacketLog
    from fcslam.mission.mission import MissionConfig
    from fcslam.mission.mission_store import MissionStore

    warm_up()
    config, store, drivers = MissionConfig(), MissionStore(place / "mission.sqlite"), robots(sessions, path_m, seed)
    limits = {"most_sessions_nearby": kept} | ({"most_nearby": kept} if kept == EVERYTHING else {})
    settings = config.fleet.model_copy(update={"matcher": config.fleet.matcher.model_copy(update=limits)})
    fleet, log, turn = Fleet(settings, config.seed), PacketLog(), 0
    for epoch in range(LOADED):
        turn = take_session(fleet, log, store, epoch, turn, Watches())
    state(fleet, drivers[:LOADED], config.map, ())
    fleet, log = Fleet(settings, config.seed), PacketLog()
    rows, turn, before_mb = [], 0, resident_mb()
    for epoch in range(sessions):
        with Watches().on() as watches:
            first, began = turn, time.process_time()
            turn = take_session(fleet, log, store, epoch, turn, watches)
            spent_s = time.process_time() - began
        if epoch + 1 in SHOWN or epoch + 1 == sessions:
            process_mb = resident_mb()
            costs = mean(watches.place.spent_s), mean(watches.quick.spent_s), 1e3 * spent_s / (turn - first)
            memory = process_mb - before_mb, process_mb
            rows.append((epoch + 1, turn, *memory, *state(fleet, drivers[: epoch + 1], config.map, costs)))
    return rows


def state(fleet: Any, drivers: list[Any], grid: Any, costs: tuple[float, ...]) -> tuple:
    """What the fleet holds, what it spent, and how good its live map is."""
    from fcslam.cloud.report import fuse_members
    from fcslam.records import ClosureStatus

    result = fleet.estimate()
    places = sum(state.places for state in fleet.vocabularies())
    held = sum(len(robot.keyscans) for robot in result.robots)
    poses = sum(len(robot.T_map_base) for robot in result.robots)
    closures = sum(closure.status is ClosureStatus.ACCEPTED for closure in result.closures)
    first = [robot for robot in result.robots if robot.map_index == 0]
    began = time.process_time()
    now = fuse_members(first, grid)
    drawn_s = time.process_time() - began
    plain = fuse_members(first, grid.model_copy(update={"contradicting_scans": EVERYTHING}))
    maps = len({robot.map_index for robot in result.robots})
    return places, held, poses, closures, *costs, drawn_s, maps, *against_truth(first, now, plain, drivers)


def take_session(fleet: Any, log: Any, store: Any, epoch: int, turn: int, watches: Watches) -> int:
    """A session's packets take effect; returns how many packets did so far."""
    from fcslam.cloud.packet_log import PacketNumber
    from fcslam.cloud.sessions import session_name
    from fcslam.wire.messages import PacketKind
    from fcslam.wire.packets import decode

    while packets := [packet for _, packet in store.arrivals(turn, 64) if packet.epoch == epoch]:
        for packet in packets:
            session = session_name(packet.robot, packet.epoch)
            log.add(PacketNumber(session, packet.sequence), packet.time)
            with watches.place() if packet.kind is PacketKind.PLACE else ExitStack():
                for _ in log.ready(session):
                    fleet.apply(decode(packet.data))
        turn += len(packets)
    return turn


def against_truth(first: list[Any], now: Any, plain: Any, drivers: list[Any]) -> tuple[float, ...]:
    """RMSE of the keyscans of the first map, F1 of its surfaces, and traces."""
    import numpy as np

    from fcslam.cloud.report import keyscan_track
    from fcslam.geometry import se2
    from fcslam.lab.evaluation.ground_truth import labelled
    from fcslam.metrics.grid import grid_agreement
    from fcslam.metrics.trajectory import PositionErrors, align, position_errors

    estimated = np.concatenate([robot.T_map_base for robot in first])
    stamps = np.concatenate([keyscan_track(robot).stamps for robot in first])
    known = np.concatenate([driver.stamps for driver in drivers])
    true = np.concatenate([driver.T_building_base for driver in drivers])[np.searchsorted(known, stamps - 1e-6)]
    T_truth_map = align(true, estimated)
    rmse_m = PositionErrors.of(position_errors(T_truth_map, true, estimated)).rmse_m
    truth, seen = labelled(building_now(drivers)), labelled(building_as_seen(drivers))
    f1, plain_f1 = (grid_agreement(labelled(map_), truth, T_truth_map).f1 for map_ in (now, plain))

    surfaces, true_surfaces, seen_surfaces = (grid.centres(grid.occupied) for grid in (labelled(now), truth, seen))
    surfaces = se2.transform(T_truth_map, surfaces)
    precision = float(np.mean(within(surfaces, np.concatenate((true_surfaces, seen_surfaces)), 0.1)))
    recall = float(np.mean(within(true_surfaces[within(true_surfaces, seen_surfaces, 0.1)], surfaces, 0.1)))
    ever = np.concatenate([segment_points(driver.plan) for driver in drivers])
    traces = [
        int(np.sum(~within(se2.transform(T_truth_map, labelled(map_).centres(labelled(map_).occupied)), ever, TRACE_M)))
        for map_ in (now, plain)
    ]
    return rmse_m, f1, plain_f1, 2.0 * precision * recall / (precision + recall), *traces


def building_now(drivers: list[Any]) -> Any:
    """The building as the last robot found it, seen from wherever a robot could stand in it."""
    from fcslam.lab.simulation.recording import true_map
    from fcslam.lab.simulation.simulated_fleet import SimulatedFleet

    plan, here = drivers[-1].plan, []
    surfaces = segment_points(plan)
    for driver in drivers:
        stands = ~within(driver.T_building_base[:, :2], surfaces, 0.2)
        here.append(replace(driver, plan=plan, T_building_base=driver.T_building_base[stands]))
    return true_map(SimulatedFleet(plan, tuple(here)))


def building_as_seen(drivers: list[Any]) -> Any:
    """Each cell as the last robot that saw it found it."""
    import numpy as np

    from fcslam.lab.simulation.recording import true_map
    from fcslam.lab.simulation.simulated_fleet import SimulatedFleet
    from fcslam.maps.occupancy_map import Occupancy

    maps = [true_map(SimulatedFleet(driver.plan, (driver,))) for driver in drivers]
    cells = maps[0].cells
    for newer in maps[1:]:
        cells = np.where(newer.cells == Occupancy.UNKNOWN, cells, newer.cells)
    return replace(maps[0], cells=cells)


def segment_points(plan: Any) -> Any:
    """Points (N, 2) on all sides of walls and furniture, 0.05 m apart."""
    import numpy as np

    start, end = plan.segments[:, :2], plan.segments[:, 2:]
    counts = np.ceil(np.linalg.norm(end - start, axis=1) / 0.05).astype(int) + 1
    return np.concatenate([np.linspace(a, b, n) for a, b, n in zip(start, end, counts, strict=True)])


def within(points: Any, others: Any, reach_m: float) -> Any:
    """Whether each of ``points`` (N, 2) is that close to one of ``others`` (M, 2)."""
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points, distance_upper_bound=reach_m + 1e-6)[0] <= reach_m + 1e-6


def mean(spent_s: list[float]) -> float:
    return sum(spent_s) / len(spent_s) if spent_s else float("nan")


def resident_mb() -> float:
    """Resident set once all that is free has been given back."""
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    return _status_mb("VmRSS:")


def _status_mb(name: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) * 1024 / 1e6


if __name__ == "__main__":
    main()
