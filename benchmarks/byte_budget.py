"""What a byte budget costs: accuracy across robots against the bytes that each may send.

    FCSLAM_DATA=/path/to/data python benchmarks/byte_budget.py

The logs cut into robots as elsewhere (README). Each robot's packets go through `fcslam.robot.uplink`, as by `fcslam
robot --budget-kBps`, with shares of what the log's robots send on average when there is no budget: hello, keyscans and
constraints always travel, places are thinned to their strongest descriptors or left out. So a budget below what the
chain takes is not kept; what was sent is stated. Errors are over the relations between different robots, of which those
between robots in different maps cannot be used.
"""

import heapq
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.report import Track, run_of
from fcslam.config import dump
from fcslam.errors import InputError
from fcslam.lab.evaluation.relations import evaluate_relations
from fcslam.mission.mission import MissionConfig
from fcslam.records import ClosureStatus, Place
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.uplink import Budget
from fcslam.sources import open_source, split
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode

SHARES = (0.8, 0.7, 0.6, 0.55, 0.5, 0.45)
COLUMNS = {"log": "", "budget, kB/s": ".2f", "share": ".0%", "sent, kB/s a robot": ".2f", "places": "", "left out": "",
           "descriptors a place": ".0f", "closures between": "", "maps": "", "relations across robots": "",
           "mean, m": ".4f", "max, m": ".3f", "mean, deg": ".3f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--logs", nargs="+", choices=common.SPLITS, default=list(common.SPLITS))
    parser.add_argument("--shares", nargs="+", type=float, default=SHARES, help="of what is sent without a budget")
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    for name in chosen.logs:
        robots = drive(common.log_path(folder, name), common.SPLITS[name])
        free_kbps = rate_kbps(robots)
        for share in (float("inf"), *chosen.shares):
            budget_kbps = share * free_kbps
            rows.append((name, budget_kbps, share, *row(robots, budget_kbps, common.relations_path(folder, name))))
            print(*rows[-1], flush=True)
    report.table("Budgets", COLUMNS, rows)
    report.picture("Error across robots against bytes", draw(rows))
    report.write()


def drive(log: Path, parts: int) -> dict[str, tuple[RobotFrontend, list[Packet]]]:
    """The robots and all that they would say."""
    robots = {}
    for source in split(open_source(log), parts):
        frontend = RobotFrontend(source.name, MissionConfig().robot)
        packets = [packet for record in source.records() for packet in frontend.process(record)]
        robots[source.name] = frontend, packets + frontend.finish()
    return robots


def rate_kbps(robots: dict[str, tuple[RobotFrontend, list[Packet]]]) -> float:
    """What a robot sends on average when there is no budget."""
    sent = sum(len(encode(packet)) for _, packets in robots.values() for packet in packets)
    return sent / sum(float(np.ptp(track(frontend).stamps)) for frontend, _ in robots.values()) / 1e3


def row(robots: dict[str, tuple[RobotFrontend, list[Packet]]], budget_kbps: float, relations: Path) -> tuple:
    config = MissionConfig()
    budgets = {robot: Budget(1e3 * budget_kbps) for robot in robots}
    streams = [numbered(budgets[robot].fit(packets)) for robot, (_, packets) in robots.items()]
    cloud = Cloud(config.fleet, config.seed)
    for packet in heapq.merge(*streams, key=lambda packet: packet.order):
        cloud.receive(encode(packet))
    result = cloud.finalize()
    tracks = {robot: track(frontend) for robot, (frontend, _) in robots.items()}
    with tempfile.TemporaryDirectory() as place:
        run_of(result, tracks, (), dump(config), config.map, with_local_maps=False).save(Path(place) / "run")
        try:
            errors = evaluate_relations(Path(place) / "run", relations, across_robots=True)
            measured = (
                f"{errors.used} of {errors.total}", errors.translation.mean, errors.translation.maximum,
                errors.rotation.mean,
            )  # fmt: skip
        except InputError:  # no two robots share a map
            measured = ("0", np.nan, np.nan, np.nan)
    sent = sum(len(encode(packet)) for stream in streams for packet in stream)
    seconds = sum(float(np.ptp(track.stamps)) for track in tracks.values())
    places = [packet.body for stream in streams for packet in stream if isinstance(packet.body, Place)]
    closures = [c for c in result.closures if c.i.robot != c.j.robot and c.status is ClosureStatus.ACCEPTED]
    return (
        sent / seconds / 1e3, len(places),
        sum(budget.left_out for budget in budgets.values()), mean(len(place.descriptors) for place in places),
        len(closures), len({robot.map_index for robot in result.robots}), *measured,
    )  # fmt: skip


def numbered(packets: Iterable[Packet]) -> list[Packet]:
    """As the outbox numbers what is sent."""
    return [replace(packet, sequence=number) for number, packet in enumerate(packets)]


def track(frontend: RobotFrontend) -> Track:
    poses = frontend.scan_poses
    return Track(poses.stamps, poses.keyscans, poses.T_keyscan_base)


def mean(values: Iterable[int]) -> float:
    chosen = list(values)
    return float(np.mean(chosen)) if chosen else 0.0


def draw(rows: list[tuple]) -> Any:
    """A line a log; hollow where some maps stayed apart."""
    from matplotlib.figure import Figure

    sent, maps, error = (list(COLUMNS).index(name) for name in ("sent, kB/s a robot", "maps", "mean, m"))
    axes = (figure := Figure(figsize=(7.0, 4.2))).subplots()
    for log in dict.fromkeys(row[0] for row in rows):
        points = [row for row in rows if row[0] == log and np.isfinite(row[error])]
        (line,) = axes.plot([row[sent] for row in points], [row[error] for row in points], label=log)
        for row in points:
            face = line.get_color() if row[maps] == 1 else "white"
            axes.plot(row[sent], row[error], "o", color=line.get_color(), markerfacecolor=face)
    axes.set(
        xscale="log", yscale="log", xlabel="uplink of a robot, kB/s of recording", ylabel="mean error across robots, m"
    )
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
