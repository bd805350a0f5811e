"""One robot that comes back again and again: what grows with the time that it drives, and what with the area alone.

    python benchmarks/lifelong.py [--sessions 20] [--path 60] [--most 12 4]

A simulated robot (LiDAR, 360 beams at 5 Hz) drives one building session after session, each with odometry that begins
at zero and from another start; before each further one a tenth of the rooms' furniture moves. Its front end runs
beforehand, and what it sends goes into a mission's store as the service keeps it. Then the packets take effect in a
fleet that reads them from there, in a process of its own, as in a worker that starts again: with so many places kept in
each square of 2 m (`fleet.matcher.most_nearby`; the default comes first), and with nothing ever forgotten. After each
session:

- memory: resident set over that of the process before its first packet, freed memory given back to the system. Up to
  300 submaps held ready for comparison (`fleet.submaps_kept`) are most of it, a quarter of a megabyte each;
- places that can be found again, keyscans whose ranges are held, closures that count;
- CPU seconds a place (match, verify, solve) and a solve, means of the session; and of 1,000 packets, whatever they are,
  which is what a worker needs that starts again;
- the live map against the truth: RMSE of all keyscans of the first map once that is moved onto the truth, F1 of the
  map's surfaces (0.10 m) against the building as it was on that drive, seen from wherever the robot has been.

"End" is the result of all sessions: decided once, as the packets came in canonical order, and once more by a replay of
all of them, as it is where several robots' packets arrive as they may.
"""

import ctypes
import gc
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
from scaling import Watches, alone, warm_up

SESSIONS, PATH_M, SEED, MOST = 20, 60.0, 1, (12, 4)
ROBOT = "robot"
BETWEEN_S = 3600.0
"""From the beginning of one session to that of the next."""
MOVED_FURNITURE = 0.1
EVERYTHING = 10**9
GROWTH = {"sessions": "", "packets": ",", "memory, MB": ".1f", "places": ",", "keyscans held": ",", "of": ",",
          "closures": ",", "s a place": ".3f", "s a solve": ".3f", "s for 1,000 packets": ".1f", "maps": "",
          "RMSE, m": ".3f", "F1": ".3f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--sessions", type=int, default=SESSIONS)
    parser.add_argument("--path", type=float, default=PATH_M, help="of each session, m")
    parser.add_argument("--seed", type=int, default=SEED, help="of the building and the routes")
    parser.add_argument("--most", nargs="+", type=int, default=MOST, help="places kept in a square")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    drawn = chosen.sessions, chosen.path, chosen.seed
    with tempfile.TemporaryDirectory() as place:
        alone(record, Path(place), *drawn)
        for most in (*chosen.most, EVERYTHING):
            rows, said = alone(live, Path(place), *drawn, most)
            title = "Nothing forgotten" if most == EVERYTHING else f"At most {most} places in a square"
            report.table(title, GROWTH, rows)
            report.say(said)
    report.write()


def robots(sessions: int, path_m: float, seed: int) -> list[Any]:
    """The robot of each session: one building, whose furniture moves."""
    from fcslam.simulation.noise import LidarSettings
    from fcslam.simulation.simulated_fleet import STAMP_SHIFT_S, SimulationSettings, simulate_fleet

    settings = SimulationSettings(
        robots=sessions, path_length_m=path_m, camera=None, lidar=LidarSettings(rate_hz=5.0),
        moved_furniture=MOVED_FURNITURE,
    )  # fmt: skip
    shift_s = BETWEEN_S - STAMP_SHIFT_S
    return [replace(robot, name=ROBOT, stamps=robot.stamps + k * shift_s, first_stamp=robot.first_stamp + k * shift_s)
            for k, robot in enumerate(simulate_fleet(settings, seed).robots)]  # fmt: skip


def record(place: Path, sessions: int, path_m: float, seed: int) -> None:
    """What the robot sends, as the service would have stored it."""
    from fcslam.mission import MissionConfig
    from fcslam.robot.frontend import RobotFrontend
    from fcslam.service.mission_store import MissionStore, StoredPacket
    from fcslam.wire.packets import encode, read_label, readdress

    store = MissionStore(place / "mission.sqlite")
    for epoch, robot in enumerate(robots(sessions, path_m, seed)):
        front = RobotFrontend(ROBOT, MissionConfig().robot)
        sent = [packet for scan in robot.scans() for packet in front.process(scan)] + front.finish()
        rows = []
        for packet in sent:
            data = readdress(encode(packet), epoch, packet.sequence)
            label = read_label(data)
            rows.append(StoredPacket(ROBOT, epoch, packet.sequence, packet.time, label.kind, label.channel, data))
        store.put(rows, time.time())
    store.close()


