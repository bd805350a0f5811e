"""Bytes between each robot and the cloud, by kind of message, a second of recording and a metre of path.

    FCSLAM_DATA=/path/to/data python benchmarks/bytes.py

Counted by the transport's ledger on the split logs: encoded packets, without what a network adds to them. Keyscans,
constraints and places go up; corrections and acknowledgements come down. Paths are the odometry's.
"""

import heapq
from collections.abc import Iterator

import common

from fcslam.cloud.fleet import Fleet
from fcslam.mission import MissionConfig
from fcslam.robot.frontend import RobotFrontend
from fcslam.sources import Source, open_source, split
from fcslam.wire.ledger import Ledger
from fcslam.wire.messages import Kind, Packet
from fcslam.wire.packets import encode
from fcslam.wire.transport import InMemoryTransport

DOWN = (Kind.CORRECTION, Kind.ACKNOWLEDGEMENT)
KINDS = {"log": "", "kind": "", "packets": ",", "bytes": ",", "bytes a packet": ".0f", "share": ".1%", "B/s": ".1f",
         "B/m": ".0f"}  # fmt: skip
ROBOTS = {"robot": "", "recorded, s": ".0f", "path, m": ".0f", **{f"{kind}, kB": ".1f" for kind in Kind},
          "up, B/s": ".0f", "up, B/m": ".0f", "down, B/s": ".0f", "down, B/m": ".0f"}  # fmt: skip


def main() -> None:
    chosen = common.options(__doc__).parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    kinds, robots = [], []
    for name, parts in common.SPLITS.items():
        sources = split(open_source(common.log_path(folder, name)), parts)
        surveys = {source.name: source.survey() for source in sources}
        seconds = {robot: survey.duration_s for robot, survey in surveys.items()}
        metres = {robot: survey.path_length_m for robot, survey in surveys.items()}
        ledger = fly(sources)
        kinds += kind_rows(name, ledger, sum(seconds.values()), sum(metres.values()))
        robots += [robot_row(robot, ledger, seconds[robot], metres[robot]) for robot in surveys]
    report.table("By kind, all robots of a log", KINDS, kinds)
    report.table("By robot", ROBOTS, robots)
    report.write()


def fly(sources: list[Source]) -> Ledger:
    """The whole traffic of a mission."""
    config = MissionConfig()
    robots = [RobotFrontend(source.name, config.robot) for source in sources]
    transport = InMemoryTransport(Fleet(config.fleet, config.seed).receive)
    streams = [packets(source, robot) for source, robot in zip(sources, robots, strict=True)]
    for packet in heapq.merge(*streams, key=lambda packet: packet.order):
        transport.send(encode(packet))
    return transport.ledger()


def packets(source: Source, robot: RobotFrontend) -> Iterator[Packet]:
    for record in source.records():
        yield from robot.process(record)
    yield from robot.finish()


def kind_rows(log: str, ledger: Ledger, seconds: float, metres: float) -> list[tuple]:
    whole = ledger.total()
    rows = []
    for kind in (*Kind, None):
        total = ledger.total(kind=kind)
        name = "all" if kind is None else kind.value
        figures = (total.bytes / max(total.count, 1), total.bytes / whole.bytes)
        rows.append((log, name, total.count, total.bytes, *figures, total.bytes / seconds, total.bytes / metres))
    return rows


def robot_row(robot: str, ledger: Ledger, seconds: float, metres: float) -> tuple:
    by_kind = {kind: ledger.total(robot, kind).bytes for kind in Kind}
    down = sum(by_kind[kind] for kind in DOWN)
    up = sum(by_kind.values()) - down
    kilobytes = [count / 1e3 for count in by_kind.values()]
    return robot, seconds, metres, *kilobytes, up / seconds, up / metres, down / seconds, down / metres


if __name__ == "__main__":
    main()
