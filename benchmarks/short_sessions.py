"""A robot that restarts again and again: CPU seconds until a result with thousands of sessions is written.

    python benchmarks/short_sessions.py [--sessions 500 1000 2000]

Every session is a hello and one keyscan of 181 beams, so nothing connects it to another one and it is a map of its own.
The cloud applies all packets, decides, and writes the run folder, as it does for `POST /finalize`. A service takes only
60 sessions of a robot in an hour (`fleet.claims.sessions_per_hour`).
"""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import common
import numpy as np

COLUMNS = {"sessions": ",", "packets applied, s": ".1f", "result written, s": ".1f"}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--sessions", nargs="+", type=int, default=[500, 1000, 2000], help="sizes of the mission")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    report.table("Short sessions", COLUMNS, [measured(count) for count in chosen.sessions])
    report.write()


def measured(count: int) -> tuple[int, float, float]:
    """Number of sessions, and CPU seconds of both parts."""
    from fcslam.cloud.cloud import Cloud
    from fcslam.cloud.report import keyscan_track, run_of
    from fcslam.lidar.occupancy import OccupancyConfig
    from fcslam.mission.mission import MissionConfig

    config = MissionConfig()
    cloud, began_s = Cloud(config.fleet, config.seed), time.process_time()
    for packet in packets(count):
        cloud.apply(packet)
    applied_s = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        result = cloud.finalize()
        tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
        run_of(result, tracks, [], "", OccupancyConfig()).save(Path(folder) / "run")
        return count, applied_s - began_s, time.process_time() - applied_s


def packets(count: int) -> Iterator[Any]:
    from fcslam.records import Channel, Keyscan, KeyscanId, LaserModel
    from fcslam.wire.messages import Hello, Packet
    from fcslam.wire.quantisation import dequantise

    laser = LaserModel(181, -np.pi / 2, np.pi / 180, 30.0)
    for epoch in range(count):
        ranges_m = dequantise(np.full(181, 2000 + epoch % 500, np.uint16))
        yield Packet("robot", epoch, 0, float(epoch), Hello("robot", epoch, (laser,), {Channel.LIDAR: "test"}))
        yield Packet("robot", epoch, 1, float(epoch), Keyscan(KeyscanId("robot", 0), float(epoch), ranges_m))


if __name__ == "__main__":
    main()
