"""A worker that is killed: seconds until the next one lets a new packet take effect, with a snapshot and without.

    python benchmarks/restart.py [--packets 10000 100000]

Three simulated robots drive one building; their packets are repeated as one long drive, round after round, until there
are enough. A robot closes loops between rounds as it does within one. The worker is the service's, on a store with all
packets but the last ones. It is killed with SIGKILL; then one more packet is stored and a new worker is started.
"No snapshot" deletes the snapshot first. The clock runs from the start of the process until the last packet has taken
effect, imports and compiled code included. The work that a worker repeats depends on when it is killed: at most what it
did since the last snapshot, which takes 5 % of its time.
"""

import heapq
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import common

COLUMNS = {"packets": ",", "start": "", "first worker, s": ".0f", "snapshot, MB": ".1f", "ready again, s": ".1f"}
LOOK_S = 0.02
SETTLED_S = 120.0
"""A worker that has written no snapshot so long after the last packet will write none."""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--packets", nargs="+", type=int, default=[10_000, 100_000], help="sizes of the mission")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rounds = [one_round(robot) for robot in simulated()]
    rows: list[tuple] = []
    for size in chosen.packets:
        with tempfile.TemporaryDirectory() as place:
            rows += restarted(Path(place), rounds, size)
    report.table("Ready again", COLUMNS, rows)
    report.write()


def simulated() -> Any:
    from fcslam.lab.simulation.noise import LidarSettings
    from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet

    lidar = LidarSettings(rate_hz=5.0)
    return simulate_fleet(SimulationSettings(robots=3, path_length_m=60.0, camera=None, lidar=lidar), 1).robots


def one_round(robot: Any) -> tuple[list, Any]:
    """A robot's packets, and T_last_first of its keyscans."""
    from fcslam.cloud.cloud import Cloud
    from fcslam.geometry import se2
    from fcslam.mission.mission import MissionConfig
    from fcslam.robot.frontend import RobotFrontend

    config = MissionConfig()
    front, cloud = RobotFrontend(robot.name, config.robot), Cloud(config.fleet, config.seed)
    packets = [packet for scan in robot.scans() for packet in front.process(scan)] + list(front.finish())
    for packet in packets:
        cloud.apply(packet)
    poses = cloud.finalize().robots[0].T_map_base
    return packets, (se2.between(poses[-1], poses[0]), len(poses))


def repeated(packets: list, back: Any) -> Iterator[Any]:
    """The packets round after round, without end."""
    from fcslam.records import Constraint, ConstraintKind, Keyscan, KeyscanId, Place, frozen
    from fcslam.wire.messages import Hello

    T_last_first, keyscans = back
    length_s = packets[-1].time - packets[0].time + 1.0
    step = next(p.body for p in packets if isinstance(p.body, Constraint) and p.body.kind is ConstraintKind.ODOMETRY)
    sequence = number = 0
    while True:
        shift, shift_s = number * keyscans, number * length_s
        for packet in packets:
            bodies: list[Any] = []
            match packet.body:
                case Hello() as hello:
                    bodies = [] if number else [hello]
                case Keyscan() as k:
                    bodies = [replace(k, id=KeyscanId(k.id.robot, k.id.number + shift), stamp=k.stamp + shift_s)]
                    if number and k.id.number == 0:
                        bodies.append(replace(step, i=shift - 1, j=shift, T_i_j=frozen(T_last_first)))
                case Place() as p:
                    moved = KeyscanId(p.id.robot, p.id.number + shift)
                    bodies = [replace(p, id=moved, first=p.first + shift, last=p.last + shift)]
                case Constraint() as c:
                    bodies = [replace(c, i=c.i + shift, j=c.j + shift)]
                    if number and c.kind is not ConstraintKind.ODOMETRY:
                        bodies.append(replace(c, i=c.i + shift - keyscans, j=c.j + shift))
            for body in bodies:
                yield replace(packet, sequence=sequence, time=packet.time + shift_s, body=body)
                sequence += 1
        number += 1


def restarted(place: Path, rounds: list[tuple[list, Any]], size: int) -> Iterator[tuple]:
    """One row with a snapshot, one without."""
    from fcslam.mission.mission_store import MissionStore
    from fcslam.service.mission_folder import MissionFolder

    folder = MissionFolder(place)
    store = MissionStore(folder.store)
    packets = stored(rounds)
    store.put([next(packets) for _ in range(size - 2)], 0.0)
    first_s = worked(folder, store, settles=True)
    snapshot_mb = folder.snapshot.stat().st_size / 1e6
    for start in ("snapshot", "no snapshot"):
        if start == "no snapshot":
            folder.snapshot.unlink()
        store.put([next(packets)], 0.0)
        yield size, start, first_s, snapshot_mb, worked(folder, store)
    store.close()


def stored(rounds: list[tuple[list, Any]]) -> Iterator[Any]:
    from fcslam.mission.mission_store import StoredPacket
    from fcslam.wire.packets import encode, read_label

    streams = [repeated(packets, back) for packets, back in rounds]
    for packet in heapq.merge(*streams, key=lambda packet: packet.order):
        data = encode(packet)
        label = read_label(data)
        yield StoredPacket(packet.robot, packet.epoch, packet.sequence, packet.time, label.kind, label.channel, data)


def worked(folder: Any, store: Any, settles: bool = False) -> float:
    """Seconds until a new worker has let every packet take effect; it is killed then, or after its next snapshot."""
    size = len(store.envelopes())
    began = time.perf_counter()
    command = [sys.executable, "-m", "fcslam.service.worker"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        process.stdin.write(json.dumps({"folder": str(folder.path)}).encode() + b"\n")
        process.stdin.flush()
        written_ns = written(folder)
        while store.applied() < size:
            if process.poll() is not None:
                raise SystemExit(f"restart: the worker ended with code {process.returncode}")
            written_ns = written(folder)
            time.sleep(LOOK_S)
        took_s = time.perf_counter() - began
        while settles and written(folder) == written_ns:
            if time.perf_counter() > began + took_s + SETTLED_S:
                raise SystemExit("restart: the worker wrote no snapshot")
            time.sleep(LOOK_S)
        process.kill()
    return took_s


def written(folder: Any) -> int:
    """When the snapshot was written, in nanoseconds; 0: never."""
    return int(folder.snapshot.stat().st_mtime_ns) if folder.snapshot.exists() else 0


if __name__ == "__main__":
    main()