def live(place: Path, sessions: int, path_m: float, seed: int, most_nearby: int) -> tuple[list[tuple], str]:
    """One row after each session, and what the end took."""
    from fcslam.cloud.fleet import Fleet
    from fcslam.cloud.packet_log import PacketLog, PacketNumber
    from fcslam.cloud.sessions import robot_and_epoch, session_name
    from fcslam.mission import MissionConfig
    from fcslam.service.mission_store import MissionStore
    from fcslam.wire.packets import decode

    warm_up()
    config, store, drivers = MissionConfig(), MissionStore(place / "mission.sqlite"), robots(sessions, path_m, seed)
    matcher = config.fleet.matcher.model_copy(update={"most_nearby": most_nearby})
    settings = config.fleet.model_copy(update={"matcher": matcher})
    fleet, log = Fleet(settings, config.seed), PacketLog()
    rows, turn, before_mb = [], 0, resident_mb()
    for epoch in range(sessions):
        with Watches().on() as watches:
            first, began = turn, time.process_time()
            turn = take_session(fleet, log, store, epoch, turn, watches)
            spent_s = time.process_time() - began
        memory_mb = resident_mb() - before_mb
        costs = mean(watches.place.spent_s), mean(watches.quick.spent_s), 1e3 * spent_s / (turn - first)
        rows.append((epoch + 1, turn, memory_mb, *state(fleet, drivers[: epoch + 1], config.map, costs)))
    spent, memory_mb = [], []
    for _ in range(2):
        began = time.process_time()
        arrived = ((e.time, PacketNumber(session_name(e.robot, e.epoch), e.sequence)) for e in store.envelopes())
        result = fleet.finalize(
            log, arrived, lambda n: decode(store.packet(*robot_and_epoch(n.session), n.sequence).data)
        )
        spent.append(time.process_time() - began)
        memory_mb.append(peak_mb() - before_mb)
    maps, rmse_m, f1 = against_truth(result, drivers, config.map)
    said = (
        f"End, of {turn:,} packets: {maps} map(s), RMSE {rmse_m:.3f} m, F1 {f1:.3f}; {spent[0]:.1f} s of CPU and at "
        f"most {memory_mb[0]:.0f} MB so far; replayed {spent[1]:.1f} s and {memory_mb[1]:.0f} MB."
    )
    return rows, said


def state(fleet: Any, drivers: list[Any], grid: Any, costs: tuple[float, ...]) -> tuple:
    """What the fleet holds, what it spent, and how good its live map is."""
    from fcslam.records import ClosureStatus

    result = fleet.estimate()
    places = sum(state.places for state in fleet.vocabularies())
    held = sum(len(robot.keyscans) for robot in result.robots)
    poses = sum(len(robot.T_map_base) for robot in result.robots)
    closures = sum(closure.status is ClosureStatus.ACCEPTED for closure in result.closures)
    return places, held, poses, closures, *costs, *against_truth(result, drivers, grid)


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


def against_truth(result: Any, drivers: list[Any], grid: Any) -> tuple[int, float, float]:
    """Maps, RMSE of the keyscans and F1 of the surfaces of the first one."""
    import numpy as np

    from fcslam.cloud.report import fuse_members, keyscan_track
    from fcslam.metrics.grid import grid_agreement
    from fcslam.metrics.trajectory import PositionErrors, align, position_errors
    from fcslam.simulation.ground_truth import true_map
    from fcslam.simulation.simulated_fleet import SimulatedFleet

    first = [robot for robot in result.robots if robot.map_index == 0]
    estimated = np.concatenate([robot.T_map_base for robot in first])
    stamps = np.concatenate([keyscan_track(robot).stamps for robot in first])
    known = np.concatenate([driver.stamps for driver in drivers])
    true = np.concatenate([driver.T_building_base for driver in drivers])[np.searchsorted(known, stamps - 1e-6)]
    T_truth_map = align(true, estimated)
    rmse_m = PositionErrors.of(position_errors(T_truth_map, true, estimated)).rmse_m
    plan = drivers[-1].plan
    truth = true_map(SimulatedFleet(plan, tuple(replace(driver, plan=plan) for driver in drivers)))
    agreement = grid_agreement(labelled(fuse_members(first, grid)), labelled(truth), T_truth_map)
    return len({robot.map_index for robot in result.robots}), rmse_m, agreement.f1


def labelled(seen: Any) -> Any:
    import numpy as np

    from fcslam.metrics.grid import LabelledGrid
    from fcslam.runs.map_files import Occupancy

    corner = np.array([*seen.origin_xy, 0.0])
    return LabelledGrid(seen.cells == Occupancy.OCCUPIED, seen.cells == Occupancy.FREE, seen.resolution_m, corner)


def mean(spent_s: list[float]) -> float:
    return sum(spent_s) / len(spent_s) if spent_s else float("nan")


def resident_mb() -> float:
    """Resident set once all that is free has been given back."""
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    return _status_mb("VmRSS:")


def peak_mb() -> float:
    return _status_mb("VmHWM:")


def _status_mb(name: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) * 1024 / 1e6


if __name__ == "__main__":
    main()
